"""Root mean square error and track loss of runs (S1 eq. 7 and 8), as sums that add up."""

import math

import pytest
import torch
from talkers import at, off, one

from probtrack.errors import InputError, ShapeError
from probtrack.metrics import RootMeanSquareError, TrackLoss

NAN = math.nan


def test_rmse_is_the_mean_over_runs_of_each_runs_root():
    metric = RootMeanSquareError()
    estimate, truth = off([[1.0, 3.0, 0.0], [2.0, 0.0, 4.0]])
    each = torch.tensor([2.5, 4.5, 8.0]).sqrt()
    torch.testing.assert_close(metric.parts(estimate, truth).total, each)
    metric.update(estimate, truth)
    torch.testing.assert_close(metric.compute(), each.mean())


def test_frames_of_unknown_truth_do_not_count():
    estimate, truth = off([[1.0, 1.0], [9.0, 1.0], [2.0, 1.0]])
    truth.position[1, 0, 0, 1] = NAN  # one unknown axis is enough
    torch.testing.assert_close(RootMeanSquareError().parts(estimate, truth).total, torch.tensor([2.5**0.5, 1.0]))


def test_a_run_without_truth_has_nothing_to_judge():
    estimate, truth = off([[1.0, 5.0], [3.0, 5.0]])
    truth.position[:, 1] = NAN
    parts = RootMeanSquareError().parts(estimate, truth)
    assert (parts.count.tolist(), parts.total[1]) == ([1, 0], 0)


