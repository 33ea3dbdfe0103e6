"""Resampling by optimal transport: every new particle is a blend of old ones, and a smooth function of the weights."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from probtrack._checks import as_positive, check_int
from probtrack.filters.resampling.base import Resampler
from probtrack.filters.resampling.sinkhorn import plan_gradients, potentials, transport_plan
from probtrack.filters.resampling.spread import centre_and_spread


@dataclass(frozen=True)
class OptimalTransport(Resampler):
    r"""Moves particles of equal weights to where the weighted ones are, at the least cost and some entropy:

    .. math:: x'_i = N \sum_j P_{ij} x_j, \qquad
        P = \arg\min_{P 1 = 1/N,\; P^\top 1 = w}
            \sum_{ij} P_{ij} C_{ij} + \varepsilon \sum_{ij} P_{ij} \log \frac{P_{ij}}{w_j / N}, \qquad
        C_{ij} = \frac{1}{2 D} \sum_d \frac{(x_{id} - x_{jd})^2}{s_d^2} .

    Each dimension of the state is measured in its own spread :math:`s_d`, that of the weighted cloud, so that two
    particles drawn by the weights cost 1 on average. No chance is involved, and the gradient passes states and weights
    alike. It is biased all the same: blends contract the cloud, the more the larger :math:`\varepsilon` is, and the
    estimate of the evidence is consistent, not unbiased. Blends make no sense of modes and of wrapped angles.

    The gradient is that of the minimum, by the linear system that its conditions imply, whatever the iterations were.
    The spreads count as constants. What passes through P is limited to `clip` times the gradient that arrived, cloud by
    cloud: where mass hangs on a thread between two clusters, the exact derivative is beyond all use.

    Args:
        epsilon: Weight of the entropy.
        tolerance: Share of the mass that may miss its weight; a hundredth is less than chance does to 100 particles.
        iterations: Most iterations at the final epsilon.
        clip: Largest gradient through P, in that of the new particles, both measured in spreads.

    References:
        A. Corenflos, J. Thornton, G. Deligiannidis, A. Doucet, "Differentiable particle filtering via
        entropy-regularized optimal transport", ICML 2021, algorithm 3. There all dimensions have one scale, and the
        gradient is clipped number by number.
    """

    epsilon: float = 0.5
    tolerance: float = 1e-2
    iterations: int = 100
    clip: float = 10.0

    def __post_init__(self) -> None:
        as_positive(self.epsilon, "epsilon")
        as_positive(self.tolerance, "tolerance")
        check_int(self.iterations, "iterations", low=1)
        if math.isnan(self.clip) or self.clip <= 0:
            as_positive(self.clip, "clip")

    def num_uniforms(self, num_particles: int, state_dim: int) -> int:  # noqa: ARG002
        return 0

    def __call__(self, state: Tensor, log_weight: Tensor, uniforms: Tensor) -> tuple[Tensor, Tensor]:  # noqa: ARG002
        equal = torch.full_like(log_weight, -math.log(log_weight.shape[-1]), requires_grad=False)
        size, dim = state.shape[-2:]
        clouds, weights = state.reshape(-1, size, dim), log_weight.reshape(-1, size)
        centre, spread = centre_and_spread(clouds.detach(), weights.detach().exp())
        # a dimension in which all particles agree costs nothing
        scale = torch.where(spread > 0, spread * dim**0.5, 1.0)
        moved: Tensor = _Transported.apply((clouds - centre) / scale, weights, self)
        moved = torch.addcmul(centre, moved, scale)
        # variables first in memory, like all clouds
        return moved.movedim(-1, 0).contiguous().view(dim, *log_weight.shape).movedim(0, -1), equal


class _Transported(torch.autograd.Function):
    """Blends N P x of scaled clouds (B, N, D), with the gradient of the minimum."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, log_weight: Tensor, scheme: OptimalTransport) -> Tensor:
        weight = log_weight.exp()
        f, g = potentials(points, weight, scheme.epsilon, scheme.tolerance, scheme.iterations)
        ctx.scheme = scheme
        ctx.save_for_backward(points, weight, f, g)
        return transport_plan(points, weight, f, g, scheme.epsilon) @ points * points.shape[1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        points, weight, f, g = ctx.saved_tensors
        # worked out again: kept, the plans of a sequence would take N times the memory of its clouds
        plan = transport_plan(points, weight, f, g, ctx.scheme.epsilon)
        of_points, of_weights = plan_gradients(plan, points, grad, ctx.scheme.epsilon)
        through = (of_points.square().sum((1, 2)) + of_weights.square().sum(1)).sqrt()
        arrived = grad.square().sum((1, 2)).sqrt()
        limit = torch.where(through > ctx.scheme.clip * arrived, ctx.scheme.clip * arrived / through, 1.0)
        direct = plan.mT @ grad * points.shape[1]
        return direct + limit[:, None, None] * of_points, limit[:, None] * of_weights, None
