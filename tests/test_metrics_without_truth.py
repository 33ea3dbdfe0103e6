"""Jumps, locks and agreement of the runs of a recording that has no truth."""

import math

import pytest
import torch
from talkers import at

from probtrack.errors import InputError, ShapeError
from probtrack.metrics import (
    AzimuthDisagreement,
    AzimuthJumps,
    AzimuthSpread,
    LargestJump,
    Locked,
    PositionDisagreement,
    PositionSpread,
    Talkers,
    azimuth_disagreement,
    largest_jump,
    position_disagreement,
)

NAN = math.nan


def said(**columns):
    """A track of one talker whose columns (T, *batch) are given."""
    events = {"position": -2, "covariance": -3}
    return at(**{name: torch.as_tensor(x).unsqueeze(events.get(name, -1)) for name, x in columns.items()})


def value(metric, estimate):
    metric.update(estimate, Talkers(estimate.time))
    return metric.compute()


AZIMUTH = [[0.0, 3.0], [0.2, -3.1], [0.1, -3.0], [0.4, -3.0]]  # largest jumps 0.3 and 2 pi - 6.1


def test_largest_jump_goes_the_short_way_round():
    torch.testing.assert_close(largest_jump(torch.tensor(AZIMUTH)), torch.tensor([0.3, 2 * math.pi - 6.1]))
    torch.testing.assert_close(value(LargestJump(), said(azimuth=AZIMUTH)), torch.tensor((0.3 + 2 * math.pi - 6.1) / 2))


def test_jumps_are_the_share_of_runs_with_one():
    assert value(AzimuthJumps(), said(azimuth=AZIMUTH)) == 0.5  # 15 degrees are 0.262
    assert value(AzimuthJumps(jump=0.1), said(azimuth=AZIMUTH)) == 1
    assert value(AzimuthJumps(jump=0.31), said(azimuth=AZIMUTH)) == 0


def test_a_run_that_falls_silent_jumps():
    assert AzimuthJumps().parts(
        said(azimuth=[[0.1, 0.1], [0.1, NAN], [0.1, 0.1]]), Talkers(torch.arange(3))
    ).total.tolist() == [0, 1]


@pytest.mark.parametrize("metric", [AzimuthJumps, LargestJump])
def test_one_frame_has_no_jump_to_judge(metric):
    assert metric().parts(said(azimuth=[[0.1, 0.2]]), Talkers(torch.zeros(1))).count.tolist() == [0, 0]


def test_frames_from_begin_on_and_before_end_count():
    # frames at 0, 0.1, 0.2 and 0.3 s
    assert value(LargestJump(end=0.25), said(azimuth=AZIMUTH)) < 0.21
    torch.testing.assert_close(value(LargestJump(begin=0.15), said(azimuth=AZIMUTH)), torch.tensor(0.15))
    assert LargestJump(begin=9.0).parts(said(azimuth=AZIMUTH), Talkers(torch.zeros(4))).count.tolist() == [0, 0]


def test_locked_is_the_share_of_frames_that_state_little_spread():
    estimate = said(std_azimuth=[[0.1, 0.3], [0.2, 0.25], [NAN, 0.27]])
    torch.testing.assert_close(value(Locked(), estimate), torch.tensor(3 / 6))
    torch.testing.assert_close(value(Locked(limit=0.15), estimate), torch.tensor(1 / 6))
    torch.testing.assert_close(value(Locked(begin=0.05, end=0.15), estimate), torch.tensor(1.0))


def test_disagreement_of_two_runs_is_their_distance_over_root_two():
    azimuth = torch.tensor([[3.0, -3.0], [0.1, 0.5]])
    gap = torch.tensor([2 * math.pi - 6, 0.4])
    torch.testing.assert_close(azimuth_disagreement(azimuth), (gap.square() / 2).mean().sqrt().expand(2))
    position = torch.tensor([[[0.0, 1.0], [3.0, 5.0]], [[2.0, 2.0], [2.0, 1.0]]])
    torch.testing.assert_close(position_disagreement(position), torch.tensor([(25 / 2 + 1 / 2) / 2] * 2).sqrt())


