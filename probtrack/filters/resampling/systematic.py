"""Systematic resampling: one uniform number shifts a regular comb over the cumulative weights."""

import torch
from torch import Tensor

from probtrack.filters.resampling.base import Ancestral, cumulative


def systematic_ends(weight: Tensor, uniforms: Tensor) -> Tensor:
    r"""Return how many points (j + u) / N of a regular comb lie below each cumulative weight C_i.

    .. math:: \lceil N C_i - u \rceil

    Linear in N, and each particle is drawn at most one time more or less than N w_i.

    Args:
        weight: Weights (*batch, N), sum 1.
        uniforms: u (*batch, 1) in [0, 1).

    References:
        J. Carpenter, P. Clifford, P. Fearnhead, "Improved particle filter for nonlinear problems", IEE Proc.
        Radar, Sonar and Navigation 146(1), 1999; S1 Algorithm 1, step 3, leaves the scheme open.

    >>> import torch
    >>> systematic_ends(torch.tensor([0.1, 0.6, 0.3]), torch.tensor([0.5])).int().tolist()
    [0, 2, 3]
    """
    num_particles = weight.shape[-1]
    # so that N - u is above N - 1 when rounded: otherwise the last draw would have no particle
    shift = uniforms.clamp_max(max(0.0, 1 - num_particles * torch.finfo(weight.dtype).eps))
    return (num_particles * cumulative(weight)).sub_(shift).ceil_()


systematic = Ancestral(systematic_ends, each=False)
