"""Scenes as YAML, and back: whatever a file says is what a constructor takes."""

import dataclasses
import difflib
import importlib.metadata
import re
from argparse import ArgumentError
from pathlib import Path
from typing import Any, TypeVar

from jsonargparse import ArgumentParser

from probtrack.errors import InputError
from probtrack.simulation.noise import Noise
from probtrack.simulation.rooms import Room
from probtrack.simulation.trajectories import Trajectories, Way
from probtrack.simulation.voices import Turns, Voices

_CHOSEN = (Room, Trajectories, Way, Voices, Turns, Noise)  # families of which a file names the member
_MADE_WITH = ("probtrack", "torch", "pyroomacoustics")

T = TypeVar("T")


def described(value: Any) -> Any:
    """Return a dataclass of plain values, such as a scene, as what YAML can say and `from_description` reads.

    Members of a family (rooms, trajectories, ways, voices, turns, noises) are named by their import path.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        content = {f.name: described(getattr(value, f.name)) for f in dataclasses.fields(value)}
        if isinstance(value, _CHOSEN):
            kind = type(value)
            return {"class_path": f"{kind.__module__}.{kind.__qualname__}", "init_args": content}
        return content
    if isinstance(value, (tuple, list)):
        return [described(item) for item in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise InputError(f"a scene file cannot say a {type(value).__name__}: parts must be dataclasses of plain values")


def from_description(kind: type[T], content: Any, path: str | Path) -> T:
    """Return the `kind` (a dataclass) that `content` says; `path` is named in messages.

    Raises:
        InputError: in one line, for what `kind` does not take.
    """
    if not isinstance(content, dict):
        raise InputError(f"{path}: must be a YAML mapping, got {type(content).__name__}")
    parser = ArgumentParser(exit_on_error=False, default_env=False)
    parser.add_class_arguments(kind, "it")
    try:
        made = parser.instantiate(parser.parse_object({"it": content}))
    except (ArgumentError, InputError, ImportError, ValueError, TypeError) as error:
        raise InputError(f"{path}: {in_plain_words(str(error))}") from None
    return made.it  # type: ignore[no-any-return]


def made_with() -> dict[str, str]:
    """Return the versions that a recording depends on."""
    versions = {}
    for name in _MADE_WITH:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions


def _unknown_class(found: re.Match[str]) -> str:
    """Say that a class is not known, and which one may be meant."""
    names = [str(member.__name__) for family in _CHOSEN for member in type.__subclasses__(family)]
    near = difflib.get_close_matches(found[1], names, 1)
    return f"expected the import path of a class, got {found[1]}" + (f" (do you mean {near[0]}?)" if near else "")


def in_plain_words(message: str) -> str:
    """Say an error of jsonargparse as where it is, what is wanted and what it got, in one line."""
    line = " ".join(message.split())
    line = re.sub(r"Problem with given class_path '[\w.]*?(\w+)':", r"\1:", line)
    line = re.sub(r'Parser key "it\.?([\w.]*)":', lambda key: f"{key[1]}:" if key[1] else "", line)
    line = re.sub(r'Parser key "([\w.]+)":', r"\1:", line)
    line = re.sub(r" Subclass types expect one of:.*", "", line)
    line = re.sub(r"Expected a dot import path string: (\S+)", _unknown_class, line)
    line = re.sub(r"(required: )it\.", r"\1", line)
    line = re.sub(r"Group '(?:it\.)?[\w.]*' does not accept option '([\w.]+)'", r"nothing is called '\1'", line)
    line = re.sub(r"Option '(?:it\.)?([\w.]+)' is not accepted", r"nothing is called '\1'", line)
    line = re.sub(r"Expected a typing\.Literal\[(.*?)\]\. Got value: (.*)", r"expected one of \1, got '\2'", line)
    line = re.sub(r"Expected an? (?:<class ')?([\w. ]+?)(?:'>)?\. Got value: (.*)", r"expected \1, got \2", line)
    line = re.sub(r"Does not validate .* Subtypes: \[(.*)\] Errors: .* Given value: (.*)", r"expected \1, got \2", line)
    line = re.sub(r"(?:<class ')?([\w.\[\], ]+?)(?:'>)?, <class 'NoneType'>", r"\1 or null", line)
    return line.strip()[:500]
