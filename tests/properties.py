"""Laws that every density and every motion model must obey."""

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
