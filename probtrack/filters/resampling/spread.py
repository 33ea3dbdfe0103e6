"""How wide a weighted cloud is in each dimension of the state, and how far its particles are apart."""

import torch
from torch import Tensor

_NARROWEST = 1e-2  # of the spread of the particles, what the spread of the weighted cloud is taken for at least


def centre_and_spread(clouds: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weighted means and standard deviations (B, 1, D) of clouds (B, N, D) with `weight` (B, N).

    A cloud whose weight is all in one particle has a spread all the same, a hundredth of that of its particles; a
    dimension in which all particles agree has none.
    """
    centre = weight[:, None] @ clouds
    squares = (clouds - centre).square()
    variance = torch.maximum(weight[:, None] @ squares, _NARROWEST**2 * squares.mean(1, keepdim=True))
    some = variance > 0
    return centre, torch.where(some, torch.where(some, variance, 1.0).sqrt(), 0.0)


def half_squared_distances(points: Tensor, others: Tensor) -> Tensor:
    """Return half the squared distances (B, I, J) of points (B, I, D) and others (B, J, D), which lie about 0."""
    half, other = 0.5 * points.square().sum(-1), 0.5 * others.square().sum(-1)
    return torch.baddbmm(half[:, :, None] + other[:, None], points, others.mT, alpha=-1).clamp_min_(0)
