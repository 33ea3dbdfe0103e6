"""TruncatedNormal: against scipy, its tails, and its limits."""

import math

import pytest
import torch
from scipy import stats

from probtrack.distributions import TruncatedNormal
from probtrack.errors import InputError

LAWS = [
    (0.3, 0.5, -1.0, 1.2),
    (4.0, 1.5, -1.0, 2.0),
    (-7.0, 1.5, -1.0, 2.0),
    (-1.0, 0.8, -1.0, 2.0),
    (0.1, 0.2, -9.0, 9.0),
]


def law_of(loc, scale, low, high, **options):
    return TruncatedNormal(*(torch.tensor(x) for x in (loc, scale, low, high)), **options)


def oracle(loc, scale, low, high):
    return stats.truncnorm((low - loc) / scale, (high - loc) / scale, loc, scale)


def quantiles():
    return torch.tensor([1e-9, 1e-3, 0.2, 0.5, 0.7, 0.999, 1 - 1e-9])


@pytest.mark.parametrize("numbers", LAWS)
def test_log_prob_and_cdf_are_those_of_scipy(numbers):
    law, expected = law_of(*numbers), oracle(*numbers)
    x = torch.linspace(numbers[2], numbers[3], 9)
    torch.testing.assert_close(law.log_prob(x), torch.as_tensor(expected.logpdf(x)))
    torch.testing.assert_close(law.cdf(x), torch.as_tensor(expected.cdf(x)))


@pytest.mark.parametrize("numbers", LAWS)
def test_moments_are_those_of_scipy(numbers):
    law, expected = law_of(*numbers), oracle(*numbers)
    torch.testing.assert_close(law.mean, torch.tensor(expected.mean()), rtol=1e-9, atol=0)
    torch.testing.assert_close(law.variance, torch.tensor(expected.var()), rtol=1e-9, atol=0)


@pytest.mark.parametrize("numbers", LAWS)
def test_quantiles_are_those_of_scipy(numbers):
    torch.testing.assert_close(law_of(*numbers).icdf(quantiles()), torch.as_tensor(oracle(*numbers).ppf(quantiles())))


@pytest.mark.parametrize("numbers", LAWS)
def test_ends_are_the_quantiles_of_zero_and_one(numbers):
    law = law_of(*numbers)
    torch.testing.assert_close(law.icdf(torch.tensor([0.0, 1.0])), torch.tensor(numbers[2:]))
    torch.testing.assert_close(law.cdf(torch.tensor(numbers[2:])), torch.tensor([0.0, 1.0]))


@pytest.mark.parametrize("numbers", [*LAWS, (40.0, 1.0, -1.0, 2.0), (0.2, 50.0, -1.0, 2.0)])
def test_quantile_gradients(numbers):
    leaves = [torch.tensor(x, requires_grad=True) for x in (*numbers, 0.3)]
    assert torch.autograd.gradcheck(lambda *x: TruncatedNormal(*x[:4]).icdf(x[4]), leaves)
    leaves = [torch.tensor(x, requires_grad=True) for x in (*numbers, 0.3)]
    assert torch.autograd.gradcheck(lambda *x: TruncatedNormal(*x[:4]).cdf(x[4]), leaves)


@pytest.mark.parametrize("far", [40.0, 300.0, 1e5])
@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_far_outside_it_is_exponential(far, dtype, rtol):
    """With a = far, the tail is a exp(-a s) up to terms of 1 / a^2, which the exact ones below include."""
    law = TruncatedNormal(torch.tensor(-far, dtype=dtype), 1.0, 0.0, 5.0)
    s = torch.tensor(0.5 / far, dtype=dtype)
    mills = math.sqrt(math.pi / 2) * torch.special.erfcx(torch.tensor(far / math.sqrt(2)))
    expected = -far * s.double() - 0.5 * s.double() ** 2 - mills.log()
    torch.testing.assert_close(law.log_prob(s).double(), expected, rtol=rtol, atol=rtol)