def test_disagreement_of_independent_runs_is_the_spread_of_one():
    frames, runs, std = 2000, 4, torch.tensor([0.3, 0.5, 0.2])
    position = torch.randn(frames, 1, 3) + std * torch.randn(frames, runs, 3)
    estimate = said(position=position, covariance=torch.diag(std.square()).expand(frames, runs, 3, 3))
    parts = PositionDisagreement().parts(estimate, Talkers(estimate.time))
    # a mean of squares: its variance is 2 sum(std^4) / (frames (runs - 1)), and half its relative error is the root's
    error = 0.5 * (2 * std.pow(4).sum() / (frames * (runs - 1))).sqrt() / std.square().sum().sqrt()
    stated = value(PositionSpread(), estimate)
    torch.testing.assert_close(stated, std.square().sum().sqrt())
    assert abs(parts.total.square().mean().sqrt() - stated) < 5 * error


def test_azimuth_disagreement_of_independent_runs_is_the_spread_of_one():
    frames, runs, std = 3000, 3, 0.05
    azimuth = 7 * torch.rand(frames, 1) + std * torch.randn(frames, runs)
    estimate = said(azimuth=azimuth, std_azimuth=torch.full((frames, runs), std))
    parts = AzimuthDisagreement().parts(estimate, Talkers(estimate.time))
    rms = parts.total.square().mean().sqrt()
    assert abs(rms - std) < 5 * std * (2 * frames * (runs - 1)) ** -0.5 + std**3
    torch.testing.assert_close(value(AzimuthSpread(), estimate), torch.tensor(std))


def test_a_run_that_says_nothing_is_infinitely_far_and_not_in_the_mean():
    azimuth = torch.tensor([[0.1, 0.3, NAN], [0.1, 0.3, 0.2]])
    assert azimuth_disagreement(azimuth)[2] == math.inf
    torch.testing.assert_close(azimuth_disagreement(azimuth)[0], torch.tensor((0.02 + 0.015) / 2).sqrt())
    position = torch.tensor([[[1.0, 0.0], [3.0, 0.0], [NAN, 7.0]]])
    torch.testing.assert_close(position_disagreement(position), torch.tensor([2**0.5, 2**0.5, math.inf]))


def test_recordings_of_a_batch_have_means_of_their_own():
    azimuth = torch.stack([torch.tensor([[0.1, 0.1]]), torch.tensor([[2.1, 2.1]])], 1)  # (T, recordings, runs)
    assert azimuth_disagreement(azimuth).abs().max() < 1e-7
    estimate = said(position=torch.arange(2.0).reshape(1, 2, 1, 1).expand(1, 2, 3, 2))
    assert PositionDisagreement().parts(estimate, Talkers(estimate.time)).total.abs().max() == 0


def test_one_run_has_nothing_to_agree_with():
    assert PositionDisagreement().parts(said(position=torch.rand(4, 1, 2)), Talkers(torch.zeros(4))).count == 0
    with pytest.raises(ShapeError, match="runs can disagree if the batch ends with their axis"):
        AzimuthDisagreement().parts(said(azimuth=[0.1, 0.2]), Talkers(torch.zeros(2)))


def test_spreads_are_root_mean_squares_over_frames_of_each_run():
    covariance = torch.diag_embed(torch.tensor([[[9.0, 16.0], [1.0, 0.0]], [[1.0, 0.0], [2.0, 1.0]]]))
    estimate = said(position=torch.zeros(2, 2, 2), covariance=covariance)
    torch.testing.assert_close(value(PositionSpread(), estimate), torch.tensor((13**0.5 + 2**0.5) / 2))
    estimate = said(std_azimuth=[[0.3, 0.1], [0.1, 0.1]])
    torch.testing.assert_close(value(AzimuthSpread(), estimate), torch.tensor((0.05**0.5 + 0.1) / 2))


def test_a_spread_that_is_not_stated_is_infinite():
    assert value(AzimuthSpread(), said(std_azimuth=[[0.3], [NAN]])) == math.inf


def test_rejects_limits_and_times_that_are_none():
    with pytest.raises(InputError, match="jump must be finite and positive"):
        AzimuthJumps(jump=-1.0)
    with pytest.raises(InputError, match="limit must be finite and positive"):
        Locked(limit=0.0)
    with pytest.raises(InputError, match=r"begin must be before end, got 3\.0 and 2\.0"):
        AzimuthSpread(begin=3.0, end=2.0)
