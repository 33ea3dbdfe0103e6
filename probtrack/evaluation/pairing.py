"""Which runs of two studies, or of two parts of one, belong together: those on one recording with one seed."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from probtrack.errors import InputError
from probtrack.evaluation.factors import SCENE, Factors, chosen, in_order, text, values_of
from probtrack.evaluation.store import Store, StoredCell


class Side(NamedTuple):
    """What is compared: finished cells of a study.

    Attributes:
        store: The study.
        wanted: Which cells, as `name=value`; all if there are none.
        name: How messages call it.
    """

    store: Store
    wanted: Sequence[str] = ()
    name: str = "first"


class Pairs(NamedTuple):
    """Runs of two sides on the same recordings and seeds.

    Attributes:
        first: Cells of the first side that have a partner (n,).
        second: Their partners (n,).
        runs: By scene, numbers of the runs of the first and of the second that have the same seeds.
        alone: Runs of the first and of the second without a partner.
    """

    first: list[StoredCell]
    second: list[StoredCell]
    runs: dict[str, tuple[NDArray[np.intp], NDArray[np.intp]]]
    alone: tuple[int, int]


def paired_runs(first: Side, second: Side) -> Pairs:
    """Return the finished runs of both sides that belong together.

    Raises:
        InputError: where nothing does, or it is not clear what.
    """
    sides = [chosen(_finished(side), side.wanted, side.name) for side in (first, second)]
    (mine, wanted), (theirs, also) = sides
    free = {*wanted, *also}
    settings = _common_settings(first, mine, second, theirs, free)
    partner = _by_key(second, theirs, settings, free)
    _by_key(first, mine, settings, free)
    couples = [(cell, partner[key]) for cell in mine if (key := _key(cell, settings)) in partner]
    if not couples:
        raise InputError(_why_alone(first, mine, second, theirs, settings))
    prints = first.store.fingerprints, second.store.fingerprints
    changed = sorted({a.scene for a, _ in couples if prints[0][a.scene] != prints[1][a.scene]})
    if changed:
        raise InputError(f"scene {changed[0]} is another recording in {second.store.path} than in {first.store.path}")
    seeds = {a.scene: (first.store.seeds(a.scene), second.store.seeds(a.scene)) for a, _ in couples}
    runs = {scene: np.intersect1d(*both, return_indices=True)[1:] for scene, both in seeds.items()}
    couples = [(a, b) for a, b in couples if len(runs[a.scene][0])]
    if not couples:
        raise InputError(f"no seed in common: {first.store.path} and {second.store.path} were run with others")
    number = sum(len(runs[a.scene][0]) for a, _ in couples)
    alone = (sum(cell.runs for cell in mine) - number, sum(cell.runs for cell in theirs) - number)
    return Pairs([a for a, _ in couples], [b for _, b in couples], runs, alone)


def _finished(side: Side) -> list[StoredCell]:
    cells = [cell for cell in side.store.cells if cell.finished is not None]
    if not cells:
        raise InputError(f"{side.store.path}: nothing to compare yet: no cell is finished")
    return cells


def _common_settings(
    first: Side, mine: list[StoredCell], second: Side, theirs: list[StoredCell], free: set[str]
) -> list[str]:
    """Return the settings that partners must share; those of one side alone must not vary."""
    here, there = Factors.of(mine).settings, Factors.of(theirs).settings
    for side, cells, others in ((first, mine, there), (second, theirs, here)):
        for name in Factors.varied(cells).settings:
            if name not in others and name not in free:
                raise InputError(f"{_several(side, cells, name)}, which the other study does not have")
    return [name for name in here if name in there and name not in free]


def _by_key(side: Side, cells: list[StoredCell], settings: list[str], free: set[str]) -> dict[Any, StoredCell]:
    found = {_key(cell, settings): cell for cell in cells}
    if len(found) < len(cells):
        name = next(name for name in Factors.varied(cells).settings if name in free)
        raise InputError(_several(side, cells, name))
    return found


def _several(side: Side, cells: list[StoredCell], name: str) -> str:
    values = in_order(values_of(cell).get(name) for cell in cells)
    return f"{side.name} leaves several values of {name} ({', '.join(map(text, values))}): say one as {name}=VALUE"


def _key(cell: StoredCell, settings: list[str]) -> tuple[Any, ...]:
    return (cell.scene, *(cell.settings.get(name) for name in settings))


def _why_alone(first: Side, mine: list[StoredCell], second: Side, theirs: list[StoredCell], settings: list[str]) -> str:
    for name in (*settings, SCENE):
        here, there = (in_order(values_of(cell).get(name) for cell in cells) for cells in (mine, theirs))
        if not set(here) & set(there):
            ways = "" if name == SCENE else f": choose with {first.name} {name}=... and {second.name} {name}=..."
            said = [", ".join(map(text, values[:3])) + ", ..." * (len(values) > 3) for values in (here, there)]
            return f"no run has a partner: {name} is {said[0]} in one and {said[1]} in the other{ways}"
    return "no run has a partner: no scene and settings are finished in both"