@pytest.mark.parametrize("far", [40.0, 1e4])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_both_sides_are_mirror_images(far, dtype):
    u, ends = torch.rand(50, dtype=dtype), (torch.tensor(-1.0, dtype=dtype), torch.tensor(2.0, dtype=dtype))
    above = TruncatedNormal(ends[1] + far, 1.0, *ends)
    below = TruncatedNormal(-ends[1] - far, 1.0, -ends[1], -ends[0])
    x = above.icdf(u)
    torch.testing.assert_close(below.icdf(1 - u), -x, rtol=0, atol=1e-3 / far)
    torch.testing.assert_close(below.log_prob(-x), above.log_prob(x))
    torch.testing.assert_close(below.mean, -above.mean)
    torch.testing.assert_close(below.variance, above.variance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("loc", [0.3, -8.0, 700.0])
def test_a_very_wide_law_is_uniform(loc, dtype):
    law = TruncatedNormal(torch.tensor(loc, dtype=dtype), 1e7, -1.0, 3.0)
    u = torch.tensor([0.0, 0.01, 0.5, 0.99], dtype=dtype)
    torch.testing.assert_close(law.icdf(u), 4 * u - 1, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(law.log_prob(law.icdf(u)), torch.full_like(u, -math.log(4)), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(law.variance, torch.tensor(16 / 12, dtype=dtype), rtol=1e-6, atol=1e-6)


def test_samples_carry_the_gradient_of_their_mean():
    loc, scale = torch.tensor(0.6, requires_grad=True), torch.tensor(0.7, requires_grad=True)
    law = TruncatedNormal(loc, scale, -1.0, 1.2)
    exact = torch.autograd.grad(law.mean, [loc, scale])
    draws = law.rsample(torch.Size([20_000]))
    sampled = torch.autograd.grad(draws.mean(), [loc, scale])
    torch.testing.assert_close(sampled, exact, rtol=0, atol=5 * 1.0 / 20_000**0.5)  # gradients lie in [-1, 1]


def test_samples_of_float32_stay_inside_with_finite_gradients():
    loc = torch.linspace(-60, 60, 3001, dtype=torch.float32, requires_grad=True)
    draws = TruncatedNormal(loc, 1.0, -1.0, 2.0).rsample(torch.Size([30]))
    draws.sum().backward()
    assert ((draws >= -1) & (draws <= 2)).all()
    assert loc.grad.isfinite().all()
    assert (loc.grad >= 0).all()


def test_density_outside_is_zero_if_values_are_not_checked():
    law = law_of(0.3, 0.5, -1.0, 1.2, validate_args=False)
    outside = torch.tensor([-1.01, 1.3])
    assert torch.equal(law.log_prob(outside), torch.tensor([-math.inf, -math.inf]))
    assert torch.equal(law.cdf(outside), torch.tensor([0.0, 1.0]))


def test_gradients_are_right_where_loc_is_an_end():
    numbers = [torch.tensor(x, requires_grad=True) for x in (-1.0, 0.8, -1.0, 2.0)]
    at_end = torch.autograd.grad(TruncatedNormal(*numbers).log_prob(torch.tensor(0.4)), numbers)
    beside = [torch.tensor(x, requires_grad=True) for x in (-1.0 - 1e-9, 0.8, -1.0, 2.0)]
    expected = torch.autograd.grad(TruncatedNormal(*beside).log_prob(torch.tensor(0.4)), beside)
    torch.testing.assert_close(at_end, expected, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize(("low", "high"), [(1.0, 1.0), (2.0, 1.0), (-math.inf, 1.0)])
def test_rejects_an_interval_that_is_none(low, high):
    with pytest.raises(InputError, match=r"low must be less than high and both finite, got low .* and high"):
        law_of(0.0, 1.0, low, high)


def test_rejects_values_outside_and_probabilities_that_are_none():
    law = law_of(0.0, 1.0, -1.0, 1.0)
    with pytest.raises(ValueError, match="support"):
        law.log_prob(torch.tensor(1.1))
    with pytest.raises(InputError, match=r"value must be a probability in \[0, 1\], got 1.1"):
        law.icdf(torch.tensor(1.1))
    with pytest.raises(ValueError, match="scale"):
        law_of(0.0, -1.0, -1.0, 1.0)
