"""OSPA and GOSPA: the definitions with scipy's assignment, the axioms of a metric, and cases by hand."""

import math

import pytest
import torch
from oracles import assignment
from talkers import at

from probtrack.errors import InputError
from probtrack.metrics import (
    GeneralisedSubPatternAssignment,
    OptimalSubPatternAssignment,
    best_pairs,
    gospa,
    ospa,
    ospa_as_released,
)

NAN = math.nan
SIZES = [(1, 1), (1, 3), (3, 1), (2, 4), (4, 3), (3, 0), (0, 2), (5, 4)]


def some(frames, talkers, tracks):
    """Distances of points in the unit cube, some of which are not there."""
    ours, theirs = torch.rand(frames, talkers, 3), torch.rand(frames, tracks, 3)
    there, said = torch.rand(frames, talkers) < 0.7, torch.rand(frames, tracks) < 0.7
    ours[~there], theirs[~said] = NAN, NAN
    return (ours[:, :, None] - theirs[:, None]).norm(dim=-1), there, said


def of_points(metric, first, second, **settings):
    """Distance of sets of points (..., K, A), NaN for none."""
    distance = (first[..., :, None, :] - second[..., None, :, :]).norm(dim=-1)
    there, said = first.isfinite().all(-1), second.isfinite().all(-1)
    result = metric(distance, there=there, said=said, **settings)
    return result.distance if metric is gospa else result


