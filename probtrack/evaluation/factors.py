"""Factors of a study: what its cells differ in, by name, in which order and in which words."""

import math
import sys
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from probtrack.errors import InputError
from probtrack.evaluation.store import StoredCell

SCENE = "scene"
"""The factor that tells recordings apart, beside settings and conditions."""

COLUMNS = ("tracker", SCENE, "run", "seed", "seconds", "real_time_factor")
"""What tables have beside varied settings, conditions and metrics."""

_IN_WORDS = {"snr_db": ("SNR", "dB"), "t60": ("T60", "s")}
_SAY_ALL = ("tracker", "model", SCENE)  # their values need no name before them


class Factors(NamedTuple):
    """Names of a study's factors.

    Attributes:
        settings: Of trackers, `tracker` first.
        conditions: Of recordings, such as `snr_db`.
    """

    settings: tuple[str, ...]
    conditions: tuple[str, ...]

    @classmethod
    def of(cls, cells: Sequence[StoredCell]) -> "Factors":
        """Return all factors of `cells`, in the order of the study."""
        names = (dict.fromkeys(name for one in part for name in one) for part in _parts(cells))
        return cls(*map(tuple, names))

    @classmethod
    def varied(cls, cells: Sequence[StoredCell]) -> "Factors":
        """Return those factors of which `cells` have more than one value."""
        pairs = zip(cls.of(cells), _parts(cells), strict=True)
        return cls(*(tuple(n for n in names if len({one.get(n) for one in part}) > 1) for names, part in pairs))

    def known(self, name: str, where: str) -> str:
        """Return `name`, or raise `InputError` that lists the factors there are."""
        every = (*self.settings, *self.conditions, SCENE)
        if name not in every:
            raise InputError(f"{where}: the study has no factor {name!r}: there are {', '.join(every)}")
        return name


def check_names(metrics: Iterable[Any], settings: Iterable[Any], conditions: Iterable[Any]) -> None:
    """Raise `InputError` unless each name can be told from all others, and from what tables have anyway."""
    taken = dict.fromkeys(COLUMNS, "what every table has")
    for where, one, names in (
        ("metrics", "a metric", metrics),
        ("vary", "a varied setting", settings),
        ("conditions", "a condition", conditions),
    ):
        new = list(dict.fromkeys(names))
        for name in new:
            if not (isinstance(name, str) and name.strip() and name.isprintable()):
                raise InputError(f"{where}: a name must be text, in one line and not empty, got {name!r}")
            if name in taken:
                raise InputError(f"{where}: nothing else may be called {name}, the name of {taken[name]}")
        taken |= dict.fromkeys(new, one)


def check_values(values: Sequence[Any], where: str) -> None:
    """Raise `InputError` unless all are finite numbers, texts, true or false, and no two of them the same."""
    seen: dict[str, Any] = {}
    for value in values:
        if not isinstance(value, bool | int | float | str):
            raise InputError(f"{where} must be a number, a text, true or false, got {value!r}")
        same = str(value)
        if isinstance(value, int | float) and not isinstance(value, bool):
            if not abs(value) <= sys.float_info.max:
                raise InputError(f"{where} must be finite, got {value}")
            same = str(float(value))
        if same in seen:
            raise InputError(f"{where}: must differ, got {value} twice")
        seen[same] = value


def values_of(cell: StoredCell) -> dict[str, Any]:
    """Return the value of each factor of a cell by name."""
    return {**cell.settings, **cell.conditions, SCENE: cell.scene}


def in_order(values: Iterable[Any]) -> list[Any]:
    """Return different values: numbers from small to large, names as they come first, None (not known) last.

    >>> in_order([20, None, 5, 20]), in_order(["CU-LAN-ORIG", "CU-LAN"])
    ([5, 20, None], ['CU-LAN-ORIG', 'CU-LAN'])
    """
    different = list(dict.fromkeys(values))
    known = [value for value in different if value is not None]
    if all(is_number(value) for value in known):
        known.sort()
    return known + [None] * (None in different)


def is_number(value: object) -> bool:
    """Return whether a value can be put on an axis."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def text(value: object) -> str:
    """Return a value in words; '-' for what a cell does not have."""
    return "-" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def heading(name: str) -> str:
    """Return what a factor is called over a column or at an axis, with its unit where that is known.

    >>> heading("snr_db"), heading("num_particles")
    ('SNR [dB]', 'num_particles')
    """
    words, unit = _IN_WORDS.get(name, (name, ""))
    return f"{words} [{unit}]" if unit else words


def label(name: str, value: object) -> str:
    """Return a factor and its value in words.

    >>> label("t60", 0.27), label("model", "CU-LAN"), label("num_particles", 75)
    ('T60 0.27 s', 'CU-LAN', 'num_particles 75')
    """
    if name in _SAY_ALL and value is not None:
        return text(value)
    words, unit = _IN_WORDS.get(name, (name, ""))
    return f"{words} {text(value)} {unit if value is not None else ''}".rstrip()


def chosen(cells: Sequence[StoredCell], wanted: Sequence[str], where: str) -> tuple[list[StoredCell], dict[str, str]]:
    """Return the cells that have all values that `wanted` says as `name=value`, and those by name.

    Args:
        cells: Of the study.
        wanted: Such as `["model=CU-LAN", "snr_db=5"]`.
        where: Which argument says so.

    Raises:
        InputError: for a text of another form, a factor or a value that the study does not have.
    """
    every = Factors.of(cells)
    pairs: dict[str, str] = {}
    for one in wanted:
        name, equals, value = one.partition("=")
        if not equals:
            raise InputError(f"{where} must be NAME=VALUE, such as tracker=CU-LAN, got {one!r}")
        values = in_order(values_of(cell).get(every.known(name, where)) for cell in cells)
        if not any(_is(there, value) for there in values):
            raise InputError(f"{where}: no cell has {one}: {name} is {', '.join(map(text, values))}")
        cells = [cell for cell in cells if _is(values_of(cell).get(name), value)]
        pairs[name] = value
    return list(cells), pairs


def _parts(cells: Sequence[StoredCell]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return settings and conditions without those that several cells share as one object, which are most."""
    settings = {id(cell.settings): cell.settings for cell in cells}
    conditions = {id(cell.conditions): cell.conditions for cell in cells}
    return list(settings.values()), list(conditions.values())


def _is(value: object, written: str) -> bool:
    if is_number(value):
        try:
            return float(written) == value
        except ValueError:
            return False
    return text(value) == written
