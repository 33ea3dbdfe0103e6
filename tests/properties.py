"""Laws that every density and every motion model must obey."""

import copy
import io

import torch
from torch.func import functional_call


def assert_shapes(law, batch, event):
    """Samples are (sample, *batch, *event) and what is per value drops the event."""
    draws = law.sample(torch.Size([3, 7]))
    assert law.batch_shape == batch
    assert law.event_shape == event
    assert draws.shape == (3, 7, *batch, *event)
    assert law.mean.shape == law.variance.shape == (*batch, *event)


def assert_normalised(law, grid, cell, tol=1e-3):
    """The density of `law` (no batch) sums to one over `grid` (G, *event) of cells of that volume."""
    total = law.log_prob(grid).exp().sum() * cell
    torch.testing.assert_close(total, torch.ones(()), rtol=0, atol=tol)


def assert_moments(law, mean, covariance, z=5.0, n=20_000):
    """Sample mean and covariance of `law` (no batch) are `mean` and `covariance` within z standard errors."""
    draws = law.sample(torch.Size([n]))
    products = ((draws - mean)[:, :, None] * (draws - mean)[:, None, :]).flatten(1)
    for sample, exact in [(draws, mean), (products, covariance.flatten())]:
        error, std_error = sample.mean(0) - exact, sample.std(0) / n**0.5
        assert (error.abs() <= z * std_error + 1e-12).all(), f"{error} > {z} x {std_error}"


def box(*sides):
    """Midpoints (G, D) of the cells of a box of sides (low, high, cells), or (G) if D is one, and a cell's volume."""
    ticks = [low + (high - low) / n * (torch.arange(n) + 0.5) for low, high, n in sides]
    cell = torch.tensor([(high - low) / n for low, high, n in sides]).prod()
    return torch.cartesian_prod(*ticks), cell


def assert_samples_follow_density(law, grid, cell, z=5.0, n=20_000):
    """Samples of `law` (no batch) and its density over `grid` agree on moments, cosines and sines."""

    def features(x):
        x = x.reshape(len(x), -1)
        return torch.cat([x, (x[:, :, None] * x[:, None, :]).flatten(1), x.cos(), (2 * x).sin()], -1)

    exact = (law.log_prob(grid).exp()[:, None] * features(grid)).sum(0) * cell
    sample = features(law.sample(torch.Size([n])))
    assert ((sample.mean(0) - exact).abs() <= z * sample.std(0) / n**0.5 + 1e-3).all(), f"{sample.mean(0)}, {exact}"


def assert_log_prob_shape(law):
    """One number per value, for any sample dimensions."""
    assert law.log_prob(law.sample()).shape == law.batch_shape
    assert law.log_prob(law.sample(torch.Size([3, 7]))).shape == (3, 7, *law.batch_shape)


def assert_expands(law):
    """A law repeated over more dimensions is the same law, and still checks its values if it did."""
    wide = law.expand(torch.Size([5, *law.batch_shape]))
    value = wide.sample(torch.Size([3]))
    assert type(wide) is type(law)
    assert wide.has_rsample == law.has_rsample
    assert wide._validate_args == law._validate_args
    assert value.shape == (3, 5, *law.batch_shape, *law.event_shape)
    torch.testing.assert_close(wide.log_prob(value), law.log_prob(value))
    torch.testing.assert_close(wide.mean, law.mean.expand(wide.mean.shape))


def assert_density_gradients(make, parameters, value):
    """Gradients of the log density of `make(*parameters)` by these and `value` are finite differences."""
    leaves = [x.detach().clone().requires_grad_() for x in (*parameters, value)]
    assert torch.autograd.gradcheck(lambda *leaves: make(*leaves[:-1]).log_prob(leaves[-1]), leaves)


def assert_sample_gradients(make, parameters):
    """Gradients of samples from a fixed seed are finite differences."""

    def draw(*leaves):
        torch.manual_seed(3)
        return make(*leaves).rsample(torch.Size([4]))

    assert torch.autograd.gradcheck(draw, [x.detach().clone().requires_grad_() for x in parameters])


def assert_single_precision(make, parameters, value, tol=2e-5):
    """In float32 log density and gradients are finite, and close to float64 for the same numbers."""
    results = []
    for dtype in (torch.float32, torch.float64):
        leaves = [x.float().to(dtype).requires_grad_() for x in (*parameters, value)]
        log_prob = make(*leaves[:-1]).log_prob(leaves[-1])
        assert log_prob.dtype == dtype
        results.append([log_prob, *torch.autograd.grad(log_prob.sum(), leaves)])
    for single, double in zip(*results, strict=True):
        assert single.isfinite().all()
        torch.testing.assert_close(single.double(), double, rtol=tol, atol=tol)


def assert_survives_saving(module, quantity):
    """What a module gives is restored by its saved state, in a module whose parameters were others."""
    other, file = copy.deepcopy(module), io.BytesIO()
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.add_(0.01)
    before = quantity(module)
    assert not torch.equal(quantity(other), before)
    torch.save(module.state_dict(), file)
    file.seek(0)
    other.load_state_dict(torch.load(file))
    torch.testing.assert_close(quantity(other), before, rtol=0, atol=0)


class Watched(torch.nn.Module):
    """A quantity of a model as the forward of a module, so that its parameters can be replaced."""

    def __init__(self, model, quantity):
        super().__init__()
        self.model, self.quantity = model, quantity

    def forward(self, *inputs):
        return self.quantity(self.model, *inputs)


def assert_gradients(model, quantity, *inputs):
    """Gradients of `quantity(model, *inputs)` by parameters and inputs are its finite differences."""
    watched = Watched(model, quantity)
    names, parameters = zip(*watched.named_parameters(), strict=True)
    leaves = [x.detach().clone().requires_grad_() for x in (*parameters, *inputs)]

    def value(*leaves):
        replaced = dict(zip(names, leaves[: len(names)], strict=True))
        return functional_call(watched, replaced, leaves[len(names) :])

    assert torch.autograd.gradcheck(value, leaves)


def assert_step_leaves_its_inputs_alone(step, state, noise):
    """A step works on nothing in place, and is the same twice."""
    kept = state.clone(), noise.clone()
    torch.testing.assert_close(step(state, noise), step(*kept), rtol=0, atol=0)
    assert torch.equal(state, kept[0])
    assert torch.equal(noise, kept[1])


def assert_each_talker_has_its_own_dt(model, state, noise, dt):
    """Steps of `dt` (J,) of talkers (..., J, D) are those that each would take alone."""
    moved = model.transition(dt)(state, noise)
    assert model(state, dt).batch_shape == state.shape[:-1]
    for i in range(len(dt)):
        torch.testing.assert_close(moved[..., i, :], model.transition(float(dt[i]))(state[..., i, :], noise[..., i, :]))
