"""Tables of studies: a value and its interval for every combination of what is varied."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from probtrack.errors import InputError
from probtrack.evaluation.factors import SCENE, Factors, in_order, values_of
from probtrack.evaluation.grouping import Combination, Groups, Numbers, ratio
from probtrack.evaluation.store import Store, StoredCell
from probtrack.metrics.bootstrap import Over, bootstrap_interval
from probtrack.metrics.small_samples import none_of_bound

COSTS = {"seconds": "s", "real_time_factor": ""}
"""What a run takes, beside the metrics: seconds of one processor, and those over the seconds of the recording."""


class Completion(NamedTuple):
    """How far a study is.

    Attributes:
        cells: All there are.
        finished: Of these.
        failures: What went wrong with those that failed.
    """

    cells: int
    finished: int
    failures: tuple[str, ...]

    @classmethod
    def of(cls, cells: Sequence[StoredCell]) -> "Completion":
        """Return how far a study with these cells is."""
        failures = tuple(cell.failure for cell in cells if cell.failure is not None)
        return cls(len(cells), sum(cell.finished is not None for cell in cells), failures)

    def __str__(self) -> str:
        failed = f", {len(self.failures)} failed, the first: {self.failures[0]}" if self.failures else ""
        return f"{self.finished} of {self.cells} cells finished{failed}"


@dataclass(frozen=True)
class StudyTable:
    """Figures of a study for each of L rows, C columns and J metrics.

    Attributes:
        path: The store.
        metrics: Units by name, of J metrics; a value of unit "%" is times 100.
        rows: Values of the factors along the rows, L of them.
        columns: Values of the factors along the columns, C of them; one without factors if there are none.
        value: Figures (L, C, J), NaN where there is none.
        low: Lower ends of their intervals (L, C, J); NaN for what a run takes, which is measured and not judged.
        high: Upper ends (L, C, J).
        scenes: Recordings in each group (L, C).
        runs: Finished runs in each group (L, C).
        planned: Runs that each group is to have (L, C).
        fixed: Factors of one value.
        averaged: Factors of several values that are neither along rows nor columns, with their values.
        progress: How far the study is.
        level: Probability of the intervals.
        over: What another study would draw anew.
    """

    path: Path
    metrics: dict[str, str]
    rows: list[Combination]
    columns: list[Combination]
    value: Numbers
    low: Numbers
    high: Numbers
    scenes: NDArray[np.int64]
    runs: NDArray[np.int64]
    planned: NDArray[np.int64]
    fixed: Combination
    averaged: dict[str, list[Any]]
    progress: Completion
    level: float
    over: Over


def tabulate(
    store: Store,
    *,
    rows: Sequence[str] | None = None,
    columns: Sequence[str] | None = None,
    metrics: Sequence[str] | None = None,
    level: float = 0.95,
    over: Over = "scenes",
) -> StudyTable:
    r"""Return figures of a study, finished or not, as ratios of sums with bootstrap intervals.

    .. math:: \hat m = \frac{\sum_{s, r} a_{sr}}{\sum_{s, r} b_{sr}}

    over runs r on recordings s of a group, with numerators a and denominators b. Recordings are drawn anew, and runs
    within them (`over="scenes"`: what another study would give), or runs alone (`over="runs"`: what the same study with
    other seeds would give). A share of none or all has the interval of Clopper and Pearson, of as many draws as there
    are scenes or runs.

    Args:
        store: The study.
        rows: Factors along rows; settings that vary by default, or the rest of what varies if `columns` are given.
        columns: Factors along columns; conditions that vary by default, or the rest of what varies.
        metrics: Names of metrics, `seconds` and `real_time_factor`; all metrics of the study by default.
        level: Probability of the intervals, between 0 and 1.
        over: What is drawn anew.

    Raises:
        InputError: for unknown factors or metrics, with those there are, a level that is none, and a study without any
            finished cell.
    """
    check_level(level)
    cells = started(store)
    names = known_metrics(store, metrics)
    along, across = _layout(cells, rows, columns)
    groups = Groups(cells, along, across)
    shape = (len(groups.rows), len(groups.columns))
    value, low, high = (part.T.reshape(*shape, -1) for part in _figures(store, groups, names, level, over))
    fixed, averaged = _left_out(cells, (*along, *across))
    return StudyTable(
        path=store.path,
        metrics=names,
        rows=groups.rows,
        columns=groups.columns,
        value=value,
        low=low,
        high=high,
        scenes=groups.scenes.reshape(shape),
        runs=groups.runs.reshape(shape),
        planned=groups.planned.reshape(shape),
        fixed=fixed,
        averaged=averaged,
        progress=Completion.of(cells),
        level=level,
        over=over,
    )


def check_level(level: float) -> None:
    """Raise `InputError` unless `level` is a probability that an interval can have."""
    if not 0 < level < 1:
        raise InputError(f"level must lie between 0 and 1, got {level:g}")


def check_once(names: Sequence[str], where: str) -> None:
    """Raise `InputError` where one of `names` comes twice; `where` is the argument that has them."""
    for i, name in enumerate(names):
        if name in names[:i]:
            raise InputError(f"{where} must differ, got {name} twice")


def started(store: Store) -> list[StoredCell]:
    """Return all cells of a study, or raise `InputError` if none of them is finished."""
    cells = store.cells
    progress = Completion.of(cells)
    if not progress.finished:
        raise InputError(f"{store.path}: nothing to show yet: {progress}")
    return cells


def known_metrics(store: Store, wanted: Sequence[str] | None) -> dict[str, str]:
    """Return units of the `wanted` metrics, all by default, or raise `InputError` that lists those there are."""
    check_once(wanted or (), "metrics")
    there = store.metrics
    known = {**COSTS, **there}
    for name in wanted or ():
        if name not in known:
            raise InputError(f"{store.path}: has no metric {name!r}: there are {', '.join([*there, *COSTS])}")
    return there if wanted is None else {name: known[name] for name in wanted}


def _layout(
    cells: Sequence[StoredCell], rows: Sequence[str] | None, columns: Sequence[str] | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the factors along rows and columns, of which what is not said is what varies."""
    every, varied = Factors.of(cells), Factors.varied(cells)
    for where, names in (("rows", rows), ("columns", columns)):
        check_once(names or (), where)
        for name in names or ():
            every.known(name, where)
    twice = sorted(set(rows or ()) & set(columns or ()))
    if twice:
        raise InputError(f"{twice[0]} can be along rows or along columns, not both")
    if rows is None and columns is None:
        return varied.settings or ("tracker",), varied.conditions
    named = (*(rows or ()), *(columns or ()))
    conditions = () if SCENE in named else varied.conditions  # a scene has one of each
    rest = tuple(name for name in (*varied.settings, *conditions) if name not in named)
    return tuple(rest if rows is None else rows), tuple(rest if columns is None else columns)


