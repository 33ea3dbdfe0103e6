"""What makes walkers walk as they do: their habits, what is around them, and chance."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

NUM_UNIFORMS = 8
"""How many numbers, uniform in [0, 1), a talker uses in a step."""

_BORDER = 3.0  # m/s^2, push of a wall or microphone on one who is as near as may be
_ASIDE = 0.5  # rad, by which pushes are turned to the right


class Surroundings(NamedTuple):
    """Where talkers walk: from `low` (2,) to `high` (2,), not within `keep_out` of `microphones` (M, 2) [m].

    They look at `address` (2,) at times.
    """

    low: Tensor
    high: Tensor
    microphones: Tensor
    keep_out: float
    address: Tensor


class Habits(NamedTuple):
    """How talkers walk: the desired speed (runs, K) of each, and what `SocialForceWalk` says of all."""

    speed: Tensor
    max_speed: float
    relaxation: float
    arrival: float
    apart: float
    wall_range: float
    talker_potential: float
    talker_range: float
    turn_rate: float
    stop_probability: float
    stop_duration: float
    glance_probability: float
    glance_duration: float
    head_limit: float


class Chances(NamedTuple):
    """What happens to talkers (runs, K) in a step if it is time for it.

    Attributes:
        goal: (..., 2, 2), two places to go to next [m].
        stops: bool, whether to stand for a while at the goal.
        standing: How long [s].
        look: What to look at next: 0 ahead, 1 the addressed point, 1 + j the j-th talker after this one.
        looking: How long [s].
    """

    goal: Tensor
    stops: Tensor
    standing: Tensor
    look: Tensor
    looking: Tensor

    @staticmethod
    def of(unit: Tensor, habits: Habits, surroundings: Surroundings) -> "list[Chances]":
        """Return the chances of each step that numbers (steps, runs, K, NUM_UNIFORMS) stand for."""
        s = surroundings
        goal = s.low + (s.high - s.low) * unit[..., :4].unflatten(-1, (2, 2))
        away = unit[..., 6] / max(habits.glance_probability, 1e-12)  # of those that look away uniform in [0, 1)
        which = 1 + (away * unit.shape[-2]).floor().long().clamp(max=unit.shape[-2] - 1)
        columns = (
            goal,
            unit[..., 4] < habits.stop_probability,
            -habits.stop_duration * torch.log1p(-unit[..., 5]),
            torch.where(away < 1, which, 0),
            -habits.glance_duration * torch.log1p(-unit[..., 7]),
        )
        return [Chances(*row) for row in zip(*(column.unbind(0) for column in columns), strict=True)]


class Pushes(NamedTuple):
    """How the C obstacles around each talker push, (C,) each; see `obstacles.push`."""

    strength: Tensor
    reach: Tensor
    aside: Tensor

    @staticmethod
    def of(num_talkers: int, habits: Habits, surroundings: Surroundings) -> "Pushes":
        """Return those of four walls, then microphones, then other talkers."""
        a, b = habits.talker_potential, habits.talker_range
        kinds = [(_BORDER, habits.wall_range, 0.0)] * 4
        kinds += [(_BORDER, habits.wall_range, _ASIDE)] * len(surroundings.microphones)
        # between two talkers the gap is half the distance beyond `apart`
        kinds += [(a / b * math.exp(-habits.apart / b), b / 2, _ASIDE)] * (num_talkers - 1)
        return Pushes(*surroundings.low.new_tensor(kinds).unbind(-1))
