"""One cell of a study: a tracker on a recording, all its runs at once, scored."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from probtrack._threads import one_thread
from probtrack.errors import InputError, NotFiniteError
from probtrack.evaluation.choices import content_hash
from probtrack.evaluation.recordings import fingerprint
from probtrack.evaluation.store import CellScores
from probtrack.metrics import Parts, Talkers, TrackMetric
from probtrack.simulation import SceneFolder
from probtrack.simulation.description import made_with
from probtrack.trackers import Tracker

_AT_ONCE = 2**18  # particles of all runs that are worked on together: about half a gigabyte
_FRAMES = 2**22  # frames of all runs that are judged together: about half a gigabyte


@dataclass(frozen=True)
class Cell:
    """What a worker needs to know, on whatever machine it is.

    Attributes:
        key: What tells it from all others of the study.
        scene: Name of the recording.
        folder: Its folder.
        fingerprint: What tells its files from others.
        files: What tells the content of each other file, by its path, that the tracker is made of from others.
        settings: The tracker's name as `tracker`, and what is varied of its settings, by name.
        make_tracker: Makes the tracker for an array and a region.
        arguments: Keyword arguments of that.
        metrics: What to judge by.
        seeds: Of the runs.
        start: Whether the cloud begins around the talker's first position; otherwise anywhere.
    """

    key: str
    scene: str
    folder: Path
    fingerprint: str
    files: dict[str, str]
    settings: dict[str, Any]
    make_tracker: Callable[..., Tracker]
    arguments: dict[str, Any]
    metrics: tuple[TrackMetric, ...]
    seeds: tuple[int, ...]
    start: bool

    @torch.inference_mode()
    def scores(self) -> CellScores:
        """Return the figures of all runs.

        Raises:
            InputError: for files that cannot be used or are others than when the study was planned, or too many runs
                for the memory.
            NotFiniteError: for a track or a figure that is not finite, with the seed of the first such run.
        """
        begin = time.thread_time()
        with one_thread():
            self._check_unchanged()
            folder = SceneFolder(self.folder)
            tracker = self.make_tracker(folder.array, folder.region, **self.arguments)
            samples = folder.open_recording(tracker.fs).read()
            truth = folder.truth
            start = None
            if self.start:
                assert truth is not None  # the plan has looked
                position = truth[0].position
                assert position is not None
                start = position[0, : tracker.region.axes].to(torch.get_default_dtype())
            estimate = self._estimate(tracker, samples, start)
            true = Talkers(estimate.time) if truth is None else Talkers.of_tables(truth, estimate.time)
            shared = Talkers(true.time, *(None if column is None else column[:, None] for column in true[1:]))
            parts = [self._checked(metric.parts(estimate, shared), metric.name) for metric in self.metrics]
        return CellScores(
            np.stack([one.total.numpy() for one in parts]),
            np.stack([one.count.numpy() for one in parts]),
            time.thread_time() - begin,
            samples.shape[-1] / tracker.fs,
        )

    def _estimate(self, tracker: Tracker, samples: Tensor, start: Tensor | None) -> Talkers:
        """Return what the tracker says in each run; many large clouds are worked on in turn, for the memory."""
        check_runs(len(self.seeds), samples.shape[-1], tracker.front_end.stft.hop)
        some = max(1, _AT_ONCE // tracker.filter.num_particles)
        pieces = []
        for seeds in torch.tensor(self.seeds).split(some):
            track = tracker(samples, seeds, start)
            bad = ~track.position.isfinite().all(-1)
            if bad.any():
                frame, run = bad.nonzero()[0].tolist()
                when, seed = f"{track.time[frame]:.3f} s", seeds[run]
                raise NotFiniteError(f"the track is not finite at {when} in the run of seed {seed}")
            pieces.append(Talkers.of_track(track))
        return side_by_side(pieces)

    def _check_unchanged(self) -> None:
        """Raise `InputError` unless all files are those that the study was planned with, on whatever machine."""
        if fingerprint(self.folder) != self.fingerprint:
            raise InputError(f"{self.folder}: the files of this recording are others than when the study was planned")
        other = next((path for path, planned in self.files.items() if content_hash(path) != planned), None)
        if other is not None:
            raise InputError(f"{other}: is another file than when the study was planned")

    def _checked(self, parts: Parts, name: str) -> Parts:
        """Return `parts` (R,) of a metric, or raise `NotFiniteError` naming the first run that has none."""
        bad = ~(parts.total.isfinite() & parts.count.isfinite())
        if bad.any():
            run = int(bad.nonzero()[0])
            value = f"{parts.total[run]:g} over {parts.count[run]:g}"
            raise NotFiniteError(f"{name} is not finite, {value}, in the run of seed {self.seeds[run]}")
        return parts


def check_runs(runs: int, samples: int, hop: int, where: str = "") -> None:
    """Raise `InputError` for more runs than can be judged at once on a recording of so many samples."""
    frames = max(1, round(samples / hop))
    most = max(1, _FRAMES // frames)
    if runs > most:
        raise InputError(
            f"{where}runs must be at most {most} for a recording of {frames} frames, got {runs}: "
            "several studies, each with its own seed, hold more"
        )


def versions() -> dict[str, str]:
    """Return the versions that the numbers of a cell depend on."""
    return {name: version for name, version in made_with().items() if name in ("probtrack", "torch")}


def side_by_side(pieces: Sequence[Talkers]) -> Talkers:
    """Return several batches of runs (T, runs, ...) at the same times as one."""
    if len(pieces) == 1:
        return pieces[0]

    def joined(*columns: Tensor | None) -> Tensor | None:
        present = [column for column in columns if column is not None]
        return torch.cat(present, 1) if present else None

    return Talkers(pieces[0].time, *(joined(*column) for column in zip(*(one[1:] for one in pieces), strict=True)))