def test_an_estimate_that_is_missing_is_infinitely_wrong():
    estimate, truth = off([[0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    estimate.position[2, 1] = NAN
    assert RootMeanSquareError().parts(estimate, truth).total.tolist() == [0, math.inf]
    assert TrackLoss(window=0.2).parts(estimate, truth).total.tolist() == [0, 1]


def test_nobody_there_and_nobody_said_is_no_error():
    estimate, truth = off([0.5, 3.0])
    estimate.position[1], truth.position[1] = NAN, NAN
    torch.testing.assert_close(RootMeanSquareError().parts(estimate, truth).total, torch.tensor(0.5))


def test_height_counts_where_both_have_it():
    estimate, truth = off([3.0], axes=3)
    flat = truth._replace(position=truth.position[..., :2])
    torch.testing.assert_close(RootMeanSquareError().parts(estimate, truth).total, torch.tensor(3.0))
    torch.testing.assert_close(RootMeanSquareError().parts(estimate, flat).total, torch.tensor(5.0**0.5))


@pytest.mark.parametrize("truth_of_each", [False, True])
def test_a_truth_is_shared_by_all_runs_with_or_without_an_axis_for_them(truth_of_each):
    estimate, truth = off([[1.0, 3.0, 2.0], [1.0, 3.0, 2.0]])
    shared = truth.position[:, :1] if truth_of_each else truth.position[:, 0]
    parts = RootMeanSquareError().parts(estimate, truth._replace(position=shared))
    torch.testing.assert_close(parts.total, torch.tensor([1.0, 3.0, 2.0]))
    assert parts.count.shape == (3,)


@pytest.mark.parametrize(("last", "lost"), [(0.0, 0), (0.23, 0), (0.25, 1)])
def test_a_track_is_lost_by_the_mean_error_of_its_last_half_second(last, lost):
    estimate, truth = off([7.0, 0.02, 0.14, 0.06, 0.04, last])
    assert TrackLoss().parts(estimate, truth) == (lost, 1)


def test_track_loss_is_the_share_of_runs():
    metric = TrackLoss(threshold=0.3)
    metric.update(*off(torch.tensor([0.25, 0.31, 2.0, 0.1, 0.29]).expand(6, 5)))
    assert metric.compute() == 0.4


def test_a_truth_that_ends_early_is_judged_at_its_end():
    estimate, truth = off([9.0, 0.09, 0.09, 0.09, 0.09, 0.09, 9.0, 9.0])
    truth.position[-2:] = NAN
    assert TrackLoss().parts(estimate, truth) == (0, 1)
    assert TrackLoss(window=0.6).parts(estimate, truth) == (1, 1)


def test_a_gap_of_the_truth_within_the_end_reaches_further_back():
    estimate, truth = off([9.0, 0.2, 0.2, 0.2, 9.0, 0.2, 0.2, 0.2])
    truth.position[4] = NAN
    assert TrackLoss(threshold=0.21).parts(estimate, truth) == (0, 1)
    assert TrackLoss(threshold=0.19).parts(estimate, truth) == (1, 1)


def test_fewer_known_frames_than_the_window_are_nothing_to_judge():
    estimate, truth = off([[5.0, 5.0]] * 6)
    truth.position[4:, 1] = NAN
    parts = TrackLoss().parts(estimate, truth)
    assert (parts.total.tolist(), parts.count.tolist()) == ([1, 0], [1, 0])


@pytest.mark.parametrize(("dt", "frames"), [(0.1, 5), (1 / 30, 15), (0.016, 32), (1 / 7, 4)])
def test_half_a_second_is_counted_in_frames_whose_times_were_rounded(dt, frames):
    error = torch.full((60,), 0.09)
    error[-frames - 1] = 100.0
    estimate, truth = off(error)
    time = torch.arange(60) * dt
    rounded = estimate._replace(time=(time * 1e6).round() / 1e6)
    assert TrackLoss().parts(rounded, truth._replace(time=time)).total == 0


def test_a_recording_shorter_than_the_window_is_an_error():
    with pytest.raises(InputError, match=r"the last 5 frames \(0\.5 s\), got 4"):
        TrackLoss().parts(*off([1.0] * 4))


@pytest.mark.parametrize("bad", [0.0, -1.0, NAN])
def test_rejects_a_threshold_or_window_that_is_none(bad):
    with pytest.raises(InputError, match="threshold must be finite and positive"):
        TrackLoss(threshold=bad)
    with pytest.raises(InputError, match="window must be finite and positive"):
        TrackLoss(window=bad)


def test_names_what_a_truth_or_an_estimate_lacks():
    estimate, truth = off([1.0, 2.0])
    azimuths = at(azimuth=[[0.1], [0.2]])
    with pytest.raises(InputError, match="metric rmse needs a truth with position"):
        RootMeanSquareError().parts(estimate, azimuths)
    with pytest.raises(InputError, match="metric rmse needs an estimate with position"):
        RootMeanSquareError().parts(azimuths, truth)


def test_rejects_what_does_not_fit():
    estimate, truth = off([[1.0, 2.0, 3.0]] * 4)
    with pytest.raises(ShapeError, match="truth must have the 4 frames of the estimate, got 3"):
        RootMeanSquareError().parts(estimate, off([[1.0, 2.0, 3.0]] * 3)[1])
    with pytest.raises(ShapeError, match=r"truth must have the batch \(3,\) of the estimate, got \(2,\)"):
        RootMeanSquareError().parts(estimate, off([[1.0, 2.0]] * 4)[1])
    two = truth._replace(position=truth.position.expand(4, 3, 2, 2))
    with pytest.raises(InputError, match="metric rmse is of one talker, got 2 tracks"):
        RootMeanSquareError().parts(two, truth)
    with pytest.raises(InputError, match="metric rmse is of one talker, got 2 true talkers"):
        RootMeanSquareError().parts(estimate, two)


def test_float32_tracks_give_the_same_figures():
    error = torch.rand(40, 7)
    single = [talkers._replace(position=talkers.position.float()) for talkers in off(error)]
    parts = RootMeanSquareError().parts(*single)
    assert parts.total.dtype == torch.float64
    torch.testing.assert_close(parts.total, RootMeanSquareError().parts(*off(error)).total, rtol=1e-5, atol=1e-6)


def test_one_frame_of_one_run_without_a_batch():
    parts = RootMeanSquareError().parts(one([[3.0, 4.0]]), one([[0.0, 0.0]]))
    assert (parts.total, parts.count, parts.total.shape) == (5, 1, ())
