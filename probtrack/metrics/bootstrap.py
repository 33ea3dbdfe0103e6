"""How far a figure of a study can be trusted: bootstrap intervals, and the significance of differences.

Needs numpy alone. Values are of S scenes with up to R runs each, in groups (the cells of a table) that are worked on at
once: the resamples are drawn one time, as counts of each run, and all groups' sums are one matrix product.
"""

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probtrack.errors import InputError, NotFiniteError, ShapeError
from probtrack.metrics.small_samples import expanded_tail

Over = Literal["scenes", "runs"]
Array = NDArray[np.float64]

_ENUMERATED = 12  # units up to which all changes of sign are tried
_AT_ONCE = 2**22  # counts of runs, or signs, held in memory


class Interval(NamedTuple):
    """A bootstrap interval.

    Attributes:
        low: Lower end (*groups), NaN where there is too little to resample.
        high: Upper end (*groups).
    """

    low: Array
    high: Array


class PairedDifference(NamedTuple):
    """By how much one thing is above another on the same scenes and seeds.

    Attributes:
        difference: Mean difference over all pairs (*groups).
        low: Lower end of its bootstrap interval (*groups).
        high: Upper end (*groups).
        p_value: Of a difference as large in size by chance (*groups), NaN where there is no pair.
    """

    difference: Array
    low: Array
    high: Array
    p_value: Array


def bootstrap_interval(
    total: ArrayLike,
    count: ArrayLike,
    *,
    over: Over,
    level: float = 0.95,
    replicates: int = 4000,
    seed: int = 0,
) -> Interval:
    r"""Return the expanded percentile interval of the ratio of sums :math:`\sum_{sr} a_{sr} / \sum_{sr} n_{sr}`.

    Over "runs", runs are drawn again within the scenes that there are: what a repetition of the study would give. Over
    "scenes", scenes are drawn again and runs within each that was drawn: what other scenes like these would give. The
    quantiles of the resamples are further out than those of `level`, by what few units want: scenes, or runs within
    scenes (`probtrack.metrics.small_samples.expanded_tail`). Of two or three scenes the interval is still too narrow,
    since no resample is beyond the scenes that there are. It is NaN of fewer than two scenes, or where no scene has two
    runs.

    Args:
        total: Numerator of each run (*groups, S, R), as metrics give it; NaN where there is no such run.
        count: Denominator (*groups, S, R).
        over: "scenes" or "runs".
        level: Of the interval, in (0, 1).
        replicates: How often to resample.
        seed: Of the resampling.

    Raises:
        InputError: for settings out of range.
        ShapeError: if the two differ in shape or have no axes of scenes and runs.
        NotFiniteError: if a value is infinite.

    References:
        B. Efron, R. J. Tibshirani, "An introduction to the bootstrap", 1993, sections 13.3 (percentile interval) and
        8.3 (data of two levels).
        T. C. Hesterberg, "What teachers should know about the bootstrap", The American Statistician 69(4), 2015
        (expanded percentile interval).
    """
    totals, counts = _checked(total, count)
    _check_settings(over, level, replicates)
    *groups, scenes, runs = totals.shape
    totals, counts = totals.reshape(-1, scenes * runs), counts.reshape(-1, scenes * runs)
    low, high = np.full(len(totals), np.nan), np.full(len(totals), np.nan)
    for members, there in _layouts(~np.isnan(totals + counts).reshape(-1, scenes, runs)):
        sizes = there.sum(-1)
        if (over == "scenes" and (sizes > 0).sum() < 2) or sizes.max(initial=0) < 2 - (over == "scenes"):
            continue
        sums, weights = _resampled_sums(totals[members], counts[members], there, over, replicates, seed)
        with np.errstate(invalid="ignore", divide="ignore"):
            ratios = np.where(weights > 0, sums / weights, np.nan)
        present = int((sizes > 0).sum())
        units, strata = (present, 1) if over == "scenes" else (int(sizes.sum()), present)
        low[members], high[members] = _quantiles(ratios, expanded_tail(level, units, strata))
    return Interval(low.reshape(groups), high.reshape(groups))


def paired_difference(
    first: ArrayLike,
    second: ArrayLike,
    *,
    over: Over,
    level: float = 0.95,
    replicates: int = 4000,
    flips: int = 10_000,
    seed: int = 0,
) -> PairedDifference:
    """Return how far `first` is above `second` on the same scenes and seeds, and how likely that is chance.

    The interval is that of `bootstrap_interval`. The p-value is of a permutation test: if nothing tells the two apart,
    each pair's difference (over "runs"), or all differences of a scene at once (over "scenes"), may have either sign.
    All changes of sign are tried for up to 12 pairs or scenes, `flips` random ones and the one at hand for more, so
    that it is never below 1 / (1 + flips); nor below 2^(1-S) for S scenes, whatever the difference. Of many tests at
    once `flips` should be 40 for each, or none can be significant.

    Args:
        first: One value of each run (*groups, S, R); NaN where there is none.
        second: Those of the other (*groups, S, R), run by run of the same scene and seed.
        over: "scenes" or "runs".
        level: Of the interval, in (0, 1).
        replicates: How often to resample for the interval.
        flips: How many changes of sign to try.
        seed: Of both.

    Raises:
        InputError: for settings out of range.
        ShapeError: if the two differ in shape or have no axes of scenes and runs.
        NotFiniteError: if a value is infinite.

    References:
        B. Phipson, G. K. Smyth, "Permutation p-values should never be zero", Statistical Applications in Genetics and
        Molecular Biology 9(1), 2010, eq. (2).
    """
    one, other = _checked(first, second)
    _check_settings(over, level, replicates)
    if flips < 1:
        raise InputError(f"flips must be at least 1, got {flips}")
    difference = one - other
    there = ~np.isnan(difference)
    pairs = there.sum((-2, -1))
    mean = np.where(pairs > 0, np.nansum(difference, (-2, -1)) / np.maximum(pairs, 1), np.nan)
    low, high = bootstrap_interval(
        difference, np.where(there, 1.0, np.nan), over=over, level=level, replicates=replicates, seed=seed
    )
    units = np.nan_to_num(difference)
    units = units.sum(-1) if over == "scenes" else units.reshape(*units.shape[:-2], -1)
    p_value = _sign_flips(units.reshape(-1, units.shape[-1]), flips, seed).reshape(pairs.shape)
    return PairedDifference(mean, low, high, np.where(pairs > 0, p_value, np.nan))


