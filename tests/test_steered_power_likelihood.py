"""The likelihood of S1 eq. 4 and 5: a density over the region, flat without speech, nothing outside."""

import math
from typing import NamedTuple

import numpy as np
import pytest
import torch
from oracles.steering import spherical_wave
from properties import assert_gradients
from torch import Tensor, nn

from probtrack.audio import GeneralisedCrossCorrelation, ShortTimeSpectrum, SteeredResponsePower
from probtrack.dynamics import Kinematics
from probtrack.errors import InputError, ShapeError
from probtrack.geometry import MicrophoneArray, Region
from probtrack.likelihoods import PreparedPower, SteeredPowerLikelihood

POSITIONS = [[0.31, -0.2], [0.92, 0.04], [0.27, 0.55], [-0.45, 0.11], [1.2, 0.7]]
LOW, HIGH = (-1.0, -0.5), (2.4, 1.6)
AREA = 3.4 * 2.1


class Heard(NamedTuple):
    gcc: Tensor
    speech: Tensor


class Bump(nn.Module):
    """A power that can be integrated by hand: g (1 + x), whatever the microphones."""

    def distances(self, points):
        return 5 + points[..., :1]

    def steered(self, gcc, distances):
        return gcc.mean((-1, -2))[..., None] * (distances[..., 0] - 4)

    def at(self, points):
        return lambda gcc: self.steered(gcc, self.distances(points))


def moving(position):
    return Kinematics(position, torch.zeros_like(position), position[..., 0])


def likelihood(**settings):
    array = MicrophoneArray(POSITIONS)
    gcc = GeneralisedCrossCorrelation(array)
    power = SteeredResponsePower(array, lag_rate=gcc.lag_rate, num_lags=gcc.num_lags)
    return gcc, SteeredPowerLikelihood(power, Region(LOW, HIGH), **settings)


def observed(gcc, speech, source=(1.7, 1.1)):
    """Correlations of noise from `source`, with P(speech) of each frame."""
    wave = spherical_wave(torch.randn(512 * len(speech)).numpy(), source, torch.tensor(POSITIONS).numpy(), 16000)
    with torch.no_grad():
        return Heard(gcc(ShortTimeSpectrum(512, 512)(torch.tensor(wave)).spectrum), torch.tensor(speech))


def at_frame(prepared, t):
    return type(prepared)(*(x[t] for x in prepared))


def fine_grid():
    return Region(LOW, HIGH).grid(40_000)


@pytest.mark.parametrize("exponent", [2.0, 1.0, 5.5])
def test_both_terms_are_densities_over_the_region(exponent):
    gcc, model = likelihood(exponent=exponent)
    prepared, grid = model.prepare(observed(gcc, [0.0, 0.3, 1.0])), fine_grid()
    for t in range(3):
        # gamma comes of a grid of 400 cells (0.13 m), coarser than the sharpest ridges of P^r
        total = model(at_frame(prepared, t), moving(grid)).exp().mean() * AREA
        torch.testing.assert_close(total, torch.ones(()), rtol=0, atol=0.02)


@pytest.mark.parametrize("exponent", [2.0, 3.0])
def test_density_is_the_formula_integrated_by_hand(exponent):
    model = SteeredPowerLikelihood(Bump(), Region((0.0, -0.5), (2.0, 1.0)), exponent=exponent, grid_points=10_000)
    x, g, alpha = torch.tensor([[0.3, 0.1], [1.8, -0.4]]), 0.2, 0.35
    frame = at_frame(model.prepare(Heard(torch.full((1, 4, 6), g), torch.tensor([alpha]))), 0)
    integral = 1.5 * g**exponent * (3 ** (exponent + 1) - 1) / (exponent + 1)
    exact = (1 - alpha) / 3.0 + alpha * (g * (1 + x[:, 0])) ** exponent / integral
    torch.testing.assert_close(model(frame, moving(x)).exp(), exact, rtol=1e-4, atol=0)


def test_without_speech_the_density_is_flat():
    gcc, model = likelihood()
    frame = at_frame(model.prepare(observed(gcc, [0.0])), 0)
    points = Region(LOW, HIGH).from_unit(torch.rand(50, 2))
    torch.testing.assert_close(model(frame, moving(points)), torch.full((50,), -math.log(AREA)), rtol=0, atol=1e-14)


def test_speech_is_found_where_it_is():
    gcc, model = likelihood(exponent=3.0)
    frame, grid = at_frame(model.prepare(observed(gcc, [0.9])), 0), fine_grid()
    best = grid[model(frame, moving(grid)).argmax()]
    centre = torch.tensor(POSITIONS).mean(0)
    direction = torch.cosine_similarity(best - centre, torch.tensor([1.7, 1.1]) - centre, dim=0)
    assert direction > math.cos(0.05)


