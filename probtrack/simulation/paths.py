"""Where a talker walks: smooth paths through given points."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from probtrack.errors import InputError
from probtrack.simulation.interpolation import interpolate

_FINE = 1000  # points to a piece of the curve, over which its length is summed


class Walk(NamedTuple):
    """Motion of one talker, sampled regularly.

    Attributes:
        positions: (T, A) [m].
        velocities: (T, A) [m/s].
        heading: (T,) [rad], direction of motion in the xy plane; known also where the talker stands still.
    """

    positions: Tensor
    velocities: Tensor
    heading: Tensor


def smooth_path(points: Tensor | Sequence[Sequence[float]], duration: float, fs: float, *, ramp: float = 0.8) -> Walk:
    """Return the walk through `points` (K, A) [m] that takes `duration` [s], sampled at `fs` [Hz].

    The curve is a Catmull-Rom spline: it goes through every point with a continuous direction. The talker
    starts and stops within `ramp` [s] each, its speed rising and falling like half a cosine, and keeps one
    speed in between.
    """
    knots = torch.as_tensor(points, dtype=torch.float64)
    if knots.ndim != 2 or len(knots) < 2 or knots.shape[1] not in (2, 3) or not knots.isfinite().all():
        raise InputError(f"path: points must be (K, 2) or (K, 3) finite numbers, K >= 2, got {points}")
    if (knots[1:] == knots[:-1]).all(-1).any():
        raise InputError("path: two points that follow each other must differ")
    if not (math.isfinite(duration) and duration > 2 * ramp):
        raise InputError(f"path: duration must be more than {2 * ramp:g} s, twice the ramp, got {duration}")
    u = torch.linspace(0, len(knots) - 1, _FINE * (len(knots) - 1) + 1, dtype=torch.float64)
    pieces = torch.linalg.vector_norm(_spline(knots, u)[0].diff(dim=0), dim=-1)
    length = torch.cat([torch.zeros(1, dtype=torch.float64), pieces.cumsum(0)])
    share, rate = _progress(torch.arange(round(duration * fs), dtype=torch.float64) / fs, duration, ramp)
    position, tangent = _spline(knots, interpolate(share * length[-1], length, u))
    tangent = tangent / torch.linalg.vector_norm(tangent, dim=-1, keepdim=True)
    heading = torch.atan2(tangent[:, 1], tangent[:, 0])
    columns = position, tangent * (rate * length[-1])[:, None], heading
    return Walk(*(column.to(torch.get_default_dtype()) for column in columns))


def _progress(t: Tensor, duration: float, ramp: float) -> tuple[Tensor, Tensor]:
    """Return the share of the way done at `t` [s] and its rate [1/s]."""
    cruise = 1 / (duration - ramp)
    early, late = t.clamp(max=ramp), (duration - t).clamp(max=ramp)
    rate = cruise * (1 - torch.cos(math.pi * torch.minimum(early, late) / ramp)) / 2

    def risen(t: Tensor) -> Tensor:
        return cruise * (t - ramp / math.pi * torch.sin(math.pi * t / ramp)) / 2

    share = risen(early) + cruise * (t - ramp).clamp(0, duration - 2 * ramp) + cruise * ramp / 2 - risen(late)
    return share, rate


def _spline(knots: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Return points (T, A) of the Catmull-Rom spline at `u` (T,) in [0, K - 1], and derivatives by u."""
    ends = 2 * knots[:1] - knots[1:2], 2 * knots[-1:] - knots[-2:-1]
    p = torch.cat([ends[0], knots, ends[1]])
    i = u.floor().long().clamp(0, len(knots) - 2)
    w = (u - i)[:, None]
    a, b = p[i + 1], (p[i + 2] - p[i]) / 2
    c = p[i] - 2.5 * p[i + 1] + 2 * p[i + 2] - p[i + 3] / 2
    d = (p[i + 3] - p[i]) / 2 + 1.5 * (p[i + 1] - p[i + 2])
    return a + w * (b + w * (c + w * d)), b + w * (2 * c + 3 * w * d)
