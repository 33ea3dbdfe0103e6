"""A measured position with Gaussian error, against torch.distributions."""

import pytest
import torch
from properties import assert_gradients
from torch.distributions import Independent, Normal

from probtrack.dynamics import Kinematics
from probtrack.errors import InputError, NotFiniteError, ShapeError
from probtrack.likelihoods import GaussianPosition, Positions


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


def some_missing(batch, axes=2):
    """Positions (4, *batch, axes) with NaN where nothing was measured."""
    observed = torch.rand(4, *batch) < 0.5
    observed[1], observed[2] = True, False
    position = torch.randn(4, *batch, axes)
    return Positions(torch.where(observed[..., None], position, torch.nan), observed)


@pytest.mark.parametrize("batch", [(), (5,), (3, 5)])
def test_what_is_missing_says_nothing(batch):
    model, y, x = GaussianPosition(0.37), some_missing(batch), torch.randn(*batch, 7, 2)
    for t in range(4):
        seen = y.observed[t, ..., None].expand(*batch, 7)
        value, complete = log_density(model, y, x, t), log_density(model, y.position, x, t)
        torch.testing.assert_close(value[seen], complete[seen], rtol=0, atol=0)
        assert (value[~seen] == 0).all()


def test_gradients_do_not_see_what_is_missing():
    model, y = GaussianPosition(0.37), some_missing((5,))
    x = torch.randn(5, 7, 2, requires_grad=True)
    sum(log_density(model, y, x, t).sum() for t in range(4)).backward()
    seen, again = model.log_std.grad.clone(), GaussianPosition(0.37)
    expected = sum(log_density(again, y.position.nan_to_num(9.0), x, t)[y.observed[t]].sum() for t in range(4))
    expected.backward()
    torch.testing.assert_close(seen, again.log_std.grad)
    assert x.grad.isfinite().all()
    x.grad = None
    log_density(model, y, x, 2).sum().backward()
    assert (x.grad == 0).all()


def test_missing_positions_in_float32_stay_in_float32():
    y = Positions(torch.full((1, 3, 2), torch.nan), torch.zeros(1, 3, dtype=torch.bool))
    y = y._replace(position=y.position.float())
    assert log_density(GaussianPosition(0.1).float(), y, torch.randn(3, 7, 2).float(), 0).dtype == torch.float32


def test_rejects_a_measured_position_that_is_not_finite():
    position = torch.zeros(4, 3, 2)
    position[2, 1, 0] = torch.nan
    with pytest.raises(NotFiniteError, match="measured positions must be finite, not so in frame 2"):
        GaussianPosition(0.1).prepare(Positions(position, torch.ones(4, 3, dtype=torch.bool)))


@pytest.mark.parametrize("observed", [torch.ones(4, 3), torch.ones(4, dtype=torch.bool)])
def test_rejects_flags_that_do_not_fit(observed):
    with pytest.raises(ShapeError, match=r"observed must be bool of shape \(4, 3\), got"):
        GaussianPosition(0.1).prepare(Positions(torch.zeros(4, 3, 2), observed))