def test_density_is_linear_in_the_probability_of_speech():
    gcc, model = likelihood()
    heard = observed(gcc, [0.5])
    points = Region(LOW, HIGH).from_unit(torch.rand(50, 2))
    none, half, all_ = (
        model(at_frame(model.prepare(heard._replace(speech=torch.tensor([a]))), 0), moving(points)).exp()
        for a in (0.0, 0.5, 1.0)
    )
    torch.testing.assert_close(half, (none + all_) / 2)
    assert (none - all_).abs().max() > 0.05


def test_density_is_zero_outside_and_nowhere_else():
    gcc, model = likelihood()
    frame = at_frame(model.prepare(observed(gcc, [1.0])), 0)
    outside = torch.tensor([[-1.01, 0.0], [2.41, 0.0], [0.0, -0.51], [0.0, 1.61], [9.0, 9.0], [math.nan, 0.0]])
    assert (model(frame, moving(outside)) == -torch.inf).all()
    inside = torch.tensor([[-0.99, 1.59], [2.39, -0.49], [0.5, 0.5]])
    assert model(frame, moving(inside)).isfinite().all()


def test_power_below_zero_by_rounding_is_not_nan():
    model = SteeredPowerLikelihood(Bump(), Region((-2.0, -0.5), (2.0, 1.0)), exponent=1.7)
    frame = at_frame(model.prepare(Heard(torch.full((1, 4, 6), 0.2), torch.tensor([1.0]))), 0)
    position = torch.tensor([[-1.5, 0.1], [1.0, 0.2]]).requires_grad_()  # the bump is -0.1 there
    value = model(frame, moving(position))
    value.sum().backward()
    assert value.isfinite().all()
    assert position.grad.isfinite().all()
    assert value[0] < value[1] - 5


def test_silence_is_flat_with_any_probability_of_speech():
    _, model = likelihood()
    silent = torch.zeros(3, model.power.num_pairs, model.power.num_lags)
    prepared = model.prepare(Heard(silent, torch.tensor([0.0, 0.4, 1.0])))
    for t in range(3):
        value = model(at_frame(prepared, t), moving(torch.rand(5, 2)))
        torch.testing.assert_close(value, torch.full((5,), -math.log(AREA)))


BATCHES = [((), ()), ((), (4,)), ((3,), (3,)), ((3, 1), (3, 4)), ((3,), ())]


@pytest.mark.parametrize(("recordings", "particles"), BATCHES)
def test_batch_agrees_with_one_by_one(recordings, particles):
    _, model = likelihood()
    tables = 0.02 * torch.randn(2, *recordings, model.power.num_pairs, model.power.num_lags)
    heard, points = Heard(tables, torch.rand(2, *recordings)), torch.rand(*particles, 7, 2)
    value = model(at_frame(model.prepare(heard), 1), moving(points))
    batch = torch.broadcast_shapes(recordings, particles)
    assert value.shape == (*batch, 7)
    gcc, speech, points = (
        heard.gcc[1].expand(*batch, -1, -1),
        heard.speech[1].expand(batch),
        points.expand(*batch, 7, 2),
    )
    for index in np.ndindex(*batch):
        one = model.prepare(Heard(gcc[index][None], speech[index][None]))
        torch.testing.assert_close(value[index], model(at_frame(one, 0), moving(points[index])))


def test_gradients_by_exponent_speech_correlations_and_position():
    array = MicrophoneArray(POSITIONS[:3])
    power = SteeredResponsePower(array, lag_rate=8000, num_lags=61)
    model = SteeredPowerLikelihood(power, Region(LOW, HIGH), exponent=2.3, grid_points=30)

    def value(model, gcc, speech, position):
        return model(at_frame(model.prepare(Heard(gcc, speech)), 1), moving(position))

    gcc = 0.02 * torch.randn(2, power.num_pairs, power.num_lags)
    assert_gradients(model, value, gcc, torch.tensor([0.3, 0.8]), torch.rand(4, 2))


def test_exponent_learns_and_is_kept():
    gcc, model = likelihood(exponent=1.4)
    heard, points = observed(gcc, [0.9]), moving(torch.rand(6, 2))
    value = model(at_frame(model.prepare(heard), 0), points)
    value.sum().backward()
    assert all(p.grad.isfinite() and p.grad != 0 for p in model.parameters())
    again = likelihood()[1]
    again.load_state_dict(model.state_dict())
    assert list(model.state_dict()) == ["log_exponent"]
    assert torch.equal(again(at_frame(again.prepare(heard), 0), points), value)


