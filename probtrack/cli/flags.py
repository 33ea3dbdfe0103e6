"""Flags from signatures, and values that users write in their own way: points, regions, channels."""

import inspect
import math
import re
import sys
from argparse import ArgumentError
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

import docstring_parser
from jsonargparse import ArgumentParser, Namespace

from probtrack.errors import InputError

if TYPE_CHECKING:
    from probtrack.geometry import Region

_SPELLINGS = {"three_d": "--3d"}  # a parameter's name cannot begin with a digit, a flag can
_TAKES_COORDINATES = ("--start", "--region")


def parser(command: str, description: str) -> ArgumentParser:
    """Return a parser whose errors are `InputError` rather than an exit with pages of usage."""
    return ArgumentParser(
        prog=f"probtrack {command}",
        description=description,
        exit_on_error=False,
        allow_abbrev=False,
        print_config="--print-config",
        default_env=False,
    )


def add_signature(to: ArgumentParser, function: Callable[..., Any], skip: Collection[str] = ()) -> None:
    """Add a flag for every parameter of `function` with a default, with its docstring's words as help."""
    help_of = {p.arg_name: p.description for p in docstring_parser.parse(inspect.getdoc(function) or "").params}
    hints = get_type_hints(function)
    for name, parameter in inspect.signature(function).parameters.items():
        if name in skip or parameter.default is inspect.Parameter.empty:
            continue
        flag = _SPELLINGS.get(name, "--" + name.replace("_", "-"))
        text = " ".join((help_of.get(name) or "").split())
        if hints[name] is bool:
            to.add_argument(flag, dest=name, action="store_true", default=parameter.default, help=text)
        else:
            to.add_argument(flag, dest=name, type=hints[name], default=parameter.default, help=text)


def parsed(by: ArgumentParser, argv: Sequence[str]) -> Namespace:
    """Parse `argv`; `InputError` says in one line what is wrong with it."""
    try:
        return by.parse_args(_joined(argv))
    except (ArgumentError, ValueError, OSError) as error:
        raise InputError(_plain(str(error))) from None


def _plain(message: str) -> str:
    """Say an error of jsonargparse as its flag, what it wants and what it got, in one line."""
    line = " ".join(message.split())
    line = re.sub(r'Parser key "(\w+)":', lambda key: f"--{key[1].replace('_', '-')}:", line)
    line = re.sub(r"Does not validate .* Given value: (.*)", r"expected a number, got \1", line)
    line = re.sub(r"Expected a typing.Literal\[(.*?)\]\. Got value: (.*)", r"expected one of \1, got '\2'", line)
    line = re.sub(r"Expected a <class '(\w+)'>\. Got value: (.*)", r"expected \1, got \2", line)
    line = re.sub(r"(arguments are required: )\w+\.", r"\1", line)  # without the sub-command
    return re.sub(r"^Problems parsing config:", "--config: not YAML:", line)


def _joined(argv: Sequence[str]) -> list[str]:
    """Join a flag and its coordinates, since argparse takes '-1,2' for another flag."""
    joined: list[str] = []
    for argument in argv:
        if joined and joined[-1] in _TAKES_COORDINATES and re.match(r"-[\d.]", argument):
            joined[-1] += "=" + argument
        else:
            joined.append(argument)
    return joined


def warn(command: str, message: str) -> None:
    """Print one line to standard error."""
    print(f"probtrack {command}: warning: {message}", file=sys.stderr)  # noqa: T201


def array_path(value: str) -> Path:
    """Return the array file that a user means: a path, or the name of one that ships with probtrack."""
    from probtrack.geometry import shipped_arrays  # loads torch, which some commands do without

    return shipped_arrays().get(value, Path(value))


def point(value: str, flag: str) -> tuple[float, ...]:
    """Return 'x,y' or 'x,y,z' as numbers [m]."""
    try:
        numbers = tuple(float(part) for part in value.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in (2, 3) or not all(map(math.isfinite, numbers)):
        raise InputError(f"{flag} must be x,y or x,y,z in metres, got {value!r}")
    return numbers


def region(value: str) -> "Region":
    """Return 'x,y:x,y' or 'x,y,z:x,y,z' (low and high corner) as a region [m]."""
    from probtrack.geometry import Region

    corners = value.split(":")
    if len(corners) != 2:
        raise InputError(f"--region must be LOW:HIGH, two corners such as 0,0:3.5,3.1, got {value!r}")
    return Region(point(corners[0], "--region"), point(corners[1], "--region"))


def channel_numbers(value: str) -> tuple[int, ...]:
    """Return '1,2,5-8' as 0-based channel indices (0, 1, 4, 5, 6, 7)."""
    numbers: list[int] = []
    for part in value.split(","):
        ends = re.fullmatch(r"(\d+)(?:-(\d+))?", part.strip())
        if ends is None or int(ends[1]) < 1:
            raise InputError(f"--channels must be numbers from 1 such as 1,2,5-8, got {value!r}")
        numbers.extend(range(int(ends[1]), int(ends[2] or ends[1]) + 1))
    if len(set(numbers)) != len(numbers) or not numbers:
        raise InputError(f"--channels must name each channel once, got {value!r}")
    return tuple(number - 1 for number in numbers)
