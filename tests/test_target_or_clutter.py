"""TargetOrClutter: against its two laws, at certainty, and over vectors."""

import math

import pyro
import pytest
import torch
from pyro.distributions.torch_distribution import TorchDistributionMixin
from torch.distributions import Gamma, Independent, MultivariateNormal, Normal, Uniform

from probtrack.distributions import TargetOrClutter, TruncatedNormal, WrappedNormal
from probtrack.errors import ShapeError


def heading(logit, scale=0.3):
    return TargetOrClutter(WrappedNormal(2.8, scale), Uniform(-math.pi, math.pi), torch.as_tensor(logit))


def test_density_is_the_weighted_sum_of_both():
    law, q = heading(math.log(0.8 / 0.2)), 0.8
    value = torch.linspace(-3.1, 3.1, 11)
    expected = (1 - q) * WrappedNormal(2.8, 0.3).log_prob(value).exp() + q / (2 * math.pi)
    torch.testing.assert_close(law.log_prob(value).exp(), expected)


def test_clutter_alone_explains_what_the_target_cannot():
    law = TargetOrClutter(TruncatedNormal(0.1, 0.2, -1.0, 1.0), Normal(0.0, 2.0), torch.tensor(-1.0))
    expected = Normal(0.0, 2.0).log_prob(torch.tensor(1.5)) + torch.tensor(-1.0).sigmoid().log()
    torch.testing.assert_close(law.log_prob(torch.tensor(1.5)), expected)


@pytest.mark.parametrize(
    ("logit", "expected"), [(-math.inf, lambda: Normal(0.3, 0.2)), (math.inf, lambda: Uniform(-1.0, 1.0))]
)
@pytest.mark.parametrize("at", [0.4, 0.9])
def test_certainty_is_one_law_alone(logit, expected, at):
    leaves = [torch.tensor(x, requires_grad=True) for x in (0.3, 0.2, logit, at)]
    law = TargetOrClutter(Normal(*leaves[:2]), Uniform(-1.0, 1.0), leaves[2])
    torch.testing.assert_close(law.log_prob(leaves[3]), expected().log_prob(torch.tensor(at)))
    gradients = torch.autograd.grad(law.log_prob(leaves[3]), leaves)
    assert all(x.isfinite() for x in gradients)
    torch.testing.assert_close([law.mean, law.variance], [expected().mean, expected().variance])
    assert (law.sample(torch.Size([50])).abs() < 1.2).all()


@pytest.mark.parametrize("logit", [-math.inf, 0.3, math.inf])
def test_an_impossible_value_has_no_density_and_no_nan(logit):
    leaves = [torch.tensor(x, requires_grad=True) for x in (0.3, 0.2, logit, 1.4)]
    law = TargetOrClutter(TruncatedNormal(*leaves[:2], -1, 1), Uniform(-1.0, 1.0), leaves[2], validate_args=False)
    log_prob = law.log_prob(leaves[3])
    assert log_prob == -math.inf
    assert all((x == 0).all() for x in torch.autograd.grad(log_prob, leaves))


def test_clutter_has_its_share_of_the_samples():
    law, n = TargetOrClutter(Uniform(0.0, 1.0), Uniform(2.0, 3.0), torch.tensor(-0.7)), 20_000
    q = torch.tensor(-0.7).sigmoid()
    share = (law.sample(torch.Size([n])) > 1.5).double().mean()
    assert (share - q).abs() < 5 * (q * (1 - q) / n).sqrt()


def test_each_value_has_its_own_origin():
    law = TargetOrClutter(Uniform(0.0, 1.0), Uniform(2.0, 3.0), torch.zeros(3))
    is_clutter = law.sample(torch.Size([200])) > 1.5
    assert (is_clutter[:, 0] != is_clutter[:, 1]).any()


def test_a_vector_is_of_one_origin():
    target = Independent(Uniform(torch.zeros(2), torch.ones(2)), 1)
    clutter = Independent(Uniform(torch.full((5, 2), 2.0), torch.full((5, 2), 3.0)), 1)
    law = TargetOrClutter(target, clutter, torch.zeros(4, 1))
    x = law.sample(torch.Size([20]))
    assert (law.batch_shape, law.event_shape, x.shape) == ((4, 5), (2,), (20, 4, 5, 2))
    assert law.mean.shape == law.variance.shape == (4, 5, 2)
    assert torch.equal(x[..., 0] > 1.5, x[..., 1] > 1.5)
    torch.testing.assert_close(law.log_prob(x), torch.full((20, 4, 5), -math.log(2)))


def test_moments_of_a_vector_are_those_of_the_mixture():
    law = TargetOrClutter(
        MultivariateNormal(torch.tensor([1.0, -2.0]), torch.tensor([[2.0, 0.3], [0.3, 0.7]])),
        Independent(Normal(torch.tensor([0.0, 3.0]), torch.tensor([0.5, 2.0])), 1),
        torch.tensor(0.25).logit(),
    )
    torch.testing.assert_close(law.mean, torch.tensor([0.75, -0.75]))
    torch.testing.assert_close(law.variance, torch.tensor([1.75, 6.2125]))  # E x^2 - (E x)^2 by hand


def test_angles_have_no_moments_on_the_line():
    with pytest.raises(NotImplementedError, match="on the circle"):
        _ = heading(0.0).mean
    with pytest.raises(NotImplementedError, match="on the circle"):
        _ = heading(0.0).variance


def test_laws_of_any_support_mix():
    law = TargetOrClutter(Gamma(2.0, 1.0), Normal(0.0, 1.0), torch.tensor(0.0), validate_args=True)
    expected = Normal(0.0, 1.0).log_prob(torch.tensor(-0.5)) - math.log(2)
    torch.testing.assert_close(law.log_prob(torch.tensor(-0.5)), expected)


def test_the_two_laws_are_left_as_they_were():
    target = TruncatedNormal(0.1, 0.2, -1.0, 1.0)
    TargetOrClutter(target, Normal(0.0, 2.0), torch.tensor(0.0))
    with pytest.raises(ValueError, match="support"):
        target.log_prob(torch.tensor(1.5))


def test_a_gradient_reaches_the_probability_of_clutter():
    logit = torch.tensor(0.3, requires_grad=True)
    heading(logit).log_prob(torch.tensor(-1.0)).backward()  # far from the target: surely clutter
    torch.testing.assert_close(logit.grad, 1 - torch.tensor(0.3).sigmoid(), rtol=1e-6, atol=0)


def test_works_in_a_pyro_model():
    class PyroLaw(TargetOrClutter, TorchDistributionMixin):
        """How a pyro user takes a torch law in."""

    def model():
        with pyro.plate("pairs", 6):
            return pyro.sample("x", PyroLaw(Normal(0.0, 1.0), Uniform(-9.0, 9.0), torch.tensor(0.0)))

    trace = pyro.poutine.trace(model).get_trace()
    assert trace.nodes["x"]["value"].shape == (6,)
    assert trace.log_prob_sum().isfinite()


def test_rejects_events_that_differ_and_values_that_neither_has():
    with pytest.raises(ShapeError, match=r"clutter must have the event shape of target, \(\), got \(2,\)"):
        TargetOrClutter(Normal(0.0, 1.0), Independent(Normal(torch.zeros(2), 1.0), 1), torch.tensor(0.0))
    with pytest.raises(ValueError, match="support"):
        heading(0.0).log_prob(torch.tensor(3.3))
    with pytest.raises(ValueError, match="logit_clutter"):
        heading(math.nan)
