"""Stratified resampling: one uniform number in each of N equal strata."""

from torch import Tensor

from probtrack.filters.resampling.base import Ancestral, cumulative


def stratified_ends(weight: Tensor, uniforms: Tensor) -> Tensor:
    r"""Return how many points :math:`(j + u_j) / N`, j = 0, ..., N - 1, lie below each cumulative weight.

    Below a cumulative weight C lie all points of the strata that end before it, and the point of its own
    stratum if that point comes first.

    Args:
        weight: Weights (*batch, N), sum 1.
        uniforms: u_j (*batch, N) in [0, 1).

    References:
        G. Kitagawa, "Monte Carlo filter and smoother for non-Gaussian nonlinear state space models", JCGS
        5(1), 1996.
    """
    num_particles = weight.shape[-1]
    scaled = num_particles * cumulative(weight)
    stratum = scaled.floor().clamp_max(num_particles - 1)
    first = uniforms.gather(-1, stratum.long()) < scaled - stratum
    return stratum + first


stratified = Ancestral(stratified_ends, each=True)
