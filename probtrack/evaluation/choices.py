"""Trackers and metrics as a study file says them, and what is made of that."""

import hashlib
import importlib
import inspect
import itertools
import os
import traceback
from argparse import ArgumentError
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jsonargparse import ArgumentParser

from probtrack import metrics, trackers
from probtrack.errors import InputError
from probtrack.evaluation.factors import check_values
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
        _check_plain(made.init_args, where)
        return made


class Contender(NamedTuple):
    """A tracker with one combination of the settings that vary.

    Attributes:
        settings: Its name as `tracker`, and what is varied, by name.
        make: Makes the tracker for an array and a region.
        arguments: Keyword arguments of that.
        files: The files among them, and what tells their content from others.
    """

    settings: Settings
    make: Callable[..., Tracker]
    arguments: Settings
    files: dict[str, str]

    @property
    def key(self) -> str:
        """What tells it from the others, in words."""
        tracker, *rest = self.settings.items()
        varied = ", ".join(f"{name}={value}" for name, value in rest)
        return f"{tracker[1]}({varied})" if varied else str(tracker[1])

    def tracker(self, folder: SceneFolder) -> Tracker:
        """Return the tracker for a recording, or raise `InputError`, before hours of work and not after."""
        try:
            made = self.make(folder.array, folder.region, **self.arguments)
        except Exception as error:  # whatever a tracker of one's own raises
            raise InputError(f"trackers: {self.key}: {_said(error)}") from None
        if not isinstance(made, Tracker):
            raise InputError(f"trackers: {self.key}: must make a Tracker, made a {type(made).__name__}")
        return made


def metric_of(entry: Any) -> metrics.TrackMetric:
    """Return the metric that an entry of a study file names."""
    choice = Choice.of(entry, "metrics")
    where = f"metrics: {choice.class_path}"
    known = metrics.known()
    kind = known.get(choice.class_path) or _imported(choice.class_path, "metrics", list(known))
    if not (isinstance(kind, type) and issubclass(kind, metrics.TrackMetric)):
        raise InputError(f"{where} is no TrackMetric")
    try:
        metric = from_description(kind, choice.init_args, where)
    except InputError:
        raise
    except Exception as error:  # whatever a metric of one's own raises
        raise InputError(f"{where}: {_said(error)}") from None
    if choice.name is not None:
        metric.name = choice.name
    if not hasattr(metric, "name"):
        raise InputError(f"{where} has no name: its class, or the study file, must give it one")
    return metric


def contenders(chosen: Mapping[str, Any], vary: Mapping[str, Sequence[Any]], base: Path) -> Iterator[Contender]:
    """Yield each tracker with every combination of the settings that vary.

    Args:
        chosen: What each tracker is, by name.
        vary: Values of settings, by name.
        base: Folder from which files are named.

    Raises:
        InputError: for what is not there, cannot be imported or does not take the settings.
    """
    for varied, values in vary.items():
        if not values:
            raise InputError(f"vary: {varied} must be a list of values, at least one")
        check_values(values, f"vary: {varied}")
    for name, entry in chosen.items():
        where = f"trackers: {name}"
        choice = Choice.of(entry, where)
        make = TRACKERS.get(choice.class_path) or _imported(choice.class_path, where, list(TRACKERS))
        if not callable(make):
            raise InputError(f"{where}: {choice.class_path} makes no tracker")
        twice = next((varied for varied in vary if varied in choice.init_args), None)
        if twice is not None:
            raise InputError(f"{where}: {twice} is varied, so init_args cannot say it too")
        for combination in itertools.product(*vary.values()):
            settings = dict(zip(vary, combination, strict=True))
            files: dict[str, str] = {}
            given = {key: _file(value, base, files) for key, value in {**choice.init_args, **settings}.items()}
            yield Contender({"tracker": name, **settings}, make, _arguments(make, given, where), files)


def content_hash(path: str | Path) -> str:
    """Return what tells the content of a file from others; of one that is not there, too."""
    path = Path(path)
    return hashlib.sha256(path.read_bytes() if path.exists() else b"none").hexdigest()[:16]


def _imported(path: str, where: str, known: list[str]) -> Any:
    """Return what an import path names, or raise `InputError` that lists the `known` names."""
    module, _, name = path.rpartition(".")
    if not module:
        raise InputError(f"{where}: nothing is called {path!r}: there are {', '.join(known)}, and import paths")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise InputError(f"{where}: cannot import {path}: {_in_one_line(error)}") from None
    except (Exception, SystemExit) as error:  # whatever a module of one's own raises
        raise InputError(f"{where}: cannot import {path}: {_said(error)}") from None


def _arguments(make: Callable[..., Tracker], given: Settings, where: str) -> Settings:
    """Return the arguments `given` as `make` takes them, checked against its signature."""
    try:
        parameters = inspect.signature(make).parameters
    except ValueError as error:  # of a few that are not written in Python
        raise InputError(f"{where}: {_in_one_line(error)}") from None
    names = list(parameters)[2:]  # after the array and the region
    unknown = next((name for name in given if name not in names), None)
    if unknown is not None and all(one.kind is not one.VAR_KEYWORD for one in parameters.values()):
        raise InputError(f"{where}: has no setting {unknown}: there are {', '.join(names) or 'none'}")
    parser = ArgumentParser(exit_on_error=False, default_env=False)
    try:
        skip: set[str | int] = {*list(parameters)[:2]}
        add = parser.add_class_arguments if inspect.isclass(make) else parser.add_function_arguments
        add(make, "it", skip=skip)
        taken = parser.instantiate(parser.parse_object({"it": given})).get("it")  # None of one without settings
    except (ArgumentError, InputError, ImportError, ValueError, TypeError) as error:
        raise InputError(f"{where}: {in_plain_words(str(error))}") from None
    return {name: taken[name] for name in given}


def _file(value: Any, base: Path, files: dict[str, str]) -> Any:
    """Return a setting; one that names a file as its path from anywhere, with what is in it noted in `files`.

    A word is never a file: `parameters: learned` stays what it is, whatever lies beside the study file.
    """
    if not isinstance(value, str) or not (Path(value).suffix or os.path.dirname(value)):
        return value
    path = base / value
    if not path.is_file():
        return value
    files[value] = content_hash(path)
    return str(path.resolve())


def _check_plain(value: Any, where: str) -> None:
    """Raise `InputError` for what a store cannot keep and compare: NaN, infinity, and what is no plain value."""
    if isinstance(value, dict):
        for name, inner in value.items():
            _check_plain(inner, f"{where}: {name}")
    elif isinstance(value, list):
        for inner in value:
            _check_plain(inner, where)
    elif value is not None:
        check_values([value], where)


def _in_one_line(error: BaseException) -> str:
    return " ".join(str(error).split())


def _said(error: BaseException) -> str:
    """Say what went wrong: what probtrack says as it is, anything else with its kind and where it is."""
    if isinstance(error, InputError):
        return str(error)
    said = f"{type(error).__name__}: {_in_one_line(error)}"
    last = traceback.extract_tb(error.__traceback__)[-1]
    if "importlib" in last.filename or last.filename == __file__:
        return said
    return f"{said} ({Path(last.filename).name}, line {last.lineno})"
