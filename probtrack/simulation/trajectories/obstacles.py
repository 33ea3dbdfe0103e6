"""What a walker must not run into, as half-planes: how far it is, how it pushes, which velocities it allows."""

from typing import NamedTuple

import torch
from torch import Tensor

_DECELERATION = 4.0  # m/s^2; a walker who sees an obstacle can stop as fast as this
_PROJECTIONS = 3  # a corner needs two


class Obstacles(NamedTuple):
    """The C obstacles around each walker.

    Attributes:
        normal: (..., C, 2), unit vector from the walker straight to the obstacle.
        gap: (..., C), how far the walker can go that way [m].
    """

    normal: Tensor
    gap: Tensor


def walls(place: Tensor, low: Tensor, high: Tensor) -> Obstacles:
    """Return the four sides of the area from `low` (2,) to `high` (2,) around walkers at `place` (..., 2)."""
    normal = place.new_tensor([[-1.0, 0.0], [0.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
    gap = torch.cat([place - low, high - place], -1)
    return Obstacles(normal.expand(*place.shape[:-1], 4, 2), gap.clamp(min=0))


def circles(place: Tensor, centre: Tensor, radius: float) -> Obstacles:
    """Return circles around `centre` (C, 2), each as the half-plane behind its tangent that faces the walker."""
    offset = centre - place[..., None, :]
    distance = torch.linalg.vector_norm(offset, dim=-1)
    return Obstacles(offset / distance[..., None].clamp(min=1e-9), (distance - radius).clamp(min=0))


def others(place: Tensor, apart: float) -> Obstacles:
    """Return the other walkers, C = K - 1, around each of K at `place` (..., K, 2).

    Each of two walkers may use half of what is between them beyond `apart` [m], so that they stay apart
    whatever both do.
    """
    k = place.shape[-2]
    other = (torch.arange(k)[:, None] + torch.arange(1, k)) % k  # (K, K - 1)
    offset = place[..., other, :] - place[..., :, None, :]
    distance = torch.linalg.vector_norm(offset, dim=-1)
    return Obstacles(offset / distance[..., None].clamp(min=1e-9), ((distance - apart) / 2).clamp(min=0))


def joined(*parts: Obstacles) -> Obstacles:
    """Return the obstacles of all `parts`."""
    return Obstacles(torch.cat([p.normal for p in parts], -2), torch.cat([p.gap for p in parts], -1))


def push(obstacles: Obstacles, strength: Tensor, reach: Tensor, aside: Tensor) -> Tensor:
    """Return the acceleration (..., 2) away from obstacles, the gradient of an exponential potential.

    Args:
        obstacles: C of them.
        strength: (C,), at no gap [m/s^2].
        reach: (C,), the gap over which it falls to 1/e [m].
        aside: (C,), the angle by which it is turned to the walker's right [rad], so that two who meet head-on pass.
    """
    size = strength * torch.exp(-obstacles.gap / reach)
    back, right = size * torch.cos(aside), size * torch.sin(aside)
    x, y = obstacles.normal.unbind(-1)
    return torch.stack([right * y - back * x, -right * x - back * y], -1).sum(-2)


def admissible(velocity: Tensor, obstacles: Obstacles, step: float) -> Tensor:
    """Return what `velocity` (..., 2) becomes so that a `step` [s] at it ends before every obstacle.

    The speed towards an obstacle is at most what the walker could brake from on the gap that is left, and at
    most the gap a step. What runs along it stays.
    """
    normal, gap = obstacles
    limit = torch.minimum((2 * _DECELERATION * gap).sqrt(), gap / step)
    for _ in range(_PROJECTIONS):
        excess, worst = ((velocity[..., None, :] * normal).sum(-1) - limit).max(-1)
        if not (excess > 0).any():
            return velocity
        worst = worst[..., None, None].expand(*worst.shape, 1, 2)
        velocity = velocity - excess.clamp(min=0)[..., None] * normal.gather(-2, worst)[..., 0, :]
    # three projections leave little, but this is the guarantee: standing still is always allowed
    towards = (velocity[..., None, :] * normal).sum(-1)
    share = torch.where(towards > limit, limit / towards.clamp(min=1e-12), 1.0).amin(-1)
    return velocity * share[..., None]