@pytest.mark.parametrize(("talkers", "tracks"), SIZES)
@pytest.mark.parametrize(("order", "cutoff"), [(1.0, 0.6), (2.0, 0.4), (1.5, 3.0)])
def test_distances_of_sets_are_those_of_scipys_assignment(talkers, tracks, order, cutoff):
    distance, there, said = some(60, talkers, tracks)
    settings = {"there": there, "said": said, "order": order, "cutoff": cutoff}
    ours = ospa(distance, **settings), gospa(distance, **settings).distance
    cases = [d[a][:, b].numpy() for d, a, b in zip(distance, there, said, strict=True)]
    for result, oracle in zip(ours, (assignment.ospa, assignment.gospa), strict=True):
        expected = torch.tensor([oracle(case, order, cutoff) for case in cases])
        torch.testing.assert_close(result, expected, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize(("rows", "columns"), [(2, 2), (3, 5), (6, 4), (6, 6)])
def test_best_pairs_have_the_gain_of_scipys_assignment(rows, columns):
    gain = torch.randn(4, 5, rows, columns)
    pairs = best_pairs(gain)
    made = gain.gather(-1, pairs.clamp_min(0)[..., None])[..., 0].where(pairs >= 0, 0.0).sum(-1)
    square = torch.zeros(4, 5, max(rows, columns), max(rows, columns))
    square[..., :rows, :columns] = -gain.clamp_min(0.0)
    expected = torch.tensor([[assignment.assigned_cost(cost.numpy()) for cost in some] for some in square])
    torch.testing.assert_close(made, -expected)


def test_pairs_are_one_to_one():
    pairs = best_pairs(torch.randn(200, 5, 4))
    for column in range(4):
        assert (pairs == column).sum(-1).max() == 1


def test_pairs_of_large_batches_are_found_in_pieces(monkeypatch):
    gain = torch.randn(50, 3, 4)
    whole = best_pairs(gain)
    monkeypatch.setattr("probtrack.metrics.association._AT_ONCE", 100)
    assert torch.equal(best_pairs(gain), whole)


@pytest.mark.parametrize("metric", [ospa, gospa])
@pytest.mark.parametrize("order", [1.0, 2.0])
def test_axioms_of_a_metric(metric, order):
    sets = [torch.rand(300, k, 2).masked_fill(torch.rand(300, k, 1) < 0.3, NAN) for k in (2, 4, 3)]
    settings = {"order": order, "cutoff": 0.5}
    ab, bc, ac, ba = (of_points(metric, sets[i], sets[j], **settings) for i, j in ((0, 1), (1, 2), (0, 2), (1, 0)))
    torch.testing.assert_close(ab, ba)
    assert (ac <= ab + bc + 1e-7).all()
    assert of_points(metric, sets[1], sets[1].flip(-2), **settings).abs().max() < 1e-7
    assert (of_points(metric, sets[1], sets[1] + 0.01, **settings) > 0)[sets[1].isfinite().any(-1).any(-1)].all()


@pytest.mark.parametrize(
    ("there", "said", "expected"),
    [
        ([1, 1], [1, 1], ((0.09 + 0.16) / 2) ** 0.5),
        ([1, 0], [1, 1], ((0.09 + 1.0) / 2) ** 0.5),
        ([0, 1], [1, 0], 1.0),  # 1.3 apart: cut off
        ([0, 0], [1, 1], 1.0),
        ([0, 0], [0, 0], 0.0),
    ],
)
def test_ospa_by_hand(there, said, expected):
    distance = torch.tensor([[0.3, 2.0], [1.3, 0.4]])
    result = ospa(distance, there=torch.tensor(there) > 0, said=torch.tensor(said) > 0, order=2.0, cutoff=1.0)
    torch.testing.assert_close(result, torch.tensor(expected))


def test_parts_of_gospa_by_hand():
    distance = torch.tensor([[0.3, 2.0, 2.5], [2.2, 1.3, 2.5]])  # one pair, one miss, two false of which one is near
    parts = gospa(distance, there=torch.tensor([True] * 2), said=torch.tensor([True] * 3), order=2.0, cutoff=1.0)
    torch.testing.assert_close(torch.stack(parts[1:]), torch.tensor([0.09, 0.5, 1.0]))
    torch.testing.assert_close(parts.distance, torch.tensor(1.59**0.5))


def test_the_released_scripts_count_one_pair_alone():
    distance, both = torch.tensor([[0.3, 2.0], [1.3, 0.4]]), torch.tensor([True, True])
    flat = ospa_as_released(distance, there=both, said=both, order=1.0, cutoff=1.0)
    torch.testing.assert_close(flat, torch.tensor(0.3 / 2))
    torch.testing.assert_close(ospa(distance, there=both, said=both, order=1.0, cutoff=1.0), torch.tensor(0.7 / 2))
    one = torch.tensor([True, False])
    torch.testing.assert_close(ospa_as_released(distance, there=one, said=both), torch.tensor((0.3 + 1) / 2))
    assert ospa_as_released(distance, there=~both, said=both) == 1
    assert ospa_as_released(distance, there=~both, said=~both) == 0
    assert ospa_as_released(distance[:0], there=both[:0], said=both) == 1


def test_metrics_are_means_over_frames_of_any_number_of_talkers():
    truth = at([[[0.0, 0.0], [NAN, NAN]], [[0.0, 0.0], [5.0, 0.0]], [[NAN, NAN], [NAN, NAN]]])
    estimate = at([[[0.0, 0.3]], [[0.0, 0.1]], [[NAN, NAN]]])
    parts = OptimalSubPatternAssignment(cutoff=0.5).parts(estimate, truth)
    torch.testing.assert_close(parts.total, torch.tensor(0.3 + (0.1 + 0.5) / 2))
    assert parts.count == 3
    parts = GeneralisedSubPatternAssignment(cutoff=0.5).parts(estimate, truth)
    torch.testing.assert_close(parts.total, torch.tensor(0.3 + (0.01 + 0.125) ** 0.5))


@pytest.mark.parametrize("metric", [OptimalSubPatternAssignment, GeneralisedSubPatternAssignment])
def test_frames_of_which_nobody_knows_who_is_there_do_not_count(metric):
    truth = at([[[0.0, 0.0]], [[0.0, 0.0]], [[NAN, NAN]], [[NAN, NAN]], [[NAN, NAN]]])
    estimate = at([[[0.0, 0.3]], [[NAN, NAN]], [[7.0, 0.0]], [[7.0, 0.0]], [[NAN, NAN]]])
    known = torch.tensor([True, True, False, True, False])  # the fourth: known to be empty
    parts = metric(order=1.0, cutoff=0.6).parts(estimate, truth._replace(known=known))
    alone = 0.6 if metric is OptimalSubPatternAssignment else 0.3
    torch.testing.assert_close(parts.total, torch.tensor(0.3 + 2 * alone))
    assert parts.count == 3


def test_azimuths_are_compared_the_short_way_round():
    truth, estimate = at(azimuth=[[3.1, 0.0]]), at(azimuth=[[0.1, -3.1]])
    metric = OptimalSubPatternAssignment(by="azimuth")
    assert (metric.name, metric.unit, metric.needs) == ("ospa_azimuth", "rad", ("azimuth",))
    torch.testing.assert_close(metric.parts(estimate, truth).total, torch.tensor((2 * math.pi - 6.2 + 0.1) / 2))


def test_runs_share_a_truth():
    truth, position = at(torch.rand(6, 1, 3, 2)), torch.rand(6, 4, 2, 2)
    whole = OptimalSubPatternAssignment(cutoff=0.4).parts(at(position), truth).total
    each = [OptimalSubPatternAssignment(cutoff=0.4).parts(at(position[:, [r]]), truth).total for r in range(4)]
    torch.testing.assert_close(whole, torch.cat(each))


def test_rejects_settings_that_make_no_metric():
    for metric in (OptimalSubPatternAssignment, GeneralisedSubPatternAssignment):
        for order in (0.5, math.inf, NAN):
            with pytest.raises(InputError, match=rf"order must be finite and at least 1, got {order}"):
                metric(order=order)
    both = torch.ones(2, dtype=torch.bool)
    with pytest.raises(InputError, match="order must be finite and at least 1, got inf"):
        ospa(torch.zeros(2, 2), there=both, said=both, order=math.inf)
    with pytest.raises(InputError, match="limit must be finite and positive"):
        GeneralisedSubPatternAssignment(cutoff=0.0)
    with pytest.raises(InputError, match="by must be position or azimuth, got heading"):
        OptimalSubPatternAssignment(by="heading")
    with pytest.raises(InputError, match="at most 8 talkers can be paired with 8 tracks, got 9 with 9"):
        best_pairs(torch.zeros(9, 9))
