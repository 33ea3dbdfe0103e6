"""Systematic resampling: one uniform number shifts a regular comb over the cumulative weights."""

from torch import Tensor

from probtrack.filters.resampling.base import Ancestral, counts, cumulative


def systematic_offspring(weight: Tensor, uniforms: Tensor) -> Tensor:
    r"""Return how often each particle is drawn, :math:`\lceil N C_i - u \rceil - \lceil N C_{i-1} - u \rceil`.

    That is the number of points (j + u) / N of a regular comb below the cumulative weight C_i: linear in N, and
    never more than one away from N w_i. (Searching the comb in C costs log N times as much.)

    Args:
        weight: Weights (*batch, N), sum 1.
        uniforms: u (*batch, 1) in [0, 1).

    References:
        J. Carpenter, P. Clifford, P. Fearnhead, "Improved particle filter for nonlinear problems", IEE Proc.
        Radar, Sonar and Navigation 146(1), 1999; S1 Algorithm 1, step 3, leaves the scheme open.

    >>> import torch
    >>> systematic_offspring(torch.tensor([0.1, 0.6, 0.3]), torch.tensor([0.5])).tolist()
    [0, 2, 1]
    """
    num_particles = weight.shape[-1]
    reached = cumulative(weight)
    below = (num_particles * reached).sub_(uniforms).ceil_().masked_fill_(reached >= 1, num_particles)
    return counts(below)


systematic = Ancestral(systematic_offspring, each=False)
