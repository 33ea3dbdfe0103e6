"""Mean squares, spreads and directions of one talker (S2 Table 1), frame by frame on hand-made cases."""

import math

import pytest
import torch
from talkers import off, one

from probtrack.errors import InputError
from probtrack.metrics import (
    AzimuthError,
    AzimuthRootMeanSquareError,
    HeadingMeanSpread,
    HeadingMeanSquareError,
    MeanSpread,
    MeanSquareError,
    Talkers,
    mean_square_error,
    position_std,
)
from probtrack.tracks import Track

NAN = math.nan


def facing(estimate, truth, name="heading", **more):
    """Directions said and true, at one place."""
    place = torch.zeros(*torch.as_tensor(truth).shape, 2)
    said = {name: torch.as_tensor(estimate), **more}
    return one(place.expand(*said[name].shape, 2), **said), one(place, **{name: torch.as_tensor(truth)})


def test_mse_is_over_the_frames_of_all_runs():
    metric = MeanSquareError()
    estimate, truth = off([[1.0, 2.0], [3.0, 5.0], [0.0, 6.0]])
    truth.position[2, 1] = NAN
    metric.update(estimate, truth)
    torch.testing.assert_close(metric.compute(), torch.tensor((1 + 9 + 0 + 4 + 25) / 5))


def test_mse_of_a_missing_estimate_is_infinite():
    estimate, truth = off([1.0, 2.0])
    estimate.position[0] = NAN
    assert MeanSquareError().parts(estimate, truth) == (math.inf, 2)


def test_mean_square_error_leaves_out_what_is_not_known():
    torch.testing.assert_close(mean_square_error(torch.tensor([[3.0, 1.0], [NAN, 2.0]])), torch.tensor([9.0, 2.5]))


def test_position_std_is_the_rms_distance_of_a_cloud_from_its_mean():
    cloud = torch.randn(50, 3) * torch.tensor([0.3, 1.0, 2.0]) + torch.tensor([1.0, -2.0, 0.5])
    covariance = (cloud - cloud.mean(0)).T @ (cloud - cloud.mean(0)) / 50
    distance = (cloud - cloud.mean(0)).norm(dim=-1)
    torch.testing.assert_close(position_std(covariance), distance.square().mean().sqrt())


def test_mean_spread_is_over_all_frames_and_needs_no_truth():
    covariance = torch.diag_embed(torch.tensor([[[9.0, 16.0], [1.0, 0.0]], [[0.0, 4.0], [25.0, 144.0]]]))
    estimate, truth = off(torch.zeros(2, 2))
    estimate = estimate._replace(covariance=covariance[..., None, :, :])
    metric = MeanSpread()
    metric.update(estimate, Talkers(truth.time))
    assert metric.compute() == (5 + 1 + 2 + 13) / 4


def test_heading_error_goes_the_short_way_round():
    metric = HeadingMeanSquareError()
    metric.update(*facing([[3.1, 0.5], [-3.0, 0.2]], [[-3.1, 0.1], [3.0, NAN]]))
    gap = 2 * math.pi - 6.2, 0.4, 2 * math.pi - 6.0
    torch.testing.assert_close(metric.compute(), torch.tensor(sum(g**2 for g in gap) / 3))


def test_heading_spread_is_the_mean_of_what_is_stated():
    estimate, truth = facing([0.0, 0.0, 0.0], [0.0, 1.0, 2.0], std_heading=[0.1, 0.6, 0.5])
    parts = HeadingMeanSpread().parts(estimate, truth)
    torch.testing.assert_close(parts.total / parts.count, torch.tensor(0.4))


def test_a_spread_that_is_not_stated_is_infinite():
    estimate, truth = facing([0.0, 0.0], [0.0, 0.0], std_heading=[0.1, NAN])
    assert HeadingMeanSpread().parts(estimate, truth) == (math.inf, 2)


def test_azimuth_error_is_the_mean_of_absolute_angles():
    metric = AzimuthError()
    metric.update(*facing([3.1, 0.5, 1.0], [-3.1, 0.1, NAN], "azimuth"))
    torch.testing.assert_close(metric.compute(), torch.tensor((2 * math.pi - 6.2 + 0.4) / 2))


def test_azimuth_rmse_is_the_mean_over_runs_of_each_runs_root():
    metric = AzimuthRootMeanSquareError()
    metric.update(*facing([[0.3, -3.1], [0.1, 3.0]], [[0.0, 3.1], [0.0, 3.0]], "azimuth"))
    gap = 2 * math.pi - 6.2
    torch.testing.assert_close(metric.compute(), torch.tensor((0.05**0.5 + (gap**2 / 2) ** 0.5) / 2))


@pytest.mark.parametrize("metric", [AzimuthError, AzimuthRootMeanSquareError])
def test_an_azimuth_that_is_missing_is_infinitely_wrong(metric):
    assert metric().parts(*facing([0.1, NAN], [0.0, 0.0], "azimuth")).total == math.inf


def test_a_heading_that_is_not_there_is_named():
    estimate, truth = off([1.0, 2.0])
    with pytest.raises(InputError, match="metric heading_mse needs a truth with heading"):
        HeadingMeanSquareError().parts(estimate, truth)
    with pytest.raises(InputError, match="metric heading_mstd needs an estimate with std_heading"):
        HeadingMeanSpread().parts(estimate, truth)


@pytest.mark.parametrize("stated", [True, False])
def test_a_track_without_covariance_states_that_of_its_axes(stated):
    std, position = torch.rand(4, 3, 2), torch.randn(4, 3, 2)
    other = torch.zeros(4, 3)
    full = torch.diag_embed(std.square()) + 0.01
    track = Track(torch.arange(4.0), position, std, other, other, other, other > 0)
    talkers = Talkers.of_track(track._replace(covariance=full) if stated else track)
    assert (talkers.batch, talkers.num_talkers) == ((3,), 1)
    torch.testing.assert_close(talkers.covariance[..., 0, :, :], full if stated else torch.diag_embed(std.square()))
