"""What a study's store holds: recordings, cells and scores, as plain values."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class PlannedScene(NamedTuple):
    """A recording of a study.

    Attributes:
        name: What it is called.
        fingerprint: What tells its files from others of the same name.
        conditions: What is varied between recordings, by name, such as `snr_db` and `t60`.
        seeds: Of the runs on it.
        origin: What it shares with other recordings of one scene, such as those at other levels of noise: together
            they are one draw from all scenes there could be. Its name if it is None.
    """

    name: str
    fingerprint: str
    conditions: dict[str, Any]
    seeds: Sequence[int]
    origin: str | None = None


class PlannedCell(NamedTuple):
    """A cell before it is worked on: a tracker on a recording.

    Attributes:
        key: What tells it from all others of the study.
        scene: Name of its recording.
        settings: The tracker's name as `tracker`, and what is varied of its settings, by name.
        runs: Monte-Carlo runs.
    """

    key: str
    scene: str
    settings: dict[str, Any]
    runs: int


class StoredCell(NamedTuple):
    """A cell of a store.

    Attributes:
        id: Its number.
        key: What tells it from all others of the study.
        scene: Name of its recording.
        settings: The tracker's name as `tracker`, and what is varied of its settings, by name.
        conditions: What is varied between recordings, by name.
        origin: What its recording shares with others of the same scene.
        runs: Monte-Carlo runs.
        finished: When it was finished [s since 1970]; None before.
        seconds: What it took [s of one processor].
        duration: How long the recording is [s].
        failure: What went wrong with it last, if it did.
    """

    id: int
    key: str
    scene: str
    settings: dict[str, Any]
    conditions: dict[str, Any]
    origin: str
    runs: int
    finished: float | None
    seconds: float | None
    duration: float | None
    failure: str | None


class CellScores(NamedTuple):
    """What came of a cell.

    Attributes:
        numerator: Numerators of each metric and run (J, R).
        denominator: Denominators (J, R).
        seconds: What it took [s].
        duration: How long the recording is [s].
    """

    numerator: NDArray[np.float64]
    denominator: NDArray[np.float64]
    seconds: float
    duration: float


class Scores(NamedTuple):
    """Runs of finished cells for one metric.

    Attributes:
        cell: Number of the cell of each run (n,).
        run: Number of the run within it (n,).
        numerator: Numerators (n,).
        denominator: Denominators (n,).
    """

    cell: NDArray[np.int64]
    run: NDArray[np.int64]
    numerator: NDArray[np.float64]
    denominator: NDArray[np.float64]
