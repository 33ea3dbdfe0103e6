"""One step of people who walk: intentions, turning, looking."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from probtrack.geometry import wrap_angle
from probtrack.simulation.trajectories.habits import Chances, Habits, Pushes, Surroundings
from probtrack.simulation.trajectories.obstacles import Obstacles, admissible, circles, joined, others, push, walls

STEP = 0.02
"""Time step of the walk [s]."""

_BRAKING = 0.4  # s, in which one who is too fast slows down: half a metre from 1.3 m/s, about the arrival radius
_TURN_EXPONENT = -0.8
_STANDING_TURN = 3.0  # rad/s at most
_TURN_GAIN = 3.0  # 1/s, turn rate asked for an error of one radian
_TURN_LAG = 0.15  # s, in which the body takes up that rate
_HEAD_LAG = 0.25  # s, of each of the two lags of the head
_PATIENCE = 5.0  # s beyond twice the time a goal takes, after which another is taken


class Walkers(NamedTuple):
    """Talkers at a time; batch (runs, K).

    Attributes:
        place: (..., 2) [m].
        velocity: (..., 2) [m/s].
        body: Where the body faces, not wrapped [rad].
        turning: Turn rate of the body [rad/s].
        leading: Where the head is about to turn, from the body [rad].
        head: Where the head is turned, from the body [rad].
        goal: (..., 2) [m].
        patience: Time left to reach it [s].
        standing: Time left to stand [s].
        look: What is looked at, as in `Chances`.
        looking: Time left to look there [s].
    """

    place: Tensor
    velocity: Tensor
    body: Tensor
    turning: Tensor
    leading: Tensor
    head: Tensor
    goal: Tensor
    patience: Tensor
    standing: Tensor
    look: Tensor
    looking: Tensor


def first(place: Tensor, chances: Chances, habits: Habits) -> Walkers:
    """Return talkers who stand at `place` (..., 2), each facing its first goal and looking ahead."""
    goal = _farther(place, chances.goal)
    zero = torch.zeros_like(habits.speed)
    return Walkers(
        place=place,
        velocity=torch.zeros_like(place),
        body=_direction(goal - place),
        turning=zero,
        leading=zero,
        head=zero,
        goal=goal,
        patience=_patience(place, goal, habits),
        standing=zero,
        look=zero.long(),
        looking=chances.looking,
    )


def step(walkers: Walkers, chances: Chances, habits: Habits, surroundings: Surroundings, pushes: Pushes) -> Walkers:
    """Return the talkers one `STEP` later."""
    walkers = _look(_arrive(walkers, chances, habits), chances)
    obstacles = _obstacles(walkers.place, habits, surroundings)
    target, intended = _intention(walkers, push(obstacles, *pushes), habits, surroundings)
    body, turning = _turned(walkers, target[0], habits)
    ahead = torch.stack([body.cos(), body.sin()], -1)
    wanted = (intended * ahead).sum(-1).clamp(0, habits.max_speed)
    speed = (walkers.velocity * ahead).sum(-1)
    braking = min(_BRAKING, habits.relaxation)
    time = torch.where(wanted < speed, wanted.new_tensor(braking), wanted.new_tensor(habits.relaxation))
    speed = torch.lerp(wanted, speed, torch.exp(-STEP / time))
    velocity = admissible(speed[..., None] * ahead, obstacles, STEP)
    share = -math.expm1(-STEP / _HEAD_LAG)
    sought = wrap_angle(target[1] - body).clamp(-habits.head_limit, habits.head_limit)
    leading = torch.lerp(walkers.leading, sought, share)
    return walkers._replace(
        place=walkers.place + STEP * velocity,
        velocity=velocity,
        body=body,
        turning=turning,
        leading=leading,
        head=torch.lerp(walkers.head, leading, share),
    )


def _arrive(walkers: Walkers, chances: Chances, habits: Habits) -> Walkers:
    """Return the talkers with new goals and times to stand where the old goal is reached, or given up."""
    walks = walkers.standing <= 0
    reached = walks & (torch.linalg.vector_norm(walkers.goal - walkers.place, dim=-1) < habits.arrival)
    over = reached | (walks & (walkers.patience <= 0))
    walkers = walkers._replace(patience=walkers.patience - STEP * walks, standing=walkers.standing - STEP)
    if not over.any():
        return walkers
    goal = torch.where(over[..., None], _farther(walkers.place, chances.goal), walkers.goal)
    return walkers._replace(
        goal=goal,
        patience=torch.where(over, _patience(walkers.place, goal, habits), walkers.patience),
        standing=torch.where(reached & chances.stops, chances.standing, walkers.standing),
    )


def _look(walkers: Walkers, chances: Chances) -> Walkers:
    """Return the talkers with something new to look at where the time of the last look is over."""
    over = walkers.looking <= 0
    if not over.any():
        return walkers._replace(looking=walkers.looking - STEP)
    return walkers._replace(
        look=torch.where(over, chances.look, walkers.look),
        looking=torch.where(over, chances.looking, walkers.looking - STEP),
    )


def _obstacles(place: Tensor, habits: Habits, surroundings: Surroundings) -> Obstacles:
    """Return what each talker must not run into: walls, then microphones, then other talkers."""
    slack = habits.max_speed * STEP / 4  # the most by which the curve can be inside the polygon of the steps
    s = surroundings
    return joined(
        walls(place, s.low, s.high),
        circles(place, s.microphones, s.keep_out + slack),
        others(place, habits.apart + 2 * slack),
    )


def _intention(
    walkers: Walkers, pushed: Tensor, habits: Habits, surroundings: Surroundings
) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """Return where body and head want to face [rad], and the velocity that the talker intends (..., 2)."""
    offset = walkers.goal - walkers.place
    way = offset / torch.linalg.vector_norm(offset, dim=-1, keepdim=True).clamp(min=1e-9)
    intended = habits.speed[..., None] * way + habits.relaxation * pushed
    stands, looks = walkers.standing > 0, walkers.look > 0
    watched = _direction(_watched(walkers, surroundings) - walkers.place)
    ahead = torch.where(stands, walkers.body, _direction(intended))
    body = torch.where(stands & looks, watched, ahead)
    return (body, torch.where(looks, watched, ahead)), torch.where(stands[..., None], 0.0, intended)


def _watched(walkers: Walkers, surroundings: Surroundings) -> Tensor:
    """Return the place (..., K, 2) that each talker looks at, if not ahead."""
    k = walkers.place.shape[-2]
    who = (torch.arange(k) + walkers.look - 1) % k
    place = walkers.place.gather(-2, who[..., None].expand(*who.shape, 2))
    return torch.where((walkers.look == 1)[..., None], surroundings.address, place)


def _turned(walkers: Walkers, target: Tensor, habits: Habits) -> tuple[Tensor, Tensor]:
    """Return the body [rad] and its turn rate [rad/s] after a step towards `target` [rad]."""
    speed = torch.linalg.vector_norm(walkers.velocity, dim=-1)
    limit = (habits.turn_rate * speed.clamp(min=1e-3) ** _TURN_EXPONENT).clamp(max=_STANDING_TURN)
    wanted = _TURN_GAIN * wrap_angle(target - walkers.body)
    wanted = torch.maximum(torch.minimum(wanted, limit), -limit)
    turning = torch.lerp(walkers.turning, wanted, -math.expm1(-STEP / _TURN_LAG))
    turning = torch.maximum(torch.minimum(turning, limit), -limit)
    return walkers.body + STEP * turning, turning


def _farther(place: Tensor, goals: Tensor) -> Tensor:
    """Return the farther from `place` of two `goals` (..., 2, 2): worth going to, also in a small room."""
    one, two = torch.linalg.vector_norm(goals - place[..., None, :], dim=-1).unbind(-1)
    chosen: Tensor = torch.where((two > one)[..., None], goals[..., 1, :], goals[..., 0, :])
    return chosen


def _patience(place: Tensor, goal: Tensor, habits: Habits) -> Tensor:
    distance: Tensor = torch.linalg.vector_norm(goal - place, dim=-1)
    return 2 * distance / habits.speed + _PATIENCE


def _direction(offset: Tensor) -> Tensor:
    return torch.atan2(offset[..., 1], offset[..., 0])
