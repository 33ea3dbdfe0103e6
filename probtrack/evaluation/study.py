"""A study as a file says it: trackers by settings by recordings by runs, and the cells that come of it."""

import hashlib
import importlib
import inspect
import itertools
import json
from argparse import ArgumentError
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from jsonargparse import ArgumentParser

from probtrack import metrics, trackers
from probtrack._checks import check_int
from probtrack._files import read_yaml
from probtrack.errors import InputError
from probtrack.evaluation.cell import Cell, versions
from probtrack.evaluation.recordings import Recording, Scenes, Value, check_truth, recordings
from probtrack.evaluation.store import PlannedCell, PlannedScene
from probtrack.simulation import SceneFolder
from probtrack.simulation.description import from_description, in_plain_words
from probtrack.trackers import Tracker

TRACKERS: dict[str, Callable[..., Tracker]] = {"lehmann2007": trackers.lehmann2007}
"""Trackers that ship with probtrack, by name."""

Settings = dict[str, Any]


class Choice(NamedTuple):
    """A tracker or a metric of a study file.

    Attributes:
        class_path: Its name, or the import path of one's own.
        init_args: Its settings.
        name: What a metric is called, its own name by default.
    """

    class_path: str
    init_args: Settings
    name: str | None = None

    @classmethod
    def of(cls, entry: Any, where: str) -> "Choice":
        """Return what a study file says: a name, or a mapping of `class_path`, `init_args` and `name`."""
        content = {"class_path": entry} if isinstance(entry, str) else entry
        if not (isinstance(content, dict) and "class_path" in content and content.keys() <= set(cls._fields)):
            raise InputError(f"{where}: must be a name, or have class_path and perhaps init_args, got {entry!r}")
        made = cls(content["class_path"], content.get("init_args") or {}, content.get("name"))
        if not (isinstance(made.class_path, str) and isinstance(made.init_args, dict)):
            raise InputError(f"{where}: class_path must be a name and init_args a mapping, got {entry!r}")
        return made


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
    if isinstance(content, dict):  # of trackers and metrics, which may be anything, the parser would make class_paths
        empty: dict[str, Any] = {"trackers": {}, "metrics": []}
        chosen = {name: content[name] for name in empty if name in content}
        content |= {name: empty[name] for name in chosen}
    file = replace(from_description(StudyFile, content, path), **chosen)
    try:
        return plan(file, path.absolute().parent)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def plan(file: StudyFile, base: Path) -> Study:
    """Return the study of `file`, whose paths are from the folder `base`."""
    check_int(file.runs, "runs", low=1)
    check_int(file.seed, "seed", low=0)
    if not isinstance(file.trackers, dict) or not all(isinstance(name, str) for name in file.trackers):
        raise InputError(f"trackers must be a mapping of names to what they are, got {file.trackers!r}")
    if not isinstance(file.metrics, list):
        raise InputError(f"metrics must be a list, got {file.metrics!r}")
    judged = tuple(_metric(entry) for entry in file.metrics)
    _check_different([metric.name for metric in judged], "metrics")
    if not judged:
        raise InputError(f"metrics must name at least one: there are {', '.join(metrics.known())}")
    found = [one for entry in file.scenes for one in recordings(_scenes(entry), base)]
    _check_different([one.name for one in found], "scenes")
    if not found:
        raise InputError("scenes must name at least one folder")
    for one in found:
        check_truth(one, judged, file.start)
    inputs: dict[str, str] = {}
    made = [tracker for name in file.trackers for tracker in _trackers(name, file, base, inputs)]
    if not made:
        raise InputError(f"trackers must hold at least one, such as one of {', '.join(TRACKERS)}")
    _check_made(made, found[0])
    seeds = {one.name: tuple(_seed(file.seed, one.name, run) for run in range(file.runs)) for one in found}
    cells = tuple(
        Cell(
            key=f"{_key(settings)} on {one.name}",
            scene=one.name,
            folder=one.folder,
            settings=settings,
            make_tracker=make,
            arguments=arguments,
            metrics=judged,
            seeds=seeds[one.name],
            start=file.start == "truth",
        )
        for one in found
        for settings, make, arguments in made
    )
    scenes = tuple(
        PlannedScene(one.name, one.fingerprint(), one.conditions, seeds[one.name], one.origin()) for one in found
    )
    config = {name: value for name, value in asdict(file).items() if name != "scenes"}
    dtype = str(torch.get_default_dtype()).removeprefix("torch.")
    config |= {"files": inputs, "made_with": versions(), "dtype": dtype}
    return Study(json.loads(json.dumps(config)), scenes, judged, cells)


def _scenes(entry: str | Scenes) -> Scenes:
    return Scenes(entry) if isinstance(entry, str) else entry


