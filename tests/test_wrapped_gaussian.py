"""WrappedGaussian: against many windings of a multivariate normal law, turns, and its own noise."""

import math

import pyro
import pytest
import torch
from pyro.distributions.torch_distribution import TorchDistributionMixin
from torch.distributions import MultivariateNormal

from probtrack.distributions import LinearGaussian, WrappedGaussian, WrappedNormal
from probtrack.errors import InputError, SingularLawError

TURN = 2 * math.pi


def law_of(spread, angle=1, *batch):
    """Law in three dimensions, all correlated, whose angle has about that spread [rad]."""
    gain = torch.tensor([[0.5, 0.2, 0.1], [0.6, 0.7, 0.3], [-0.2, 0.5, 0.4]])
    gain = torch.cat([gain[:angle], spread * gain[angle : angle + 1], gain[angle + 1 :]])
    return WrappedGaussian(LinearGaussian(torch.tensor([0.4, 2.9, -1.0]).expand(*batch, 3), gain), angle)


def many_windings(law, value):
    offsets = torch.zeros(401, 3)
    offsets[:, law.angle] = TURN * torch.arange(-200, 201)
    reference = MultivariateNormal(law.base.loc, law.base.gain @ law.base.gain.mT)
    return reference.log_prob(value + offsets[:, None]).logsumexp(0)


@pytest.mark.parametrize("spread", [1e-3, 0.3, 1.0, 4.0, 20.0])
@pytest.mark.parametrize("angle", [0, 1, 2])
def test_log_prob_is_the_sum_over_many_windings(spread, angle):
    law = law_of(spread, angle)
    value = law.sample(torch.Size([50]))
    torch.testing.assert_close(law.log_prob(value), many_windings(law, value), rtol=1e-9, atol=1e-9)


def test_it_is_centred_where_the_other_variables_put_the_angle():
    """Far from the mean, but on the line along which angle and rate go together."""
    law = WrappedGaussian(LinearGaussian(torch.zeros(2), torch.tensor([[1.0, 0.1], [1.0, 0.0]])), 0)
    value = torch.tensor([3.0, 3.0 + 4 * TURN])
    expected = law.base.log_prob(value + torch.tensor([4 * TURN, 0.0]))
    torch.testing.assert_close(law.log_prob(value), expected)


def test_one_variable_is_the_wrapped_normal_law():
    law = WrappedGaussian(LinearGaussian(torch.tensor([2.9]), torch.tensor([[0.8]])), 0)
    value = torch.linspace(-3, 3, 9)
    torch.testing.assert_close(law.log_prob(value[:, None]), WrappedNormal(2.9, 0.8).log_prob(value))


@pytest.mark.parametrize("turns", [-3, 1])
def test_whole_turns_do_not_count(turns):
    law, turned = law_of(0.5), law_of(0.5)
    turned.base.loc = law.base.loc + turns * TURN * torch.tensor([0.0, 1.0, 0.0])
    value = law.sample(torch.Size([9]))
    torch.testing.assert_close(turned.log_prob(value), law.log_prob(value))
    torch.testing.assert_close(
        turned.log_prob(value - turns * TURN * torch.tensor([0.0, 1.0, 0.0])), law.log_prob(value)
    )
    torch.testing.assert_close(turned.mean, law.mean)


def test_other_variables_are_as_they_were():
    law = law_of(0.5)
    noise = 8 * torch.randn(200, 3)  # so that the others are beyond pi too
    value, before = law.at_noise(noise), law.base.at_noise(noise)
    assert torch.equal(value[:, [0, 2]], before[:, [0, 2]])
    turns = (before - value)[:, 1] / TURN
    torch.testing.assert_close(turns, turns.round())
    assert ((value[:, 1] >= -math.pi) & (value[:, 1] < math.pi)).all()
    assert turns.round().unique().numel() > 2


