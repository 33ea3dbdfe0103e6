"""Bootstrap intervals and sign-flip tests: what they hold on simulated studies, and scipy's on a case."""

import math
import subprocess
import sys

import numpy as np
import pytest
from scipy import stats

from probtrack.errors import InputError, NotFiniteError, ShapeError
from probtrack.metrics import bootstrap, bootstrap_interval, paired_difference
from probtrack.metrics.small_samples import expanded_tail, student_quantile

STUDIES = 3000


def studies(scenes, runs, *, between=1.0, within=0.5, seed=1):
    """Values of many studies (STUDIES, S, R) of one design: normal scenes about 0, normal runs about each."""
    rng = np.random.default_rng(seed)
    of_scenes = between * rng.standard_normal((STUDIES, scenes, 1))
    return of_scenes, of_scenes + within * rng.standard_normal((STUDIES, scenes, runs))


def share_inside(interval, truth):
    return np.mean((interval.low <= truth) & (truth <= interval.high))


def test_interval_over_runs_holds_the_mean_of_these_scenes():
    of_scenes, values = studies(3, 30)
    interval = bootstrap_interval(values, np.ones_like(values), over="runs", replicates=1000)
    assert abs(share_inside(interval, of_scenes.mean((1, 2))) - 0.95) < 5 * math.sqrt(0.05 * 0.95 / STUDIES)


@pytest.mark.parametrize(("scenes", "bias"), [(5, 0.02), (20, 0.01)])
@pytest.mark.parametrize("level", [0.8, 0.95])
def test_interval_over_scenes_holds_the_mean_of_all_scenes_however_few(scenes, level, bias):
    """Of one run each, so that nothing but scenes is drawn; resampled means of few have shorter tails than normal."""
    _, values = studies(scenes, 1)
    interval = bootstrap_interval(values, np.ones_like(values), over="scenes", replicates=1000, level=level)
    assert abs(share_inside(interval, 0.0) - level) < bias + 5 * math.sqrt(level * (1 - level) / STUDIES)


@pytest.mark.parametrize("freedom", [1, 2, 3, 4, 5, 8, 19, 60, 333, 4000, 100_001])
def test_quantiles_of_student_are_scipys(freedom):
    for level in (0.2, 0.95, 0.9999):
        expected = stats.t(freedom).ppf((1 + level) / 2)
        assert student_quantile(level, freedom) == pytest.approx(expected, rel=1e-9)


def test_tail_is_hesterbergs_and_that_of_the_level_for_many():
    assert expanded_tail(0.9, 7) == pytest.approx(stats.norm.cdf(math.sqrt(7 / 6) * stats.t(6).ppf(0.05)), rel=1e-9)
    assert expanded_tail(0.9, 14, 3) == pytest.approx(stats.norm.cdf(math.sqrt(14 / 11) * stats.t(11).ppf(0.05)))
    assert expanded_tail(0.9, 10**5) == pytest.approx(0.05, rel=1e-3)
    assert 0 <= expanded_tail(0.95, 2) < 1e-60


def test_width_over_scenes_is_that_of_both_levels_and_over_runs_of_one():
    scenes, runs = 12, 7
    _, values = studies(scenes, runs)
    between = (1 + 0.25 / runs) * (scenes - 1) / scenes**2
    within = 0.25 * (runs - 1) / runs / (scenes * runs)
    for over, variance, strata, units in (
        ("scenes", between + within, 1, scenes),
        ("runs", within, scenes, scenes * runs),
    ):
        interval = bootstrap_interval(values, np.ones_like(values), over=over, replicates=1000)
        # squares of widths are chi-square about it; resampling 1000 times adds a few per cent to each, alike to all
        deviations = stats.norm.isf(expanded_tail(0.95, units, strata))
        mean = np.mean(((interval.high - interval.low) / (2 * deviations)) ** 2)
        assert mean == pytest.approx(variance, rel=0.12)


def test_resamples_in_pieces_are_resamples(monkeypatch):
    _, values = studies(4, 9)
    arguments = values[:50], np.ones_like(values[:50])
    whole = bootstrap_interval(*arguments, over="scenes", level=0.5)
    monkeypatch.setattr(bootstrap, "_AT_ONCE", 4 * 9 * 7)
    pieces = bootstrap_interval(*arguments, over="scenes", level=0.5)
    # a quartile of 4000 normal draws has a standard error of 0.022 of their deviation, 0.016 of the middle half
    tolerance = 5 * math.sqrt(2) * 0.016 * (whole.high - whole.low)
    assert (np.abs(np.subtract(whole, pieces)) < tolerance).all()
    assert (whole.low != pieces.low).all()


