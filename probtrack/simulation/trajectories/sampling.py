"""What all trajectories share: checked arguments, sample times, random numbers of a run, curves between nodes."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from probtrack._checks import check_event, check_int
from probtrack.errors import InputError
from probtrack.geometry import Region, wrap_angle
from probtrack.simulation.motion import Motion


def sample_times(duration: float, rate: float) -> Tensor:
    """Return the times (T,) [s] of round(duration * rate) samples, in float64, the first at 0.

    Raises:
        InputError: for a duration or rate that is not finite and positive, or less than one sample.
    """
    for name, value in (("duration", duration), ("rate", rate)):
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{name} must be finite and positive, got {value}")
    count = round(duration * rate)
    if count < 1:
        raise InputError(f"duration must be at least one sample of {rate:g} Hz, got {duration} s")
    return torch.arange(count, dtype=torch.float64) / rate


def check_draw(seeds: Sequence[int], num_talkers: int, region: Region, microphones: Tensor | None) -> None:
    """Raise `InputError` unless the arguments of `Trajectories.draw` can be used."""
    if len(seeds) == 0:
        raise InputError("seeds must have one integer a run, got none")
    for seed in seeds:
        if check_int(seed, "seeds", low=0) >= 2**63:
            raise InputError(f"seeds must be integers below 2^63, got {seed}")
    check_int(num_talkers, "num_talkers", low=1)
    if region.axes != 3:
        raise InputError(f"region must have 3 axes, got {region.axes}")
    if microphones is not None:
        check_event(microphones, (3,), "microphones")
        if microphones.ndim != 2 or not microphones.isfinite().all():
            raise InputError(f"microphones must be (M, 3) finite numbers, got shape {tuple(microphones.shape)}")


def hermite(at: Tensor, step: float, position: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor]:
    """Return the cubic Hermite curve (T, ...) through nodes `step` apart, and its derivative, at `at` (T,).

    Args:
        at: In [0, (N - 1) step].
        step: Time between two nodes [s].
        position: (N, ...), at the nodes.
        velocity: (N, ...), the derivative at the nodes.
    """
    node = (at / step).floor().long().clamp(0, len(position) - 2)
    s = (at / step - node).reshape(-1, *[1] * (position.ndim - 1))
    start, rise = position[node], position[node + 1] - position[node]
    first, last = velocity[node] * step, velocity[node + 1] * step
    bend, twist = 3 * rise - 2 * first - last, first + last - 2 * rise
    place = start + s * (first + s * (bend + s * twist))
    return place, (first + s * (2 * bend + s * (3 * twist))) / step


def between(at: Tensor, step: float, angle: Tensor) -> Tensor:
    """Return angles (T, ...) on straight lines between those of nodes `step` apart (N, ...), not wrapped."""
    node = (at / step).floor().long().clamp(0, len(angle) - 2)
    s = (at / step - node).reshape(-1, *[1] * (angle.ndim - 1))
    return torch.lerp(angle[node], angle[node + 1], s)


def finished(position: Tensor, velocity: Tensor, body: Tensor, mouth: Tensor) -> Motion:
    """Return the motion in torch's default precision, its angles in [-pi, pi)."""
    dtype = torch.get_default_dtype()
    # wrapped in the precision it is given in: rounding to float32 could miss the range
    return Motion(position.to(dtype), velocity.to(dtype), wrap_angle(body.to(dtype)), wrap_angle(mouth.to(dtype)))
