"""Straight lines between given values."""

import torch
from torch import Tensor


def interpolate(at: Tensor, points: Tensor, values: Tensor) -> Tensor:
    """Return `values` (K, ...), known at the increasing `points` (K,), at each of `at` (T,), shape (T, ...).

    Beyond the first and the last point their values stay.

    >>> interpolate(torch.tensor([0.5, 9.0]), torch.tensor([0.0, 1.0]), torch.tensor([2.0, 4.0])).tolist()
    [3.0, 4.0]
    """
    right = torch.searchsorted(points, at).clamp(1, len(points) - 1)
    left = right - 1
    share = ((at - points[left]) / (points[right] - points[left])).clamp(0, 1)
    return torch.lerp(values[left], values[right], share.reshape(-1, *[1] * (values.ndim - 1)))