def _sign_flips(units: Array, flips: int, seed: int) -> Array:
    """Return the share of changes of sign (G,) whose sum of `units` (G, U) is as large in size as that at hand."""
    exact = units.shape[1] <= _ENUMERATED
    # sums of the same terms in another order differ by rounding: they are as large
    least = np.abs(units.sum(1)) - 1e-12 * np.abs(units).sum(1)
    reached = np.zeros(len(units))
    for signs in _signs(units.shape[1], None if exact else flips, seed):
        reached += (np.abs(signs @ units.T) >= least).sum(0)
    return np.asarray(reached / 2 ** units.shape[1] if exact else (reached + 1) / (flips + 1))


def _signs(count: int, flips: int | None, seed: int) -> Iterator[Array]:
    """Yield changes of sign (some, count): all if `flips` is None, else as many random ones, in pieces."""
    if flips is None:
        yield np.where((np.arange(2**count)[:, None] >> np.arange(count)) & 1, -1.0, 1.0)
        return
    rng, most = np.random.default_rng(seed), max(1, _AT_ONCE // count)
    for done in range(0, flips, most):
        some = min(most, flips - done)
        drawn = np.frombuffer(rng.bytes(-(-some * count // 8)), np.uint8)
        yield np.where(np.unpackbits(drawn, count=some * count).reshape(some, count), -1.0, 1.0)


def _resampled_sums(
    totals: Array, counts: Array, there: NDArray[np.bool_], over: Over, replicates: int, seed: int
) -> tuple[Array, Array]:
    """Return the sums of `totals` and `counts` (G, S R) over resamples of the runs `there` (replicates, G)."""
    kept, rng = there.ravel(), np.random.default_rng(seed)
    both = np.concatenate([totals[:, kept], counts[:, kept]]).T
    some = max(1, _AT_ONCE // there.size)
    pieces = [
        _resampled(there, over, min(some, replicates - done), rng)[:, kept] @ both
        for done in range(0, replicates, some)
    ]
    sums, weights = np.split(np.concatenate(pieces), 2, axis=1)
    return sums, weights


def _resampled(there: NDArray[np.bool_], over: Over, replicates: int, rng: np.random.Generator) -> Array:
    """Return how often each run (replicates, S R) of those `there` (S, R) is drawn."""
    scenes, runs = there.shape
    sizes = there.sum(-1)
    if over == "scenes":
        present = np.flatnonzero(sizes)
        drawn = present[rng.integers(len(present), size=(replicates, len(present)))]
    else:
        drawn = np.broadcast_to(np.arange(scenes), (replicates, scenes))
    size = sizes[drawn][..., None]  # of the scene that was drawn
    rank = (rng.random((*drawn.shape, runs)) * size).astype(np.int64)
    # runs that are there come first in each scene's order
    order = np.argsort(~there, axis=1, kind="stable")
    cell = drawn[..., None] * runs + order[drawn[..., None], rank]
    cell += np.arange(replicates)[:, None, None] * (scenes * runs)
    made = np.bincount(cell[np.arange(runs) < size], minlength=replicates * scenes * runs)
    return made.reshape(replicates, scenes * runs).astype(np.float64)


def _layouts(there: NDArray[np.bool_]) -> Iterator[tuple[NDArray[np.intp], NDArray[np.bool_]]]:
    """Yield which groups have the same runs, and these (S, R)."""
    members: dict[bytes, list[int]] = {}
    for i, layout in enumerate(there):
        members.setdefault(layout.tobytes(), []).append(i)
    for alike in members.values():
        yield np.array(alike), there[alike[0]]


def _quantiles(values: Array, tail: float) -> tuple[Array, Array]:
    """Return the ends of `values` (replicates, G) without a share `tail` at either, NaN of those that hold a NaN."""
    values = np.sort(values, axis=0)  # NaN comes last
    unknown = np.isnan(values[-1])
    low, high = np.quantile(np.where(unknown, 0.0, values), [tail, 1 - tail], axis=0)
    return np.where(unknown, np.nan, low), np.where(unknown, np.nan, high)


def _checked(first: ArrayLike, second: ArrayLike) -> tuple[Array, Array]:
    one, other = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if one.shape != other.shape or one.ndim < 2 or 0 in one.shape[-2:]:
        raise ShapeError(f"both must have one shape (..., scenes, runs), got {one.shape} and {other.shape}")
    if np.isinf(one).any() or np.isinf(other).any():
        raise NotFiniteError("values must be finite, or NaN where there is no run, got an infinite one")
    return one, other


def _check_settings(over: str, level: float, replicates: int) -> None:
    if over not in ("scenes", "runs"):
        raise InputError(f"over must be scenes or runs, got {over}")
    if not 0 < level < 1:
        raise InputError(f"level must be above 0 and below 1, got {level}")
    if replicates < 1:
        raise InputError(f"replicates must be at least 1, got {replicates}")