def test_interval_is_scipys_of_one_scene():
    rng = np.random.default_rng(5)
    count = rng.integers(1, 9, 25).astype(float)
    total = count * rng.gamma(2.0, 0.3, 25)
    mine = bootstrap_interval(total[None], count[None], over="runs", replicates=20_000, level=0.9)
    same = 1 - 2 * expanded_tail(0.9, 25)
    theirs = stats.bootstrap(
        (total, count), lambda a, b, axis: a.sum(axis) / b.sum(axis), paired=True, vectorized=True,
        n_resamples=20_000, confidence_level=same, method="percentile", rng=rng,
    )  # fmt: skip
    # standard error of a 5 % quantile of 20 000 normal draws: 0.015 of their deviation, in both
    tolerance = 5 * math.sqrt(2) * 0.015 * theirs.standard_error
    assert mine.low == pytest.approx(theirs.confidence_interval.low, abs=tolerance)
    assert mine.high == pytest.approx(theirs.confidence_interval.high, abs=tolerance)


def test_ratios_are_of_sums():
    total, count = (
        np.array([[[2.0, 0.0, 3.0], [0.0, 8.0, 4.0]]] * 2),
        np.array([[[2.0, 0.0, 3.0], [0.0, 8.0, 4.0]]] * 2),
    )
    interval = bootstrap_interval(total, count * [[[1.0]], [[4.0]]], over="runs", replicates=50)
    np.testing.assert_allclose(interval, [[1, 0.25]] * 2)


@pytest.mark.parametrize("over", ["runs", "scenes"])
def test_groups_get_what_they_get_alone_however_ragged(over):
    rng = np.random.default_rng(2)
    total, count = rng.random((4, 3, 5)), rng.random((4, 3, 5))
    total[1, 2, 3:], total[2, 0, :2], total[3, 1] = np.nan, np.nan, np.nan
    whole = bootstrap_interval(total, count, over=over)
    for group in range(4):
        alone = bootstrap_interval(total[group], count[group], over=over)
        np.testing.assert_allclose([whole.low[group], whole.high[group]], alone, rtol=1e-12)


def test_runs_that_are_not_there_are_never_drawn():
    total = np.full((3, 4), np.nan)
    total[0, [1, 3]], total[2, 2:] = [0.0, 1.0], [5.0, 7.0]
    low, high = bootstrap_interval(total, np.ones((3, 4)), over="runs", level=0.9999)
    assert (low, high) == ((0 + 0 + 5 + 5) / 4, (1 + 1 + 7 + 7) / 4)


def test_scenes_that_are_drawn_twice_weigh_twice():
    total = np.array([[0.0, 0.0, 0.0], [1.0, np.nan, np.nan]])
    low, high = bootstrap_interval(total, np.ones((2, 3)), over="scenes", level=0.99)
    assert (low, high) == (0.0, 1.0)  # the same scene twice
    middle = bootstrap_interval(total, np.ones((2, 3)), over="scenes", level=0.02)
    np.testing.assert_allclose(middle, 1 / 4)  # one of each: a run in four is the lone one


@pytest.mark.parametrize(("over", "shape"), [("scenes", (1, 5)), ("runs", (3, 1))])
def test_too_little_to_resample_has_no_interval(over, shape):
    assert np.isnan(bootstrap_interval(np.ones(shape), np.ones(shape), over=over)).all()


def test_a_seed_gives_the_same_interval_and_another_another():
    values = studies(4, 9)[1][0]
    first, again, other = (bootstrap_interval(values, np.ones_like(values), over="runs", seed=s) for s in (1, 1, 2))
    assert first == again
    assert first != other


def test_difference_is_the_mean_over_the_pairs_that_there_are():
    first, second = np.array([[1.0, 2.0, np.nan], [4.0, 8.0, 5.0]]), np.array([[0.5, np.nan, 7.0], [1.0, 6.0, 5.0]])
    result = paired_difference(first, second, over="runs")
    assert result.difference == (0.5 + 3 + 2 + 0) / 4
    assert result.low < result.difference < result.high
    swapped = paired_difference(second, first, over="runs")
    np.testing.assert_allclose([swapped.low, swapped.high], [-result.high, -result.low], atol=0.3)
    assert swapped.p_value == result.p_value


@pytest.mark.parametrize("count", [7, 10])
def test_p_value_of_few_pairs_is_scipys(count):
    rng = np.random.default_rng(count)
    first, second = rng.standard_normal((2, count))
    first += 0.6
    theirs = stats.permutation_test(
        (first, second), lambda a, b, axis: np.mean(a - b, axis), permutation_type="samples", vectorized=True,
        n_resamples=2**count,
    )  # fmt: skip
    assert paired_difference(first[None], second[None], over="runs").p_value == pytest.approx(theirs.pvalue)