def test_moments_are_those_before_wrapping():
    law = law_of(1.0)
    torch.testing.assert_close(law.covariance_matrix, law.base.gain @ law.base.gain.mT)
    torch.testing.assert_close(law.variance, law.covariance_matrix.diagonal())
    turned = WrappedGaussian(LinearGaussian(torch.tensor([0.4, 4.0]), torch.eye(2)), 1)
    torch.testing.assert_close(turned.mean, torch.tensor([0.4, 4.0 - TURN]))
    torch.testing.assert_close(turned.mode, turned.mean)


def test_the_angle_has_the_circular_mean_of_the_law():
    law, n = law_of(1.0), 20_000
    x = law.sample(torch.Size([n]))[:, 1]
    shrink = torch.exp(-0.5 * law.variance[1])
    torch.testing.assert_close(x.cos().mean(), shrink * law.mean[1].cos(), rtol=0, atol=5 * 0.71 / n**0.5)
    torch.testing.assert_close(x.sin().mean(), shrink * law.mean[1].sin(), rtol=0, atol=5 * 0.71 / n**0.5)


@pytest.mark.parametrize("noise", [[0.1, -0.2], [2.0, 3.0]])
def test_noise_gradients_do_not_see_the_wrap(noise):
    leaves = [torch.tensor(x, requires_grad=True) for x in ([3.0, 0.2], [[0.5, 0.3], [0.1, 0.7]], noise)]
    assert torch.autograd.gradcheck(lambda x, g, u: WrappedGaussian(LinearGaussian(x, g), 0).at_noise(u), leaves)


def test_batches_of_values_and_laws_broadcast():
    law, value = law_of(0.7, 1, 4), torch.randn(5, 1, 3)
    assert law.log_prob(value).shape == (5, 4)
    torch.testing.assert_close(law.log_prob(value)[3, 2], law_of(0.7).log_prob(value[3, 0]))
    torch.testing.assert_close(law_of(0.7).log_prob(value)[3, 0], law_of(0.7).log_prob(value[3, 0]))
    assert law.noise_dim == 3


def test_narrow_and_wide_laws_may_share_a_batch():
    gain = torch.tensor([[[1e-3]], [[6.0]]])
    law = WrappedGaussian(LinearGaussian(torch.tensor([0.4]), gain), 0)
    value = torch.tensor([0.4004])
    expected = torch.stack([WrappedNormal(0.4, s).log_prob(value[0]) for s in (1e-3, 6.0)])
    torch.testing.assert_close(law.log_prob(value), expected)


def test_no_density_if_the_law_before_wrapping_has_none():
    law = WrappedGaussian(LinearGaussian(torch.zeros(2), torch.tensor([[0.1], [0.2]])), 0)
    with pytest.raises(SingularLawError, match="has no density"):
        law.log_prob(law.sample())


def test_works_in_a_pyro_model():
    class PyroLaw(WrappedGaussian, TorchDistributionMixin):
        """How a pyro user takes a torch law in."""

    def model():
        with pyro.plate("talkers", 6):
            return pyro.sample("x", PyroLaw(law_of(0.5).base, 1))

    trace = pyro.poutine.trace(model).get_trace()
    assert trace.nodes["x"]["value"].shape == (6, 3)
    assert trace.log_prob_sum().isfinite()


@pytest.mark.parametrize("angle", [-1, 3, 1.0, True])
def test_rejects_an_angle_that_is_no_variable(angle):
    with pytest.raises(InputError, match=f"angle must be the index of a variable, 0 to 2, got {angle}"):
        WrappedGaussian(law_of(0.5).base, angle)


@pytest.mark.parametrize("spread", [1e-20, 1e-8, 1e4, 1e8, 1e18])
def test_extreme_spreads_are_never_nan_in_float32(spread):
    gain = torch.tensor([[spread, 0.0], [0.5 * spread, spread]], dtype=torch.float32)
    law = WrappedGaussian(LinearGaussian(torch.zeros(2, dtype=torch.float32), gain), angle=0)
    value = law.sample(torch.Size([5]))
    assert not law.log_prob(value).isnan().any()
