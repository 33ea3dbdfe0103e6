"""Resampling from a smooth density: a normal kernel around every particle."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from probtrack._checks import as_positive
from probtrack.filters.resampling.base import Copying, Resampler
from probtrack.filters.resampling.spread import centre_and_spread, half_squared_distances
from probtrack.filters.resampling.systematic import systematic


@dataclass(frozen=True)
class KernelMixture(Resampler):
    r"""New particles are drawn from a mixture of normal kernels around the old ones:

    .. math:: x' \sim m(x) = \sum_j w_j \prod_d \mathcal N(x_d; x_{jd}, h^2 s_d^2), \qquad
        w' = \frac{1}{N} \frac{m(x')}{\bar m(x')}, \qquad \bar m = m \text{ as a constant} .

    Each dimension of the state has its own width, the share h of the spread :math:`s_d` of the weighted cloud. The new
    particles are constants and their weights, 1/N in value, carry the gradient of the density that they were drawn
    from: in states, weights and spreads. So it is unbiased for the cloud that the mixture stands for, whose variance is
    1 + h^2 times that of the particles; it varies the more the smaller h is. Kernels make no sense of modes and of
    wrapped angles. N^2 densities a frame are worked out, and not kept.

    Args:
        bandwidth: h.
        resampler: Draws whose kernel a particle comes from.

    References:
        A. Younis, E. B. Sudderth, "Differentiable and stable long-range tracking of multiple posterior modes", NeurIPS
        2023: the mixture density particle filter and importance weighted samples gradients. There the bandwidths are
        learned, one for all frames.
    """

    bandwidth: float = 0.2
    resampler: Copying = systematic

    def __post_init__(self) -> None:
        as_positive(self.bandwidth, "bandwidth")

    def num_uniforms(self, num_particles: int, state_dim: int) -> int:
        return self.resampler.num_uniforms(num_particles, state_dim) + num_particles * state_dim

    def __call__(self, state: Tensor, log_weight: Tensor, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        size, dim = state.shape[-2:]
        known = self.resampler.num_uniforms(size, dim)
        centres, _ = self.resampler(state.detach(), log_weight.detach(), uniforms[..., :known])
        numbers = uniforms[..., known:].clamp_min(torch.finfo(uniforms.dtype).eps / 2)  # no number is minus infinity
        normal = torch.special.ndtri(numbers).unflatten(-1, (dim, size)).mT  # variables first in memory, like clouds
        clouds, weights = state.reshape(-1, size, dim), log_weight.reshape(-1, size)
        centre, spread = centre_and_spread(clouds, weights.exp())
        width = self.bandwidth * spread
        drawn = centres + width.detach().view(*state.shape[:-2], 1, dim) * normal
        equal = torch.full_like(log_weight, -math.log(size), requires_grad=False)
        if not (state.requires_grad or log_weight.requires_grad):
            return drawn, equal
        # a dimension in which all particles agree says nothing
        unit = torch.where(width > 0, width, 1.0)
        scaled = [(x - centre.detach()) / unit for x in (drawn.reshape(-1, size, dim), clouds)]
        log_density: Tensor = _LogMixture.apply(*scaled, weights) - unit.log().sum(-1)
        return drawn, equal + (log_density - log_density.detach()).view(log_weight.shape)


class _LogMixture(torch.autograd.Function):
    """log sum_j w_j exp(-|x_i - c_j|^2 / 2) (B, N) of points and centres (B, N, D), whose N^2 terms are not kept."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, centres: Tensor, log_weight: Tensor) -> Tensor:
        total = torch.logsumexp(log_weight[:, None] - half_squared_distances(points, centres), -1)
        ctx.save_for_backward(points, centres, log_weight, total)
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        points, centres, log_weight, total = ctx.saved_tensors
        exponent = (log_weight[:, None] - half_squared_distances(points, centres)).sub_(total[..., None])
        share = exponent.exp_().mul_(grad[..., None])  # of each kernel in each point, times the gradient there
        to = share.sum(1)
        of_points = share @ centres - grad[..., None] * points
        return of_points, share.mT @ points - to[..., None] * centres, to
