"""Normalised errors and coverage of Gaussians whose covariance is known."""

import math

import pytest
import torch
from talkers import one
from torch.distributions import MultivariateNormal

from probtrack.errors import ShapeError
from probtrack.metrics import Coverage50, Coverage90, NormalisedSquareError, inside_region, normalised_square_error

COVARIANCES = {2: [[0.5, 0.3], [0.3, 0.4]], 3: [[0.5, 0.3, -0.1], [0.3, 0.4, 0.05], [-0.1, 0.05, 0.2]]}


def drawn(axes, *, stated=1.0, frames=400, runs=50):
    """A truth drawn from a Gaussian about each estimate, which states that covariance times `stated`."""
    covariance = torch.tensor(COVARIANCES[axes])
    at = 5 * torch.randn(frames, runs, axes)
    truth = at + MultivariateNormal(torch.zeros(axes), covariance).sample((frames, runs))
    return at, truth, covariance * stated


def said(at, truth, covariance):
    """Estimate and truth."""
    estimate = one(at)
    return estimate._replace(covariance=covariance.expand(*at.shape[:-1], 1, *covariance.shape)), one(truth)


def test_normalised_square_error_is_that_of_the_inverse():
    covariance, error = torch.tensor(COVARIANCES[3]), torch.randn(7, 3)
    expected = torch.einsum("na,ab,nb->n", error, torch.linalg.inv(covariance), error)
    torch.testing.assert_close(normalised_square_error(error, covariance), expected)


@pytest.mark.parametrize(
    "covariance",
    [[[0.0, 0.0], [0.0, 0.0]], [[1.0, 1.0], [1.0, 1.0]], [[1.0, 2.0], [2.0, 1.0]], [[1.0, 0.0], [0.0, math.nan]]],
)
def test_what_is_certain_or_unknown_is_infinitely_wrong(covariance):
    error, covariance = torch.tensor([[0.1, 0.2], [3.0, 4.0]]), torch.tensor([covariance, [[25.0, 0.0], [0.0, 25.0]]])
    torch.testing.assert_close(normalised_square_error(error, covariance), torch.tensor([math.inf, 1.0]))
    assert inside_region(error, covariance, 0.9).tolist() == [False, True]


@pytest.mark.parametrize("probability", [0.2, 0.5, 0.9, 0.99])
def test_the_region_in_the_plane_has_the_radius_of_the_closed_form(probability):
    radius = math.sqrt(-2 * math.log(1 - probability))
    error = torch.tensor([[0.6, 0.8]]) * radius * torch.tensor([[1 - 1e-9], [1 + 1e-9]])
    assert inside_region(2 * error, 4 * torch.eye(2), probability).tolist() == [True, False]


def test_the_region_in_space_has_the_radius_of_maxwells_law():
    radius = torch.tensor(1.7)  # F(r) = erf(r / sqrt 2) - sqrt(2 / pi) r exp(-r^2 / 2)
    held = float(torch.erf(radius / 2**0.5) - (2 / math.pi) ** 0.5 * radius * (-(radius**2) / 2).exp())
    error = torch.tensor([0.0, 0.6, 0.8]) * radius
    assert inside_region(error, torch.eye(3), held + 1e-9)
    assert not inside_region(error, torch.eye(3), held - 1e-9)


@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize(("metric", "share"), [(Coverage50, 0.5), (Coverage90, 0.9)])
def test_coverage_of_the_stated_gaussian_is_what_its_name_says(axes, metric, share):
    parts = metric().parts(*said(*drawn(axes)))
    count = parts.count.sum()
    assert count == 400 * 50
    assert abs(parts.total.sum() / count - share) < 5 * (share * (1 - share) / count) ** 0.5


def test_coverage_of_a_track_too_sure_of_itself_is_the_closed_form():
    parts = Coverage90().parts(*said(*drawn(2, stated=0.25)))
    share = 1 - 0.1**0.25  # the ellipse of a quarter of the variance holds 1 - exp(-r^2 / 8)
    assert abs(parts.total.sum() / parts.count.sum() - share) < 5 * (share * (1 - share) / 20_000) ** 0.5


@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize("stated", [1.0, 0.5])
def test_nees_is_the_number_of_axes_over_the_share_of_the_variance_stated(axes, stated):
    metric = NormalisedSquareError()
    metric.update(*said(*drawn(axes, stated=stated)))
    assert abs(metric.compute() - axes / stated) < 5 * (2 * axes / 20_000) ** 0.5 / stated


def test_frames_without_truth_do_not_count_and_those_without_an_estimate_are_outside():
    at, truth, covariance = torch.zeros(4, 2), torch.zeros(4, 2), torch.eye(2)
    at[1], truth[2:, 0] = math.nan, math.nan
    assert Coverage50().parts(*said(at, truth, covariance)) == (1, 2)
    assert NormalisedSquareError().parts(*said(at, truth, covariance)) == (math.inf, 2)


def test_a_truth_in_the_plane_is_judged_by_the_covariance_in_the_plane():
    at, truth, covariance = drawn(3)
    estimate, there = said(at, truth, covariance)
    flat = there._replace(position=there.position[..., :2])
    parts = NormalisedSquareError().parts(estimate, flat)
    assert abs(parts.total.sum() / parts.count.sum() - 2) < 5 * (4 / 20_000) ** 0.5


def test_rejects_a_covariance_of_other_axes():
    with pytest.raises(ShapeError, match=r"covariance must have shape \(\.\.\., 3, 3\)"):
        normalised_square_error(torch.zeros(5, 3), torch.eye(2))


def test_a_cloud_on_one_point_is_judged_by_the_floor_of_its_spread():
    at, truth, none = torch.tensor([[0.3, 0.4]]), torch.zeros(1, 2), torch.zeros(2, 2)
    numerator, count = NormalisedSquareError(floor=0.05).parts(*said(at, truth, none))
    assert float(numerator) == pytest.approx((0.5 / 0.05) ** 2)
    assert float(count) == 1
    assert NormalisedSquareError(floor=0.0).parts(*said(at, truth, none)) == (math.inf, 1)
