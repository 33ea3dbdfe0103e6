"""LinearGaussian: against the normal laws of torch, quadrature, and its own noise."""

import pyro
import pytest
import torch
from properties import assert_moments, assert_normalised, assert_shapes
from pyro.distributions.torch_distribution import TorchDistributionMixin
from torch.distributions import Independent, MultivariateNormal, Normal

from probtrack.distributions import LinearGaussian
from probtrack.dynamics.base import driven_by
from probtrack.errors import InputError, ShapeError, SingularLawError


def full_rank(*batch):
    """Law in three dimensions driven by five numbers, with rows of very different scale."""
    return LinearGaussian(torch.randn(*batch, 3), torch.randn(*batch, 3, 5) * torch.tensor([[1e-4], [1.0], [300.0]]))


def rank_one():
    return LinearGaussian(torch.tensor([0.3, -2.0]), torch.tensor([[0.016], [0.7]]))


@pytest.mark.parametrize(
    ("loc", "gain", "batch"), [((2,), (2, 1), ()), ((4, 1, 2), (3, 2, 5), (4, 3)), ((6, 3), (3, 2), (6,))]
)
def test_loc_and_gain_broadcast(loc, gain, batch):
    assert_shapes(LinearGaussian(torch.randn(loc), torch.randn(gain)), batch, loc[-1:])


def test_log_prob_is_the_multivariate_normal_one():
    law = full_rank(4)
    value = law.sample(torch.Size([7]))
    reference = MultivariateNormal(law.loc, law.gain @ law.gain.mT)
    torch.testing.assert_close(law.log_prob(value), reference.log_prob(value))


def test_log_prob_shares_one_gain_between_locations():
    loc, gain, value = torch.randn(6, 3), torch.randn(3, 4), torch.randn(6, 3)
    shared, copied = LinearGaussian(loc, gain), LinearGaussian(loc, gain.repeat(6, 1, 1))
    torch.testing.assert_close(shared.log_prob(value), copied.log_prob(value))


def test_density_integrates_to_one():
    law = LinearGaussian(torch.tensor([0.4, -0.2]), torch.tensor([[0.5, 0.1, 0.2], [-0.3, 0.4, 0.0]]))
    ticks = torch.arange(-5, 5, 0.04)
    assert_normalised(law, torch.cartesian_prod(ticks, ticks), 0.04**2)


def test_moments_are_those_of_the_samples():
    law = LinearGaussian(torch.tensor([0.4, -2.0]), torch.tensor([[0.5, 0.1, 0.2], [-0.3, 0.4, 0.0]]))
    assert_moments(law, law.mean, law.covariance_matrix)
    torch.testing.assert_close(law.variance, law.covariance_matrix.diagonal())
    torch.testing.assert_close(law.mode, law.mean)


def test_samples_of_a_rank_one_law_lie_on_its_line():
    law = rank_one()
    offset = law.sample(torch.Size([50])) - law.loc
    torch.testing.assert_close(offset[:, 0] / offset[:, 1], torch.full((50,), 0.016 / 0.7))
    assert_moments(law, law.mean, law.covariance_matrix)


