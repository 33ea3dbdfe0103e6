"""What the tests of switching share: heard positions, and resampling that keeps the gradient of the evidence."""

from typing import NamedTuple

import torch

from probtrack.filters import resampling
from probtrack.likelihoods import GaussianPosition


class Heard(NamedTuple):
    """Positions (T, *batch, 2), and the speech (T, *batch) that a chain listens to."""

    position: torch.Tensor
    speech: torch.Tensor


class Measured(GaussianPosition):
    """Likelihood of what is `Heard`."""

    def prepare(self, observations):
        return super().prepare(observations.position)


class StopGradient(resampling.Resampler):
    """Resampling whose copies weigh w / (w as a constant) / N: the evidence then has an unbiased gradient.

    A. Scibior, F. Wood, "Differentiable particle filtering without modifying the forward pass", 2021.
    """

    def num_uniforms(self, num_particles):
        return resampling.systematic.num_uniforms(num_particles)

    def __call__(self, state, log_weight, uniforms):
        marked = torch.cat([state, (log_weight - log_weight.detach())[..., None]], -1)
        drawn, equal = resampling.systematic(marked, log_weight, uniforms)
        return drawn[..., :-1], equal + drawn[..., -1]
