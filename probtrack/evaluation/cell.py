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
from probtrack.evaluation.store import CellScores
from probtrack.metrics import Parts, Talkers, TrackMetric
from probtrack.simulation import SceneFolder
from probtrack.trackers import Tracker
from probtrack.tracks import Track

_AT_ONCE = 2**19  # particles of all runs that are worked on together: about a gigabyte


@dataclass(frozen=True)
class Cell:
    """What a worker needs to know, on whatever machine it is.

    Attributes:
        key: What tells it from all others of the study.
        scene: Name of the recording.
        folder: Its folder.
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
            InputError: for files that cannot be used, or a track that is not finite, in one line that names the cell.
        """
        begin = time.thread_time()
        with one_thread():
            try:
                parts, duration = self._parts()
            except InputError as error:
                raise InputError(f"{self.key}: {error}") from None
        numerator, denominator = (
            np.array([np.broadcast_to(one[i].double().numpy(), len(self.seeds)) for one in parts]) for i in (0, 1)
        )
        return CellScores(numerator, denominator, time.thread_time() - begin, duration)

    def _parts(self) -> tuple[list[Parts], float]:
        folder = SceneFolder(self.folder)
        tracker = self.make_tracker(folder.array, folder.region, **self.arguments)
        samples = folder.open_recording(tracker.fs).read()
        tables = folder.truth
        start = None
        if self.start:
            assert tables is not None  # the plan has looked
            position = tables[0].position
            assert position is not None
            start = position[0, : tracker.region.axes].float()
        track = self._track(tracker, samples, start)
        truth = Talkers(track.time) if tables is None else Talkers.of_tables(tables, track.time)
        estimate = Talkers.of_track(track)
        shared = Talkers(truth.time, *(None if x is None else x.unsqueeze(1) for x in truth[1:]))  # by all runs
        parts = [metric.parts(estimate, metric.checked(shared)) for metric in self.metrics]
        return parts, samples.shape[-1] / tracker.fs

    def _track(self, tracker: Tracker, samples: Tensor, start: Tensor | None) -> Track:
        """Return the track of all runs; many large clouds are worked on one after the other, for the memory."""
        seeds = torch.tensor(self.seeds)
        some = max(1, _AT_ONCE // tracker.filter.num_particles)
        track = side_by_side([tracker(samples, part, start) for part in seeds.split(some)])
        bad = ~track.position.isfinite().all(-1)
        if bad.any():
            frame, run = bad.nonzero()[0].tolist()
            when = f"{track.time[frame]:.3f} s"
            raise NotFiniteError(f"the track is not finite at {when} in the run of seed {self.seeds[run]}")
        return track


def side_by_side(tracks: Sequence[Track]) -> Track:
    """Return tracks of several runs each, at the same times, as one."""

    def joined(*pieces: Tensor | None) -> Tensor | None:
        present = [piece for piece in pieces if piece is not None]
        return torch.cat(present, 1) if present else None

    columns = (joined(*column) for column in zip(*(one[1:] for one in tracks), strict=True))
    return Track(tracks[0].time, *columns)  # type: ignore[arg-type]