def test_maximum_likelihood_recovers_the_exponent():
    gcc, truth = likelihood(exponent=4.0)
    prepared = truth.prepare(observed(gcc, [1.0]))
    grid = fine_grid()
    with torch.no_grad():
        draws = truth(at_frame(prepared, 0), moving(grid)).exp().multinomial(20_000, replacement=True)
    model, heard = likelihood(exponent=2.0, grid_points=2000)[1], Heard(prepared.gcc, torch.ones(1))
    optimiser = torch.optim.LBFGS(model.parameters(), line_search_fn="strong_wolfe", max_iter=10)

    def loss():
        optimiser.zero_grad()
        value = -model(at_frame(model.prepare(heard), 0), moving(grid[draws])).mean()
        value.backward()
        return value

    optimiser.step(loss)
    assert abs(model.log_exponent.exp().item() / 4.0 - 1) < 0.1


def test_float32_is_close_to_float64():
    gcc, model = likelihood()
    heard, points = observed(gcc, [0.0, 0.4, 1.0]), torch.rand(20, 2)
    exact = model(at_frame(model.prepare(heard), 1), moving(points))
    rough = likelihood()[1].float()
    value = rough(at_frame(rough.prepare(Heard(*(x.float() for x in heard))), 1), moving(points.float()))
    assert value.dtype == torch.float32
    torch.testing.assert_close(value.double(), exact, rtol=0, atol=1e-4)


@pytest.mark.parametrize("speech", [-0.01, 1.01, math.nan])
def test_rejects_speech_that_is_no_probability(speech):
    _, model = likelihood()
    tables = torch.zeros(2, model.power.num_pairs, model.power.num_lags)
    with pytest.raises(InputError, match=r"speech must be a probability in \[0, 1\]"):
        model.prepare(Heard(tables, torch.tensor([0.5, speech])))


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"exponent": 0.0}, "exponent must be finite and positive, got 0"),
        ({"grid_points": 0}, "grid_points must be an integer of at least 1, got 0"),
    ],
)
def test_rejects_settings(settings, match):
    with pytest.raises(InputError, match=match):
        likelihood(**settings)


def test_rejects_a_region_with_other_axes():
    power = SteeredResponsePower(MicrophoneArray(POSITIONS), lag_rate=64000, num_lags=401)
    with pytest.raises(ShapeError, match=r"points must have shape \(\.\.\., 2\)"):
        SteeredPowerLikelihood(power, Region((0.0, 0.0, 0.0), (1.0, 2.0, 3.0)))


def test_no_talker_is_within_the_keep_out_of_a_microphone():
    gcc, model = likelihood(keep_out=0.3)
    prepared = model.prepare(observed(gcc, [0.0, 0.9]))
    microphone = torch.tensor(POSITIONS)[1]
    points = microphone + torch.tensor([[0.29, 0.0], [0.0, 0.31], [-0.2, 0.2], [-0.25, 0.25]])
    for frame in range(2):
        value = model(at_frame(prepared, frame), moving(points))
        assert value.isneginf().tolist() == [True, False, True, False]


def test_density_integrates_to_one_over_what_the_keep_out_leaves():
    gcc, model = likelihood(keep_out=0.3, grid_points=4000)
    frame, grid = at_frame(model.prepare(observed(gcc, [0.7])), 0), fine_grid()
    total = model(frame, moving(grid)).exp().mean().item() * AREA
    assert abs(total - 1) < 0.01  # circles cut cells, and the lags of the integral are rounded


@pytest.mark.parametrize("keep_out", [-0.1, math.nan, math.inf])
def test_keep_out_that_cannot_be(keep_out):
    with pytest.raises(InputError, match="keep_out must be finite and at least 0"):
        likelihood(keep_out=keep_out)


