"""Multinomial resampling: N independent draws."""

import torch
from torch import Tensor

from probtrack.filters.resampling.base import Ancestral, cumulative


def multinomial_ends(weight: Tensor, uniforms: Tensor) -> Tensor:
    """Return how many of N independent draws with probabilities `weight` fall on each particle or before it.

    Args:
        weight: Weights (*batch, N), sum 1.
        uniforms: (*batch, N) in [0, 1).

    References:
        N. J. Gordon, D. J. Salmond, A. F. M. Smith, IEE Proc. F 140(2), 1993: the bootstrap filter.
    """
    drawn = drawn_particles(weight, uniforms)
    return torch.zeros_like(drawn).scatter_add_(-1, drawn, torch.ones_like(drawn)).cumsum(-1)


def drawn_particles(weight: Tensor, uniforms: Tensor) -> Tensor:
    """Return the particle that each of `uniforms` (*batch, J) draws, never one of weight 0."""
    return torch.searchsorted(cumulative(weight), uniforms.contiguous(), right=True)


multinomial = Ancestral(multinomial_ends, each=True)
