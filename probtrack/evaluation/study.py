"""A study as a file says it: trackers by settings by recordings by runs, and the cells that come of it."""

import hashlib
import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch

from probtrack import metrics
from probtrack._checks import check_int
from probtrack._files import read_yaml
from probtrack.errors import InputError
from probtrack.evaluation.cell import Cell, versions
from probtrack.evaluation.choices import TRACKERS, contenders, metric_of
from probtrack.evaluation.factors import check_names
from probtrack.evaluation.recordings import Recording, Scenes, Value, recordings
from probtrack.evaluation.store import PlannedCell, PlannedScene
from probtrack.evaluation.suitability import Framing, check_recording
from probtrack.simulation import SceneFolder
from probtrack.simulation.description import from_description


@dataclass(frozen=True)
class StudyFile:
    """What a study file says.

    Args:
        scenes: Folders of scenes or data sets, or `Scenes` with a name and conditions; paths from the file's folder.
        trackers: What is compared, by name: a `class_path` and its `init_args`. Trackers that ship with probtrack need
            no path but their name.
        vary: Settings that all trackers are tried with, each a list of values.
        metrics: Names of metrics, or `class_path`, `init_args` and a `name`.
        runs: Monte-Carlo runs of each tracker on each recording.
        seed: Of all runs.
        start: Where clouds begin: around the talker's first true position, as S1 does, or anywhere in the region.
    """

    scenes: list[str | Scenes]
    trackers: dict[str, Any]
    vary: dict[str, list[Value]] = field(default_factory=dict)
    metrics: list[Any] = field(default_factory=lambda: ["rmse", "track_loss"])
    runs: int = 60
    seed: int = 0
    start: Literal["truth", "anywhere"] = "truth"


@dataclass(frozen=True)
class Study:
    """A study that has been looked through: everything it names is there.

    Attributes:
        config: What its results depend on, as plain values; recordings are told apart by their fingerprints.
        scenes: All recordings.
        metrics: What is judged by.
        cells: What is to be done.
    """

    config: dict[str, Any]
    scenes: tuple[PlannedScene, ...]
    metrics: tuple[metrics.TrackMetric, ...]
    cells: tuple[Cell, ...]

    @property
    def planned(self) -> tuple[PlannedCell, ...]:
        """The cells as a store keeps them."""
        return tuple(PlannedCell(cell.key, cell.scene, cell.settings, len(cell.seeds)) for cell in self.cells)


def load_study(path: str | Path) -> Study:
    """Return the study that a YAML file describes.

    Raises:
        InputError: in one line, for a file that is not one, names that are not known, settings that trackers and
            metrics do not take, recordings that are not there, or that lack the truth that a metric needs.
    """
    path = Path(path)
    content = read_yaml(path, "study file")
    chosen = {}
    if isinstance(content, dict):  # of what may be one thing or another the parser would make class_paths and riddles
        empty: dict[str, Any] = {"scenes": [], "trackers": {}, "metrics": []}
        chosen = {name: content[name] for name in empty if name in content}
        content |= {name: empty[name] for name in chosen}
    file = replace(from_description(StudyFile, content, path), **chosen)
    try:
        return plan(file, path.absolute().parent)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def plan(file: StudyFile, base: Path) -> Study:
    """Return the study of `file`, whose paths are from the folder `base`."""
    judged, found = _looked_at(file, base)
    made = list(contenders(file.trackers, file.vary, base))
    if not made:
        raise InputError(f"trackers must hold at least one, such as one of {', '.join(TRACKERS)}")
    first = SceneFolder(found[0].folder)
    framings = dict.fromkeys(Framing.of(one.tracker(first)) for one in made)
    for one in found:
        for framing in framings:
            check_recording(one, judged, framing, start=file.start, runs=file.runs)
    scenes = tuple(_planned(one, file) for one in found)
    cells = tuple(
        Cell(
            key=f"{contender.key} on {one.name}",
            scene=one.name,
            folder=one.folder,
            fingerprint=scene.fingerprint,
            files={str((base / name).resolve()): content for name, content in contender.files.items()},
            settings=contender.settings,
            make_tracker=contender.make,
            arguments=contender.arguments,
            metrics=judged,
            seeds=tuple(scene.seeds),
            start=file.start == "truth",
        )
        for one, scene in zip(found, scenes, strict=True)
        for contender in made
    )
    config = {name: value for name, value in asdict(file).items() if name != "scenes"}
    dtype = str(torch.get_default_dtype()).removeprefix("torch.")
    files = {name: content for contender in made for name, content in contender.files.items()}
    config |= {"files": files, "made_with": versions(), "dtype": dtype}
    return Study(json.loads(json.dumps(config)), scenes, judged, cells)


def _looked_at(file: StudyFile, base: Path) -> tuple[tuple[metrics.TrackMetric, ...], list[Recording]]:
    """Return the metrics and the recordings of a study, or raise `InputError` for what is not as it must be."""
    check_int(file.runs, "runs", low=1)
    check_int(file.seed, "seed", low=0)
    if not isinstance(file.trackers, dict) or not all(isinstance(name, str) for name in file.trackers):
        raise InputError(f"trackers must be a mapping of names to what they are, got {file.trackers!r}")
    for name, entries in (("metrics", file.metrics), ("scenes", file.scenes)):
        if not isinstance(entries, list):
            raise InputError(f"{name} must be a list, got {entries!r}")
    judged = tuple(metric_of(entry) for entry in file.metrics)
    if not judged:
        raise InputError(f"metrics must name at least one: there are {', '.join(metrics.known())}")
    _check_different([metric.name for metric in judged], "metrics")
    found = [one for entry in file.scenes for one in recordings(Scenes.of(entry), base)]
    if not found:
        raise InputError("scenes must name at least one folder")
    _check_different([one.name for one in found], "scenes")
    check_names([metric.name for metric in judged], file.vary, [name for one in found for name in one.conditions])
    return judged, found


def _planned(one: Recording, file: StudyFile) -> PlannedScene:
    seeds = tuple(_seed(file.seed, one.name, run) for run in range(file.runs))
    return PlannedScene(one.name, one.fingerprint(), one.conditions, seeds, one.origin())


def _check_different(names: list[str], what: str) -> None:
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"{what}: must differ, got {twice} twice")


def _seed(seed: int, scene: str, run: int) -> int:
    """Return the seed of a run: the same for all trackers, and another for every recording."""
    return int.from_bytes(hashlib.blake2b(f"{seed}/{scene}/{run}".encode(), digest_size=7).digest())
