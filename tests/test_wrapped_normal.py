"""WrappedNormal: against many windings, turns, and its limits."""

import math

import pyro
import pytest
import torch
from pyro.distributions.torch_distribution import TorchDistributionMixin
from torch.distributions import Normal

from probtrack.distributions import WrappedNormal
from probtrack.geometry import wrap_angle

SPREADS = [0.05, 0.7, 1.7, math.sqrt(math.pi) - 1e-9, math.sqrt(math.pi) + 1e-9, 1.9, 3.0, 8.0]


def angles():
    return torch.linspace(-math.pi, math.pi, 25)


@pytest.mark.parametrize("scale", SPREADS)
def test_log_prob_is_the_sum_over_many_windings(scale):
    loc = 0.8
    turned = angles() + 2 * math.pi * torch.arange(-60, 61)[:, None]
    expected = Normal(loc, scale).log_prob(turned).logsumexp(0)
    torch.testing.assert_close(WrappedNormal(loc, scale).log_prob(angles()), expected, rtol=1e-14, atol=4e-15)


@pytest.mark.parametrize("scale", [0.3, 2.5])
def test_whole_turns_of_loc_do_not_count(scale):
    near, far = WrappedNormal(0.8, scale), WrappedNormal(0.8 - 6 * math.pi, scale)
    torch.testing.assert_close(far.log_prob(angles()), near.log_prob(angles()))
    torch.testing.assert_close(far.mean, torch.tensor(0.8))
    torch.testing.assert_close(far.mode, near.mode)


@pytest.mark.parametrize("scale", [0.3, 2.5])
def test_both_ends_are_one_point(scale):
    first, last = WrappedNormal(2.9, scale).log_prob(torch.tensor([-math.pi, math.pi]))
    torch.testing.assert_close(first, last)


@pytest.mark.parametrize("scale", [0.3, 2.5])
def test_moments_are_circular(scale):
    law = WrappedNormal(2.9, scale)
    n = 20_000
    x = law.sample(torch.Size([n]))
    torch.testing.assert_close(x.cos().mean(), (1 - law.variance) * law.mean.cos(), rtol=0, atol=5 * 0.71 / n**0.5)
    torch.testing.assert_close(x.sin().mean(), (1 - law.variance) * law.mean.sin(), rtol=0, atol=5 * 0.71 / n**0.5)


def test_a_huge_spread_is_uniform():
    law = WrappedNormal(torch.tensor(0.8), torch.tensor(1e6))
    torch.testing.assert_close(law.log_prob(angles()), torch.full((25,), -math.log(2 * math.pi)))
    torch.testing.assert_close(law.variance, torch.tensor(1.0))


def test_a_small_spread_is_the_normal_law_in_float32():
    loc, scale = torch.tensor(0.5, dtype=torch.float32), torch.tensor(1e-4, dtype=torch.float32)
    value = torch.tensor([0.5001, 0.3, -2.6, 3.0], dtype=torch.float32)
    torch.testing.assert_close(WrappedNormal(loc, scale).log_prob(value), Normal(loc, scale).log_prob(value))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_samples_are_wrapped_as_angles_are(dtype):
    loc = torch.full((20_000,), math.pi, dtype=dtype)
    x = WrappedNormal(loc, 1.3).sample()
    torch.manual_seed(0)
    assert ((x >= -math.pi) & (x < math.pi)).all()
    expected = wrap_angle(loc + 1.3 * torch.randn(loc.shape, dtype=dtype))
    torch.testing.assert_close(x, expected, rtol=0, atol=8 * torch.finfo(dtype).eps)


def test_samples_move_with_loc_wherever_they_are_wrapped():
    loc, scale = torch.full((500,), 3.0, requires_grad=True), torch.tensor(0.8, requires_grad=True)
    x = WrappedNormal(loc, scale).rsample()
    x.sum().backward()
    turns = torch.round((loc - x) / (2 * math.pi)).detach()
    assert torch.equal(loc.grad, torch.ones(500))
    torch.testing.assert_close(scale.grad, ((x + 2 * math.pi * turns - loc) / scale).sum().detach())
    assert turns.unique().tolist() == [0, 1]


def test_works_in_a_pyro_model():
    class PyroLaw(WrappedNormal, TorchDistributionMixin):
        """How a pyro user takes a torch law in."""

    with pyro.plate("talkers", 6):
        drawn = pyro.sample("x", PyroLaw(torch.tensor(3.0), torch.tensor(0.5)))
    assert drawn.shape == (6,)


def test_nan_stays_nan():
    assert WrappedNormal(0.5, 1.0, validate_args=False).log_prob(torch.tensor(torch.nan)).isnan()
    assert WrappedNormal(torch.tensor(torch.nan), 1.0, validate_args=False).mean.isnan()


def test_rejects_what_is_not_an_angle_or_a_spread():
    with pytest.raises(ValueError, match="support"):
        WrappedNormal(0.0, 1.0).log_prob(torch.tensor(3.2))
    with pytest.raises(ValueError, match="scale"):
        WrappedNormal(0.0, torch.tensor(0.0))