def _metric(entry: Any) -> metrics.TrackMetric:
    choice = Choice.of(entry, "metrics")
    known = metrics.known()
    kind = known.get(choice.class_path) or _imported(choice.class_path, "metrics", list(known))
    if not (isinstance(kind, type) and issubclass(kind, metrics.TrackMetric)):
        raise InputError(f"metrics: {choice.class_path} is no TrackMetric")
    metric = from_description(kind, choice.init_args, f"metrics: {choice.class_path}")
    if choice.name is not None:
        metric.name = choice.name
    return metric


def _trackers(
    name: str, file: StudyFile, base: Path, inputs: dict[str, str]
) -> Iterator[tuple[Settings, Callable[..., Tracker], Settings]]:
    """Yield the settings by name, the maker and its arguments of a tracker for every combination of what varies."""
    where = f"trackers: {name}"
    choice = Choice.of(file.trackers[name], where)
    make = TRACKERS.get(choice.class_path) or _imported(choice.class_path, where, list(TRACKERS))
    if not callable(make):
        raise InputError(f"{where}: {choice.class_path} makes no tracker")
    for varied, values in file.vary.items():
        if varied in choice.init_args:
            raise InputError(f"{where}: {varied} is varied, so init_args cannot say it too")
        if not values:
            raise InputError(f"vary: {varied} must be a list of values, at least one")
        _check_different([str(value) for value in values], f"vary: {varied}")
    for combination in itertools.product(*file.vary.values()):
        settings = dict(zip(file.vary, combination, strict=True))
        given = {key: _file(value, base, inputs) for key, value in {**choice.init_args, **settings}.items()}
        yield {"tracker": name, **settings}, make, _arguments(make, given, where)


def _imported(path: str, where: str, known: list[str]) -> Any:
    """Return what an import path names, or raise `InputError` that lists the `known` names."""
    module, _, name = path.rpartition(".")
    if not module:
        raise InputError(f"{where}: nothing is called {path!r}: there are {', '.join(known)}, and import paths")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise InputError(f"{where}: cannot import {path}: {error}") from None


def _arguments(make: Callable[..., Tracker], given: Settings, where: str) -> Settings:
    """Return the arguments `given` as `make` takes them, checked against its signature."""
    parameters = inspect.signature(make).parameters
    names = list(parameters)[2:]  # after the array and the region
    unknown = next((name for name in given if name not in names), None)
    if unknown is not None and all(one.kind is not one.VAR_KEYWORD for one in parameters.values()):
        raise InputError(f"{where}: has no setting {unknown}: there are {', '.join(names) or 'none'}")
    parser = ArgumentParser(exit_on_error=False, default_env=False)
    try:
        skip: set[str | int] = {*list(parameters)[:2]}
        add = parser.add_class_arguments if inspect.isclass(make) else parser.add_function_arguments
        add(make, "it", skip=skip)
        taken = parser.instantiate(parser.parse_object({"it": given})).it
    except (ArgumentError, InputError, ImportError, ValueError, TypeError) as error:
        raise InputError(f"{where}: {in_plain_words(str(error))}") from None
    return {name: taken[name] for name in given}


def _file(value: Any, base: Path, inputs: dict[str, str]) -> Any:
    """Return a setting; one that names a file as its path from anywhere, with what is in it noted in `inputs`."""
    if isinstance(value, str) and (base / value).is_file():
        inputs[value] = hashlib.sha256((base / value).read_bytes()).hexdigest()[:16]
        return str((base / value).resolve())
    return value


def _check_made(made: list[tuple[Settings, Callable[..., Tracker], Settings]], one: Recording) -> None:
    """Raise `InputError` for settings of which no tracker can be made, before hours of work and not after."""
    folder = SceneFolder(one.folder)
    for settings, make, arguments in made:
        try:
            tracker = make(folder.array, folder.region, **arguments)
        except InputError as error:
            raise InputError(f"trackers: {_key(settings)}: {error}") from None
        if not isinstance(tracker, Tracker):
            raise InputError(f"trackers: {_key(settings)}: must make a Tracker, made a {type(tracker).__name__}")


def _check_different(names: list[str], what: str) -> None:
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"{what}: must differ, got {twice} twice")


def _key(settings: Settings) -> str:
    tracker, *rest = settings.items()
    varied = ", ".join(f"{name}={value}" for name, value in rest)
    return f"{tracker[1]}({varied})" if varied else str(tracker[1])


def _seed(seed: int, scene: str, run: int) -> int:
    """Return the seed of a run: the same for all trackers, and another for every recording."""
    return int.from_bytes(hashlib.blake2b(f"{seed}/{scene}/{run}".encode(), digest_size=7).digest())
