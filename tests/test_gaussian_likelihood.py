"""A measured position with Gaussian error, against torch.distributions."""

import pytest
import torch
from properties import assert_gradients
from torch.distributions import Independent, Normal

from probtrack.dynamics import Kinematics
from probtrack.errors import InputError
from probtrack.likelihoods import GaussianPosition


def moving(position):
    return Kinematics(position, torch.zeros_like(position), position[..., 0])


def log_density(model, observations, position, t=1):
    prepared = model.prepare(observations)
    return model(type(prepared)(*(x[t] for x in prepared)), moving(position))


@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize(("recordings", "particles"), [((), ()), ((), (4,)), ((3,), (3,)), ((3, 1), (3, 4))])
def test_density_is_that_of_independent_normals(axes, recordings, particles):
    y, x = torch.randn(2, *recordings, axes), torch.randn(*particles, 7, axes)
    exact = Independent(Normal(x, 0.37), 1).log_prob(y[1][..., None, :])
    torch.testing.assert_close(log_density(GaussianPosition(0.37), y, x), exact)


def test_density_integrates_to_one_over_the_observation():
    line = (torch.arange(100) + 0.5) / 100 * 6 - 3
    y = torch.cartesian_prod(line, line)
    value = log_density(GaussianPosition(0.4), y[None], torch.tensor([[0.3, -0.2]]), 0)
    torch.testing.assert_close(value.exp().sum() * 0.06**2, torch.ones(()), rtol=0, atol=1e-3)


def test_gradients():
    assert_gradients(GaussianPosition(0.6), log_density, torch.randn(2, 2), torch.randn(5, 2))


def test_std_learns_and_is_kept():
    model, y, x = GaussianPosition(0.3), torch.randn(2, 2), torch.randn(5, 2)
    log_density(model, y, x).sum().backward()
    assert model.log_std.grad.isfinite()
    assert model.log_std.grad != 0
    again = GaussianPosition(1.0)
    again.load_state_dict(model.state_dict())
    assert torch.equal(log_density(again, y, x), log_density(model, y, x))


def test_maximum_likelihood_recovers_the_std():
    model, y = GaussianPosition(1.0), 0.25 * torch.randn(1, 4000, 2)
    optimiser = torch.optim.LBFGS(model.parameters(), line_search_fn="strong_wolfe")

    def loss():
        optimiser.zero_grad()
        value = -log_density(model, y, torch.zeros(1, 2), 0).mean()
        value.backward()
        return value

    optimiser.step(loss)
    assert abs(model.log_std.exp().item() / 0.25 - 1) < 0.1


@pytest.mark.parametrize("std", [0.0, -1.0, float("nan")])
def test_rejects_std(std):
    with pytest.raises(InputError, match="std must be finite and positive"):
        GaussianPosition(std)