def test_value_at_noise_is_loc_plus_gain_times_noise():
    law, noise = full_rank(4), torch.randn(4, 5)
    expected = torch.stack([law.loc[i] + law.gain[i] @ noise[i] for i in range(4)])
    torch.testing.assert_close(law.at_noise(noise), expected)
    torch.testing.assert_close(driven_by(law, noise), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("gain", [
    [[0.016], [0.7]],
    [[0.1, 0.7], [0.3, 2.1]],
    [[0.1, 0.7, -0.2], [0.0, 0.0, 0.0]],
    [[0.1, 0.7], [0.3, 0.2], [0.4, 0.9]],
])  # fmt: skip
def test_no_density_without_full_row_rank(gain, scale, dtype):
    gain = scale * torch.tensor(gain, dtype=dtype)
    law = LinearGaussian(torch.zeros(gain.shape[0], dtype=dtype), gain)
    with pytest.raises(SingularLawError, match=r"has no density: .* Sample it"):
        law.log_prob(law.sample())


def test_a_variable_without_noise_is_said_to_be():
    with pytest.raises(SingularLawError, match="no noise reaches some variable"):
        LinearGaussian(torch.zeros(2), torch.tensor([[0.3, 0.1], [0.0, 0.0]])).log_prob(torch.zeros(2))


def test_no_density_if_one_of_a_batch_has_none():
    gain = torch.randn(3, 2, 4)
    gain[1, 1] = -2 * gain[1, 0]
    with pytest.raises(SingularLawError, match="depend on each other"):
        LinearGaussian(torch.zeros(2), gain).log_prob(torch.zeros(2))


@pytest.mark.parametrize(("dtype", "tilt"), [(torch.float32, 1e-3), (torch.float64, 1e-8)])
@pytest.mark.parametrize("units", [1e-9, 1.0, 1e9])
def test_a_thin_law_has_a_density_in_any_units(dtype, tilt, units):
    gain = torch.tensor([[1.0, 0.0], [units, units * tilt]], dtype=dtype)
    at_mean = LinearGaussian(torch.zeros(2, dtype=dtype), gain).log_prob(torch.zeros(2, dtype=dtype))
    expected = -torch.tensor(2 * torch.pi * units * tilt, dtype=dtype).log()
    torch.testing.assert_close(at_mean, expected, rtol=1e-4, atol=1e-4)


def test_log_prob_gradients():
    law = full_rank(2)
    value = law.sample()
    leaves = [x.clone().requires_grad_() for x in (law.loc / law.stddev, law.gain / law.stddev[..., None])]
    value = value / law.stddev
    assert torch.autograd.gradcheck(lambda loc, gain: LinearGaussian(loc, gain).log_prob(value), leaves)


def test_noise_gradients_reach_loc_and_gain():
    noise = torch.randn(4, 2)
    leaves = [torch.randn(4, 3, requires_grad=True), torch.randn(3, 2, requires_grad=True)]
    assert torch.autograd.gradcheck(lambda loc, gain: LinearGaussian(loc, gain).at_noise(noise), leaves)
    LinearGaussian(*leaves).rsample(torch.Size([2])).square().sum().backward()
    assert all((x.grad != 0).all() for x in leaves)


def test_expand_repeats_the_law():
    law = full_rank(4)
    wide = law.expand(torch.Size([2, 4]))
    value = wide.sample()
    assert_shapes(wide, (2, 4), (3,))
    torch.testing.assert_close(wide.log_prob(value), law.log_prob(value))
    assert wide.expand(torch.Size([5, 2, 4])).sample().shape == (5, 2, 4, 3)


def test_float32_is_close_to_float64():
    law = full_rank(4)
    loc = law.loc * law.stddev  # else what is lost is in value - loc
    value = loc + law.gain.sum(-1)
    single = LinearGaussian(loc.float(), law.gain.float()).log_prob(value.float())
    torch.testing.assert_close(single.double(), LinearGaussian(loc, law.gain).log_prob(value), rtol=1e-5, atol=1e-5)


def test_works_in_a_pyro_model():
    class PyroLaw(LinearGaussian, TorchDistributionMixin):
        """How a pyro user takes a torch law in."""

    law = full_rank()
    with pyro.plate("talkers", 6):
        drawn = pyro.sample("x", PyroLaw(law.loc, law.gain))
    trace = pyro.poutine.trace(lambda: pyro.sample("x", PyroLaw(law.loc, law.gain).expand([6]).to_event(1))).get_trace()
    assert drawn.shape == (6, 3)
    torch.testing.assert_close(trace.log_prob_sum(), law.log_prob(trace.nodes["x"]["value"]).sum())


@pytest.mark.parametrize(("loc", "gain", "match"), [
    ((), (2, 2), r"loc must have shape \(\.\.\., D\)"),
    ((2,), (2,), r"gain must have shape \(\.\.\., 2, K\), got \(2,\)"),
    ((3,), (2, 3), r"gain must have shape \(\.\.\., 3, 3\), got \(2, 3\)"),
])  # fmt: skip
def test_rejects_wrong_shapes(loc, gain, match):
    with pytest.raises(ShapeError, match=match):
        LinearGaussian(torch.zeros(loc), torch.zeros(gain))


def test_rejects_nan():
    with pytest.raises(ValueError, match="loc"):
        LinearGaussian(torch.tensor([0.0, torch.nan]), torch.eye(2))
    with pytest.raises(ValueError, match="support"):
        LinearGaussian(torch.zeros(2), torch.eye(2)).log_prob(torch.tensor([torch.nan, 0.0]))


LAWS = {
    "independent": lambda: Independent(Normal(torch.tensor([1.0, 2.0]), torch.tensor([0.1, 0.3])), 1),
    "multivariate": lambda: MultivariateNormal(torch.ones(2), torch.tensor([[2.0, 0.3], [0.3, 0.7]])),
    "rank one": rank_one,
}


@pytest.mark.parametrize(("name", "size"), [("independent", 2), ("multivariate", 2), ("rank one", 1)])
def test_what_noise_drives_has_the_moments_of_the_law(name, size):
    law, n = LAWS[name](), 20_000
    values = driven_by(law, torch.randn(n, size))
    variance = law.variance
    assert ((values.mean(0) - law.mean).abs() < 5 * (variance / n).sqrt()).all()
    assert ((values.var(0) - variance).abs() < 5 * variance * (2 / n) ** 0.5).all()


def test_what_noise_drives_is_correlated_as_the_law_is():
    law = LAWS["multivariate"]()
    covariance = driven_by(law, torch.randn(20_000, 2)).T.cov()[0, 1]
    assert abs(covariance - 0.3) < 5 * ((2.0 * 0.7 + 0.3**2) / 20_000) ** 0.5


def test_noise_cannot_drive_a_law_that_is_not_gaussian():
    with pytest.raises(InputError, match="returns Laplace must define transition itself"):
        driven_by(torch.distributions.Laplace(0.0, 1.0), torch.zeros(1))