@pytest.mark.parametrize("at_once", [2**22, 17 * 13])
def test_p_value_of_more_pairs_is_that_of_all_changes_of_sign(monkeypatch, at_once):
    """In pieces or at once; 17 pairs of like size, of which binomial(17) have the sign of the difference."""
    monkeypatch.setattr(bootstrap, "_AT_ONCE", at_once)
    first = np.array([[1.0] * 12 + [-1.0] * 5])
    expected = stats.binomtest(5, 17).pvalue
    found = paired_difference(first, np.zeros((1, 17)), over="runs", replicates=9, flips=5000).p_value
    assert abs(found - expected) < 5 * math.sqrt(expected * (1 - expected) / 5000)
    other = paired_difference(first, np.zeros((1, 17)), over="runs", replicates=9, flips=5000, seed=1).p_value
    assert other != found


def test_p_value_of_scenes_flips_whole_scenes():
    difference = np.array([[1.0, 1.0, 1.0], [2.0, 0.0, np.nan], [-0.5, -0.5, -0.5]])  # sums 3, 2, -1.5
    # as large as 3.5 in size: 3+2-1.5, 3+2+1.5 and their negatives, of eight
    assert paired_difference(difference, np.zeros((3, 3)), over="scenes").p_value == pytest.approx(4 / 8)


def test_p_value_is_never_zero_and_all_ties_count():
    shift = paired_difference(np.full((2, 40), 3.0), np.zeros((2, 40)), over="runs", flips=99)
    assert shift.p_value == pytest.approx(1 / 100)
    assert paired_difference(np.full((5, 2), 0.1), np.zeros((5, 2)), over="scenes").p_value == pytest.approx(2 / 32)
    assert paired_difference(np.ones((4, 5)), np.ones((4, 5)), over="runs").p_value == 1


@pytest.mark.parametrize(("over", "scenes", "runs"), [("runs", 5, 8), ("scenes", 6, 4)])
def test_p_values_are_uniform_where_nothing_differs(over, scenes, runs):
    difference = studies(scenes, runs, between=1.0 if over == "scenes" else 0.0)[1]
    p_value = paired_difference(difference, np.zeros_like(difference), over=over, replicates=9, flips=639).p_value
    for level in (2 / 64, 10 / 64, 32 / 64):
        error = 5 * math.sqrt(level * (1 - level) / STUDIES)
        # signs shared by all studies move the level of each by their own Monte-Carlo error
        error += 0 if over == "scenes" else 5 * math.sqrt(level * (1 - level) / 640)
        assert abs(np.mean(p_value <= level + 1e-9) - level) < error


def test_runs_of_a_scene_that_move_together_are_not_pairs_of_their_own():
    difference = studies(6, 30, within=0.1)[1][:300]
    over = {o: paired_difference(difference, np.zeros_like(difference), over=o).p_value for o in ("runs", "scenes")}
    assert np.mean(over["runs"] < 0.05) > 0.5  # what a test of runs says of other scenes is wrong
    assert np.mean(over["scenes"] < 0.05) < 0.05


def test_no_pair_at_all_has_no_difference():
    nothing = paired_difference(np.full((2, 3), np.nan), np.ones((2, 3)), over="runs")
    assert np.isnan(nothing).all()


def test_rejects_what_cannot_be_resampled():
    ones = np.ones((2, 3))
    with pytest.raises(ShapeError, match=r"one shape \(\.\.\., scenes, runs\), got \(2, 3\) and \(3,\)"):
        bootstrap_interval(ones, np.ones(3), over="runs")
    with pytest.raises(ShapeError, match=r"got \(3,\) and \(3,\)"):
        bootstrap_interval(np.ones(3), np.ones(3), over="runs")
    with pytest.raises(ShapeError, match=r"got \(1, 0\) and \(1, 0\)"):
        bootstrap_interval(np.ones((1, 0)), np.ones((1, 0)), over="runs")
    with pytest.raises(NotFiniteError, match="values must be finite"):
        paired_difference(ones * np.inf, ones, over="runs")
    with pytest.raises(InputError, match="over must be scenes or runs, got rooms"):
        bootstrap_interval(ones, ones, over="rooms")
    with pytest.raises(InputError, match=r"level must be above 0 and below 1, got 95"):
        bootstrap_interval(ones, ones, over="runs", level=95)
    with pytest.raises(InputError, match="replicates must be at least 1, got 0"):
        paired_difference(ones, ones, over="runs", replicates=0)
    with pytest.raises(InputError, match="flips must be at least 1, got 0"):
        paired_difference(ones, ones, over="runs", flips=0)


def test_intervals_need_no_torch():
    code = "import sys, probtrack.metrics as m; m.bootstrap_interval([[1, 2]], [[1, 1]], over='runs'); "
    code += "assert 'torch' not in sys.modules and 'scipy' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0
