"""Residual resampling: the whole part of N w without chance, the rest by independent draws."""

import torch
from torch import Tensor

from probtrack.filters.resampling.base import Ancestral
from probtrack.filters.resampling.multinomial import drawn_particles

_HAIR = 1e-12  # relative: N w that is a whole number but for rounding, such as 49 / 49, is that number


def residual_ends(weight: Tensor, uniforms: Tensor) -> Tensor:
    r"""Return the ends of :math:`\lfloor N w_i \rfloor` copies of each particle and the rest drawn by what is left.

    Args:
        weight: Weights (*batch, N), sum 1.
        uniforms: (*batch, N) in [0, 1); as many of them are used as draws are left.

    References:
        J. S. Liu, R. Chen, "Sequential Monte Carlo methods for dynamic systems", JASA 93(443), 1998.
    """
    num_particles = weight.shape[-1]
    # in float64: rounded weights of float32 may sum to more than 1 + 1/N, and then more than N copies are whole
    weight = weight.double()
    scaled = num_particles * (weight / weight.sum(-1, keepdim=True))
    whole = (scaled * (1 + _HAIR)).floor()
    left = num_particles - whole.sum(-1, keepdim=True)
    fraction = (scaled - whole).clamp_min(0)
    # with nothing left to draw any probabilities do
    rest = torch.where(left > 0, fraction, weight)
    drawn = drawn_particles(rest, uniforms.double())
    used = (torch.arange(num_particles, device=weight.device) < left).long()
    return whole.long().scatter_add_(-1, drawn, used).cumsum(-1)


residual = Ancestral(residual_ends, each=True)
