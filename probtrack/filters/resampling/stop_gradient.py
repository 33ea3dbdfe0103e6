"""Resampling that leaves the gradient of the evidence unbiased."""

from dataclasses import dataclass

import torch
from torch import Tensor

from probtrack.filters.resampling.base import Resampler


@dataclass(frozen=True)
class StopGradient(Resampler):
    r"""A scheme whose copies keep the gradient of the weight they were drawn by:

    .. math:: w' = \frac{1}{N} \frac{w}{\bar w}, \qquad \bar w = w \text{ as a constant} .

    In value that is 1/N: clouds, tracks and evidence are those of the scheme, number by number. The gradient of the
    evidence has the exact gradient as its mean, while copies of equal weight forget what earlier weights owed to
    the parameters: all of it for the probabilities of a switching model, which act through weights alone.

    Args:
        resampler: The scheme, one that copies particles, such as `systematic`.

    References:
        A. Scibior, F. Wood, "Differentiable particle filtering without modifying the forward pass", arXiv 2106.10314,
        2021, section 4.
    """

    resampler: Resampler

    def num_uniforms(self, num_particles: int) -> int:
        return self.resampler.num_uniforms(num_particles)

    def __call__(self, state: Tensor, log_weight: Tensor, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        if not log_weight.requires_grad:
            return self.resampler(state, log_weight, uniforms)
        # drawn along with the particle: zero in value, and one more variable, first in memory like the others
        mark = log_weight - log_weight.detach()
        marked = torch.cat([state.movedim(-1, 0), mark[None]]).movedim(0, -1)
        drawn, equal = self.resampler(marked, log_weight, uniforms)
        return drawn[..., :-1], equal + drawn[..., -1]
