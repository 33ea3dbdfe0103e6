"""Given ways of one talker: through points, along an arc, or none."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from probtrack.errors import InputError
from probtrack.simulation.interpolation import interpolate
from probtrack.simulation.motion import Motion

Point = tuple[float, float, float]
"""x, y and z [m]."""

_FINE = 1000  # points to a piece of the curve, over which its length is summed


class Way(ABC):
    """The given way of one talker.

    A subclass is a frozen dataclass of plain values and other ways, so that a scene file can say it.
    """

    @abstractmethod
    def at(self, time: Tensor, duration: float) -> Motion:
        """Return the motion (T, ...) at `time` (T,), increasing in [0, `duration`] [s].

        In float64, without batch; the way takes all of `duration`, and its angles need not be wrapped.
        """


@dataclass(frozen=True)
class Through(Way):
    """A smooth way through points, at one speed between soft ends; two points make a straight line.

    The curve is a Catmull-Rom spline: it goes through every point with a continuous direction. The mouth points
    along the direction of motion.

    Args:
        points: x, y and z of each, two at least [m].
        ramp: Time in which the talker starts, and stops; the speed is half a cosine [s].
    """

    points: tuple[Point, ...]
    ramp: float = 0.8

    def __post_init__(self) -> None:
        knots = checked_points(self.points, "points", least=2)
        if (knots[1:, :2] == knots[:-1, :2]).all(-1).any():
            raise InputError("points: two that follow each other must differ in x or y")
        _check_ramp(self.ramp)

    def at(self, time: Tensor, duration: float) -> Motion:
        knots = checked_points(self.points, "points", least=2)
        u = torch.linspace(0, len(knots) - 1, _FINE * (len(knots) - 1) + 1, dtype=torch.float64)
        pieces = torch.linalg.vector_norm(_spline(knots, u)[0].diff(dim=0), dim=-1)
        length = torch.cat([pieces.new_zeros(1), pieces.cumsum(0)])
        share, rate = progress(time, duration, self.ramp)
        position, tangent = _spline(knots, interpolate(share * length[-1], length, u))
        tangent = tangent / torch.linalg.vector_norm(tangent, dim=-1, keepdim=True)
        heading = torch.atan2(tangent[:, 1], tangent[:, 0])
        return Motion(position, tangent * (rate * length[-1])[:, None], heading, heading)


@dataclass(frozen=True)
class Arc(Way):
    """Part of a horizontal circle, at one speed between soft ends; the mouth points along the direction of motion.

    Args:
        centre: x, y and z of the middle of the circle [m].
        radius: [m].
        start: Where on the circle the way begins, counter-clockwise from +x [rad].
        end: Where it ends [rad]; below `start` the talker walks clockwise.
        ramp: Time in which the talker starts, and stops; the speed is half a cosine [s].
    """

    centre: Point
    radius: float
    start: float
    end: float
    ramp: float = 0.8

    def __post_init__(self) -> None:
        checked_points([self.centre], "centre")
        if not (math.isfinite(self.radius) and self.radius > 0):
            raise InputError(f"radius must be finite and positive, got {self.radius}")
        if not (math.isfinite(self.start) and math.isfinite(self.end) and self.start != self.end):
            raise InputError(f"start and end must be finite and differ, got {self.start} and {self.end}")
        _check_ramp(self.ramp)

    def at(self, time: Tensor, duration: float) -> Motion:
        share, rate = progress(time, duration, self.ramp)
        angle = self.start + (self.end - self.start) * share
        speed = (self.end - self.start) * rate * self.radius
        out = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)
        along = torch.stack([-angle.sin(), angle.cos(), torch.zeros_like(angle)], -1)
        heading = angle + math.copysign(math.pi / 2, self.end - self.start)
        centre = torch.tensor(self.centre, dtype=torch.float64)
        return Motion(centre + self.radius * out, speed[:, None] * along, heading, heading)


@dataclass(frozen=True)
class Standing(Way):
    """A talker who stays in one place.

    Args:
        point: x, y and z [m].
        angle: Where body and mouth point, counter-clockwise from +x [rad].
    """

    point: Point
    angle: float = 0.0

    def __post_init__(self) -> None:
        checked_points([self.point], "point")
        if not math.isfinite(self.angle):
            raise InputError(f"angle must be finite, got {self.angle}")

    def at(self, time: Tensor, duration: float) -> Motion:  # noqa: ARG002
        position = torch.tensor(self.point, dtype=torch.float64).expand(len(time), 3)
        angle = torch.full_like(time, self.angle)
        return Motion(position, torch.zeros_like(position), angle, angle)


def checked_points(points: object, name: str, *, least: int = 1) -> Tensor:
    """Return `points` (K, 3) in float64, or raise `InputError` unless they are finite and at least `least`."""
    try:
        knots = torch.as_tensor(points, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        knots = torch.empty(0)
    if knots.ndim != 2 or len(knots) < least or knots.shape[1] != 3 or not knots.isfinite().all():
        raise InputError(f"{name} must be x, y and z, finite [m], {least} of them or more, got {points}")
    return knots


def progress(time: Tensor, duration: float, ramp: float) -> tuple[Tensor, Tensor]:
    """Return the share of the way done at `time` (T,) [s] and its rate [1/s].

    The rate rises and falls within `ramp` [s] like half a cosine and is constant in between.

    Raises:
        InputError: for a duration that is not more than twice the ramp.
    """
    if not duration > 2 * ramp:
        raise InputError(f"duration of a way must be more than {2 * ramp:g} s, twice its ramp, got {duration:g} s")
    cruise = 1 / (duration - ramp)
    if ramp == 0:
        return time * cruise, torch.full_like(time, cruise)
    early, late = time.clamp(max=ramp), (duration - time).clamp(max=ramp)
    rate = cruise * (1 - torch.cos(math.pi * torch.minimum(early, late) / ramp)) / 2

    def risen(t: Tensor) -> Tensor:
        return cruise * (t - ramp / math.pi * torch.sin(math.pi * t / ramp)) / 2

    share = risen(early) + cruise * (time - ramp).clamp(0, duration - 2 * ramp) + cruise * ramp / 2 - risen(late)
    return share, rate


def _check_ramp(ramp: float) -> None:
    if not (math.isfinite(ramp) and ramp >= 0):
        raise InputError(f"ramp must be finite and not negative, got {ramp}")


def _spline(knots: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Return points (T, 3) of the Catmull-Rom spline at `u` (T,) in [0, K - 1], and derivatives by u."""
    ends = 2 * knots[:1] - knots[1:2], 2 * knots[-1:] - knots[-2:-1]
    p = torch.cat([ends[0], knots, ends[1]])
    i = u.floor().long().clamp(0, len(knots) - 2)
    w = (u - i)[:, None]
    a, b = p[i + 1], (p[i + 2] - p[i]) / 2
    c = p[i] - 2.5 * p[i + 1] + 2 * p[i + 2] - p[i + 3] / 2
    d = (p[i + 3] - p[i]) / 2 + 1.5 * (p[i + 1] - p[i + 2])
    return a + w * (b + w * (c + w * d)), b + w * (2 * c + 3 * w * d)