def _figures(
    store: Store, groups: Groups, names: dict[str, str], level: float, over: Over
) -> tuple[Numbers, Numbers, Numbers]:
    """Return values and both ends of intervals (J, G) of metrics and costs."""
    costs = {"seconds": groups.seconds, "real_time_factor": groups.real_time_factors}
    there = store.metrics
    value, low, high = (np.full((len(names), groups.planned.size), np.nan) for _ in range(3))
    judged = [j for j, name in enumerate(names) if name in there]
    for j, name in enumerate(names):
        if j not in judged:
            value[j] = costs[name]()
    if judged:
        parts = [groups.arrays(store.scores(name), over) for name in names if name in there]
        total, count = (np.stack(part) for part in zip(*parts, strict=True))  # at once: resamples are drawn one time
        value[judged] = ratio(np.nansum(total, (2, 3)), np.nansum(count, (2, 3)))
        interval = bootstrap_interval(total, count, level=level, over=over)
        low[judged], high[judged] = interval
        for j, above, below in zip(judged, total, count, strict=True):
            if list(names.values())[j] == "%":
                _bound_none_and_all(low[j], high[j], above, below, level, over)
    shown = np.array([100.0 if unit == "%" else 1.0 for unit in names.values()])[:, None]
    return shown * value, shown * low, shown * high


def _bound_none_and_all(low: Numbers, high: Numbers, total: Numbers, count: Numbers, level: float, over: Over) -> None:
    """Give shares of none or all, whose draws are all alike, the exact interval (G,) of as many draws (G, S, R)."""
    judged = count > 0
    draws = judged.any(-1).sum(-1) if over == "scenes" else judged.sum((-2, -1))
    found, possible = np.nansum(total, (-2, -1)), np.nansum(count, (-2, -1))
    for group in np.flatnonzero(np.isfinite(low)):
        if found[group] == 0:
            high[group] = none_of_bound(level, int(draws[group]))
        elif found[group] == possible[group]:
            low[group] = 1 - none_of_bound(level, int(draws[group]))


def _left_out(cells: Sequence[StoredCell], named: Sequence[str]) -> tuple[Combination, dict[str, list[Any]]]:
    """Return the factors of one value, and those of several that are averaged over."""
    every, varied = Factors.of(cells), Factors.varied(cells)
    fixed = [*every.settings, *every.conditions]
    fixed = [name for name in fixed if name not in (*named, *varied.settings, *varied.conditions)]
    rest = (*varied.settings, *(() if SCENE in named else varied.conditions))
    averaged = {name: in_order(values_of(cell).get(name) for cell in cells) for name in rest if name not in named}
    return {name: values_of(cells[0])[name] for name in fixed}, averaged