def test_keep_out_that_leaves_no_place():
    with pytest.raises(InputError, match="holds no place that is keep_out = 9 m from every microphone"):
        likelihood(keep_out=9.0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("exponent", [20.0, 80.0])
def test_large_exponents_neither_overflow_nor_vanish(dtype, exponent):
    # a power of 1e-3 to the 80 is below the smallest float32, and so is the square of its integral in the gradient
    torch.set_default_dtype(dtype)
    model = SteeredPowerLikelihood(Bump(), Region((0.0, -0.5), (2.0, 1.0)), exponent=exponent, grid_points=10_000)
    x, g, alpha = torch.tensor([[0.3, 0.1], [1.9, -0.4]], requires_grad=True), torch.tensor(1e-3), 0.35
    gcc = (g * torch.ones(1, 4, 6)).requires_grad_()
    value = model(at_frame(model.prepare(Heard(gcc, torch.tensor([alpha]))), 0), moving(x))
    # P^r / integral of P^r, whatever g: g cancels, so that gcc has no gradient
    ratio = ((1 + x.detach().double()[:, 0]) / 3) ** exponent * (exponent + 1) / (4.5 * (1 - 3 ** -(exponent + 1.0)))
    exact = ((1 - alpha) / 3 + alpha * ratio).log()
    # the integral is a mean over 87 cells along x, by the midpoint rule: relative error (r h / 3)^2 / 24
    torch.testing.assert_close(value.double(), exact, rtol=0, atol=0.03)
    by_gcc, by_x = torch.autograd.grad(value.sum(), (gcc, x), retain_graph=True)
    (by_exponent,) = torch.autograd.grad(value[1], model.log_exponent)
    assert by_gcc.isfinite().all()
    assert by_gcc.abs().sum() < 1e-2 * exponent / g  # of single terms r / g that cancel
    assert by_exponent.isfinite()
    assert by_exponent != 0
    share = alpha * ratio[1] / exact[1].exp()
    torch.testing.assert_close(by_x[1, 0].double(), share * exponent / 2.9, rtol=0.03, atol=0)


def test_density_does_not_depend_on_the_scale_of_the_power():
    model = SteeredPowerLikelihood(Bump(), Region((0.0, -0.5), (2.0, 1.0)), exponent=2.6)
    values = []
    for g in (0.9, 0.01):
        gcc = torch.full((1, 4, 6), g)
        values.append(model(at_frame(model.prepare(Heard(gcc, torch.tensor([0.6]))), 0), moving(torch.rand(1, 2) * 0)))
    torch.testing.assert_close(values[0], values[1])


def test_map_is_the_logarithm_of_the_power_on_the_cells_of_a_grid():
    gcc, model = likelihood(map_points=300)
    heard = observed(gcc, [0.2, 1.0])
    found = model.evidence_map(model.prepare(heard))
    size = torch.tensor([3.4 / round(3.4 / (AREA / 300) ** 0.5), 2.1 / round(2.1 / (AREA / 300) ** 0.5)])
    torch.testing.assert_close(found.size, size)
    assert found.centre.shape == (round(AREA / float(size.prod())), 2)
    assert found.log_evidence.shape == (2, len(found.centre))
    # by the nearest lag: 0.04 of the largest power is said of two microphones, here are five
    exact = model.power(heard.gcc, found.centre)
    assert (found.log_evidence.exp() - exact).abs().max() < 0.04
    corners = torch.tensor([LOW, HIGH])
    torch.testing.assert_close(found.centre.amin(0), corners[0] + size / 2)
    torch.testing.assert_close(found.centre.amax(0), corners[1] - size / 2)


def test_map_has_no_gradient_and_leaves_out_cells_without_a_free_place():
    gcc, model = likelihood(map_points=300, keep_out=0.4)
    tables = observed(gcc, [1.0])
    found = model.evidence_map(model.prepare(tables._replace(gcc=tables.gcc.requires_grad_())))
    assert not found.log_evidence.requires_grad
    half, microphones = found.size / 2, torch.tensor(POSITIONS)

    def farthest(cell):
        """Of points all over a cell, the largest distance from the microphone that is nearest to it."""
        unit = torch.cartesian_prod(torch.linspace(-1, 1, 15), torch.linspace(-1, 1, 15))
        return torch.cdist(cell + half * unit, microphones).amin(-1).amax()

    cells = Region(LOW, HIGH).grid(300)
    kept = (cells[:, None] == found.centre).all(-1).any(-1)
    free = torch.stack([farthest(cell) for cell in cells]) >= 0.4
    assert not (free & ~kept).any()  # every cell some of which is free is there
    assert (~kept).any()
    assert torch.cdist(found.centre, microphones).amin() > 0.4 - half.norm() - 1e-9


def test_possible_is_where_the_density_is_not_zero():
    gcc, model = likelihood(keep_out=0.3)
    points = torch.tensor(LOW) - 0.3 + torch.rand(4, 3, 50, 2) * torch.tensor([4.0, 2.7])
    frame = at_frame(model.prepare(observed(gcc, [0.5])), 0)
    possible = model.possible(points)
    assert torch.equal(possible, model(frame, moving(points)).isfinite())
    assert possible.any()
    assert not possible.all()
    assert model.possible(points[0, 0, 0]).shape == ()
    assert not model.possible(torch.tensor([math.nan, 0.0]))


def test_a_power_that_vanishes_beside_certain_speech_has_a_finite_gradient():
    torch.set_default_dtype(torch.float32)
    likelihood = SteeredPowerLikelihood(Bump(), Region(LOW, HIGH), exponent=60.0)
    heard = Heard(torch.ones(1, 3, 4), torch.ones(1))
    position = torch.tensor([[-0.99, 0.3], [2.3, 0.1]], requires_grad=True)
    frame = PreparedPower(*(x[0] for x in likelihood.prepare(heard)))
    likelihood(frame, Kinematics(position, torch.zeros_like(position))).sum().backward()
    assert position.grad.isfinite().all()
    assert likelihood.log_exponent.grad.isfinite()
