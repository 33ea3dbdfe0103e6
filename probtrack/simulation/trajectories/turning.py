"""Given ways, turned: which way a talker faces on a way, and ways one after another."""

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from probtrack.errors import InputError
from probtrack.simulation.motion import Motion
from probtrack.simulation.trajectories.ways import Way, progress

_JUMP = 1e-3  # m between the end of one way and the start of the next at most


@dataclass(frozen=True)
class Turning(Way):
    """A talker whose body and mouth turn at a constant rate, whatever the way; with rate 0 they keep one angle.

    Args:
        way: Where the talker is.
        start: Where body and mouth point first, counter-clockwise from +x [rad].
        rate: Turn rate, positive counter-clockwise [rad/s].
    """

    way: Way
    start: float
    rate: float = 0.0

    def __post_init__(self) -> None:
        _check_finite("start", self.start)
        _check_finite("rate", self.rate)

    def at(self, time: Tensor, duration: float) -> Motion:
        angle = self.start + self.rate * time
        return self.way.at(time, duration)._replace(body=angle, mouth=angle)


@dataclass(frozen=True)
class TurningTo(Way):
    """A talker whose body and mouth turn from one angle to another, evenly between soft ends, whatever the way.

    Args:
        way: Where the talker is.
        start: Where body and mouth point first, counter-clockwise from +x [rad].
        end: Where they point last [rad]; not wrapped, so that it says which way round and how often.
        ramp: Time in which the turn starts, and stops [s].
    """

    way: Way
    start: float
    end: float
    ramp: float = 0.3

    def __post_init__(self) -> None:
        _check_finite("start", self.start)
        _check_finite("end", self.end)
        _check_finite("ramp", self.ramp)
        if self.ramp < 0:
            raise InputError(f"ramp must not be negative, got {self.ramp}")

    def at(self, time: Tensor, duration: float) -> Motion:
        angle = self.start + (self.end - self.start) * progress(time, duration, self.ramp)[0]
        return self.way.at(time, duration)._replace(body=angle, mouth=angle)


@dataclass(frozen=True)
class FacingPoint(Way):
    """A talker whose mouth points towards a place all the time; the body stays as the way has it.

    Args:
        way: Where the talker is, never at the place itself.
        point: x and y of the place [m].
    """

    way: Way
    point: tuple[float, float]

    def __post_init__(self) -> None:
        if len(self.point) != 2:
            raise InputError(f"point must be x and y [m], got {self.point}")
        for name, value in zip(("x of point", "y of point"), self.point, strict=True):
            _check_finite(name, value)

    def at(self, time: Tensor, duration: float) -> Motion:
        motion = self.way.at(time, duration)
        offset = torch.tensor(self.point, dtype=torch.float64) - motion.position[:, :2]
        if not (offset != 0).any(-1).all():
            raise InputError(f"point must be beside the way, got {self.point}, which the talker passes")
        return motion._replace(mouth=torch.atan2(offset[:, 1], offset[:, 0]))


@dataclass(frozen=True)
class InTurn(Way):
    """Ways one after another; each begins where the one before ends.

    Args:
        ways: At least one.
        shares: Share of the duration that each takes; together 1.
    """

    ways: tuple[Way, ...]
    shares: tuple[float, ...]

    def __post_init__(self) -> None:
        if not len(self.ways) == len(self.shares) >= 1:
            raise InputError(f"shares must be as many as ways, {len(self.ways)}, and at least one, got {self.shares}")
        if not (all(share > 0 for share in self.shares) and math.isclose(sum(self.shares), 1.0, rel_tol=1e-6)):
            raise InputError(f"shares must be positive and 1 together, got {self.shares}")
        ends = torch.tensor([0.0, 60.0], dtype=torch.float64)  # a minute is more than any ramp
        places = [way.at(ends, 60.0).position for way in self.ways]
        for number, (before, after) in enumerate(itertools.pairwise(places), 1):
            if torch.linalg.vector_norm(after[0] - before[1]) > _JUMP:
                raise InputError(
                    f"ways: number {number + 1} must begin where number {number} ends, at "
                    f"{[round(x, 3) for x in before[1].tolist()]}, got {[round(x, 3) for x in after[0].tolist()]}"
                )

    def at(self, time: Tensor, duration: float) -> Motion:
        begin, parts = 0.0, []
        for number, (way, share) in enumerate(zip(self.ways, self.shares, strict=True)):
            end = math.inf if number == len(self.ways) - 1 else begin + share * duration
            inside = (time >= begin) & (time < end)
            parts.append(way.at((time[inside] - begin).clamp(max=share * duration), share * duration))
            begin = end
        return Motion(*(torch.cat(column) for column in zip(*parts, strict=True)))


@dataclass(frozen=True)
class Waiting(Way):
    """A talker who stands at the beginning of a way, and at its end.

    Args:
        way: Between the two.
        before: Share of the duration before the way begins, in [0, 1).
        after: Share of the duration after the way ends, in [0, 1); both together below 1.
    """

    way: Way
    before: float = 0.0
    after: float = 0.0

    def __post_init__(self) -> None:
        if not (self.before >= 0 and self.after >= 0 and self.before + self.after < 1):
            raise InputError(f"before and after must be at least 0, together below 1, got {self.before}, {self.after}")

    def at(self, time: Tensor, duration: float) -> Motion:
        walking = (1 - self.before - self.after) * duration
        begun = time - self.before * duration
        motion = self.way.at(begun.clamp(0, walking), walking)
        moves = (begun >= 0) & (begun <= walking)  # a way without ramps has a speed at its ends
        return motion._replace(velocity=torch.where(moves[:, None], motion.velocity, 0.0))


def _check_finite(name: str, value: float) -> None:
    if not math.isfinite(value):
        raise InputError(f"{name} must be finite, got {value}")
