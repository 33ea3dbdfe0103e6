"""Whether a recording can be tracked and judged as a study asks, found before any work."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from probtrack.errors import InputError
from probtrack.evaluation.cell import check_runs
from probtrack.evaluation.recordings import Recording
from probtrack.metrics import Talkers, TrackMetric
from probtrack.metrics.smoothness import WithoutTruth
from probtrack.simulation import SceneFolder
from probtrack.trackers import Tracker

_SOON = 0.1  # s that a truth may begin from the first frame: a walker is still within the cloud's spread of 0.1 m


class Framing(NamedTuple):
    """How a tracker cuts a recording into frames.

    Attributes:
        fs: Sampling rate [Hz].
        frame_length: Samples of a frame.
        hop: Samples between frames.
    """

    fs: int
    frame_length: int
    hop: int

    @classmethod
    def of(cls, tracker: Tracker) -> "Framing":
        """Return how `tracker` does it."""
        return cls(tracker.fs, tracker.front_end.stft.frame_length, tracker.front_end.stft.hop)

    def times(self, samples: int) -> Tensor:
        """Return the middle (T,) [s] of each frame of so many samples."""
        first = torch.arange(0, samples - self.frame_length + 1, self.hop, dtype=torch.float64)
        return (first + self.frame_length / 2) / self.fs


def check_recording(one: Recording, judged: Sequence[TrackMetric], framing: Framing, *, start: str, runs: int) -> None:
    """Raise `InputError` unless a recording and its truth have what runs, metrics and the start need.

    Args:
        one: The recording.
        judged: What it is judged by.
        framing: Of a tracker.
        start: `truth` or `anywhere`.
        runs: How many there are of a tracker.
    """
    folder = SceneFolder(one.folder)
    recording = folder.open_recording(framing.fs)
    samples = recording.num_output_samples
    if samples < framing.frame_length:
        raise InputError(
            f"{folder.audio_path}: is shorter than a frame: {samples} of {framing.frame_length} samples "
            f"at {framing.fs} Hz"
        )
    check_runs(runs, samples, framing.hop, f"{one.name}: ")
    time = framing.times(samples)
    if start == "truth":
        _check_start(one, float(time[0]))
    truth = None if one.truth is None else Talkers.of_tables(one.truth, time)
    for metric in judged:
        if metric.needs:
            _check_judged(one, truth, metric, recording.duration)
        if isinstance(metric, WithoutTruth) and not ((time >= metric.begin) & (time < metric.end)).any():
            raise InputError(
                f"{one.folder}: metric {metric.name} looks from {metric.begin:g} s to {metric.end:g} s, where the "
                f"recording, 0 s to {recording.duration:g} s, has no frame"
            )


def _check_start(one: Recording, first_frame: float) -> None:
    """Raise `InputError` unless the truth says where its one talker is as the recording begins."""
    table = one.truth[0] if one.truth is not None and len(one.truth) == 1 else None
    if table is None or table.position is None or not table.position[0].isfinite().all():
        raise InputError(
            f"{one.folder}: start: truth needs one talker in truth.csv, with a position in its first row; "
            "start: anywhere does without"
        )
    begin = float(table.time[0])
    if not -_SOON <= begin <= first_frame + _SOON:
        raise InputError(
            f"{one.folder}: start: truth needs the position at the first frame, at {first_frame:.3f} s, but truth.csv "
            f"begins at {begin:g} s; start: anywhere does without"
        )


def _check_judged(one: Recording, truth: Talkers | None, metric: TrackMetric, duration: float) -> None:
    """Raise `InputError` unless the truth at the frames has what a metric needs."""
    lacking = [name for name in metric.needs if truth is None or getattr(truth, name) is None]
    if truth is None or one.truth is None or lacking:
        raise InputError(f"{one.folder}: metric {metric.name} needs truth.csv with {', '.join(lacking)}")
    if metric.one_talker and truth.num_talkers > 1:
        raise InputError(f"{one.folder}: metric {metric.name} is of one talker, truth.csv has {truth.num_talkers}")
    begin, end = (pick(float(table.time[at]) for table in one.truth) for pick, at in ((min, 0), (max, -1)))
    if end < truth.time[0] or begin > truth.time[-1]:
        raise InputError(
            f"{one.folder}: truth.csv covers {begin:g} s to {end:g} s, the recording 0 s to {duration:g} s"
        )
    unknown = [name for name in metric.needs if not getattr(truth, name).isfinite().any()]
    if metric.one_talker and unknown:
        raise InputError(
            f"{one.folder}: metric {metric.name} needs {', '.join(unknown)} in truth.csv, known in no frame"
        )
