"""Two studies, or two parts of one, run by run: by how much they differ and whether that is chance."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probtrack.errors import InputError
from probtrack.evaluation.factors import Factors
from probtrack.evaluation.grouping import Combination, Groups, Numbers
from probtrack.evaluation.pairing import Pairs, Side, paired_runs
from probtrack.evaluation.store import Scores, Store
from probtrack.evaluation.tables import check_level, check_once
from probtrack.metrics.bootstrap import Over, paired_difference

_FLIPS, _FLIPS_EACH = 10_000, 40  # changes of sign: with 20 for each test the smallest p is just 0.05 after Holm


@dataclass(frozen=True)
class Comparison:
    """Differences for each of G rows and J metrics.

    Attributes:
        metrics: Units by name, of J metrics; values of unit "%" are times 100.
        rows: Values of the factors that rows are parted by, G of them; one without factors if there are none.
        first: Mean over pairs of the first (G, J).
        second: That of the second (G, J).
        difference: Mean of first - second (G, J).
        low: Lower end of its interval (G, J).
        high: Upper end (G, J).
        p_value: Of a difference as large by chance (G, J).
        adjusted: The same when all rows and metrics are looked at, by Holm's method (G, J).
        pairs: Runs of both (G, J).
        scenes: Recordings of these (G, J).
        alone: Runs of the first and of the second that have no partner.
        level: Probability of the intervals.
        over: What another study would draw anew.
    """

    metrics: dict[str, str]
    rows: list[Combination]
    first: Numbers
    second: Numbers
    difference: Numbers
    low: Numbers
    high: Numbers
    p_value: Numbers
    adjusted: Numbers
    pairs: NDArray[np.int64]
    scenes: NDArray[np.int64]
    alone: tuple[int, int]
    level: float
    over: Over


def compare(
    first: Side,
    second: Side,
    *,
    by: Sequence[str] = (),
    metrics: Sequence[str] | None = None,
    level: float = 0.95,
    over: Over = "scenes",
) -> Comparison:
    """Return the differences between two studies, or two parts of one, on the same recordings and seeds.

    A run's partner has the same recording, seed and settings, but for the settings that either side chooses. A run's
    value is numerator over denominator, and means are of runs that have a value on both sides; `tabulate` has ratios
    of sums, which are the same where denominators are.

    Args:
        first: One side.
        second: The other one, which is taken away.
        by: Factors that rows are parted by.
        metrics: Names; those of both studies by default.
        level: Probability of the intervals, between 0 and 1.
        over: What is drawn anew, and which signs a permutation test changes, see
            `probtrack.metrics.paired_difference`.

    Raises:
        InputError: for names that are not known, metrics of another unit or definition, and sides without a common
            scene, setting or seed.

    References:
        S. Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal of Statistics 6, 1979.
    """
    check_level(level)
    check_once(by, "by")
    check_once(metrics or (), "metrics")
    names = _metrics(first.store, second.store, metrics)
    pairs = paired_runs(first, second)
    every = Factors.of(pairs.first)
    for name in by:
        every.known(name, "by")
    groups = Groups(pairs.first, by, ())
    flips = max(_FLIPS, _FLIPS_EACH * len(names) * len(groups.rows))
    results = [_differences(first, second, pairs, groups, *metric, level, over, flips) for metric in names.items()]
    columns = [np.stack(part, -1) for part in zip(*results, strict=True)]
    one, other, difference, low, high, p_value, number, scenes = columns
    return Comparison(
        metrics=names,
        rows=groups.rows,
        first=one,
        second=other,
        difference=difference,
        low=low,
        high=high,
        p_value=p_value,
        adjusted=holm(p_value),
        pairs=number,
        scenes=scenes,
        alone=pairs.alone,
        level=level,
        over=over,
    )


def holm(p_values: Numbers) -> Numbers:
    """Return p-values adjusted for their number, such that any below a level are significant together; NaN stays.

    >>> holm(np.array([0.01, 0.04, np.nan, 0.03])).tolist()
    [0.03, 0.06, nan, 0.06]
    """
    adjusted = np.full(p_values.shape, np.nan)
    known = np.flatnonzero(~np.isnan(p_values))
    order = known[np.argsort(p_values.flat[known], kind="stable")]
    steps = p_values.flat[order] * np.arange(len(order), 0, -1)
    adjusted.flat[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return adjusted


def _differences(
    first: Side,
    second: Side,
    pairs: Pairs,
    groups: Groups,
    metric: str,
    unit: str,
    level: float,
    over: Over,
    flips: int,
) -> tuple[NDArray[Any], ...]:
    """Return means, difference, interval, p-value, pairs and scenes (G,) of a metric."""
    partner = {cell.id: other.id for cell, other in zip(pairs.first, pairs.second, strict=True)}
    one, other = (_values(side.store.scores(metric)) for side in (first, second))
    runs = [pairs.runs[cell.scene] for cell in pairs.first]
    paired = Scores(
        np.repeat([cell.id for cell in pairs.first], [len(mine) for mine, _ in runs]),
        np.concatenate([mine for mine, _ in runs]),
        np.concatenate([one[cell.id][mine] for cell, (mine, _) in zip(pairs.first, runs, strict=True)]),
        np.concatenate([other[partner[c.id]][theirs] for c, (_, theirs) in zip(pairs.first, runs, strict=True)]),
    )
    mine, theirs = groups.arrays(paired, over)
    there = ~np.isnan(mine - theirs)
    result = paired_difference(mine, theirs, over=over, level=level, flips=flips)
    number = there.sum((1, 2))
    scale = 100 if unit == "%" else 1
    means = [
        np.divide(np.where(there, part, 0).sum((1, 2)), number, out=np.full(len(number), np.nan), where=number > 0)
        for part in (mine, theirs)
    ]
    figures = [scale * part for part in (*means, result.difference, result.low, result.high)]
    by_scene = groups.arrays(paired, "scenes")
    scenes = (~np.isnan(by_scene[0] - by_scene[1])).any(-1).sum(-1)
    return (*figures, result.p_value, number, scenes)


def _values(scores: Scores) -> dict[int, Numbers]:
    """Return the values of the runs of each cell, NaN where there is nothing to judge."""
    values = np.full(len(scores.numerator), np.nan)
    np.divide(scores.numerator, scores.denominator, out=values, where=scores.denominator != 0)
    cells, begins = np.unique(scores.cell, return_index=True)
    return dict(zip(cells.tolist(), np.split(values, begins[1:]), strict=True))


def _metrics(first: Store, second: Store, wanted: Sequence[str] | None) -> dict[str, str]:
    """Return units by name of the metrics to compare, which both have with one definition."""
    one, other = first.metrics, second.metrics
    common = [name for name in one if name in other]
    names = common if wanted is None else list(wanted)
    for name in names:
        if name not in common:
            raise InputError(f"both studies need metric {name!r}: they have {', '.join(common) or 'none in common'}")
    if not names:
        raise InputError(f"no metric in common: {first.path} has {', '.join(one)}, {second.path} {', '.join(other)}")
    definitions = _definitions(first), _definitions(second)
    for name in names:
        mine, theirs = ((units[name], known.get(name)) for units, known in zip((one, other), definitions, strict=True))
        if mine != theirs:
            where = f"{mine} in {first.path}, {theirs} in {second.path}"
            raise InputError(f"metric {name} is defined in another way: {where}")
    return {name: one[name] for name in names}


def _definitions(store: Store) -> dict[str, Any]:
    entries = store.config.get("metrics", [])
    return dict(zip(store.metrics, entries, strict=True)) if len(entries) == len(store.metrics) else {}
