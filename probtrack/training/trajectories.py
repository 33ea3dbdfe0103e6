"""Measured or simulated trajectories, side by side with gaps and with time steps that differ."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.data import Dataset

from probtrack._checks import as_positive
from probtrack.errors import InputError

_ROUNDING = 1.01e-6  # s by which the time of a row may be off: files give microseconds


class Trajectory(NamedTuple):
    """Where a talker was seen.

    Attributes:
        name: What it is called in messages.
        group: What must not be parted between training and validation: its file, or its simulated walk.
        time: Times (N,) float64, increasing [s].
        position: Measured positions (N, A) float64, NaN where there is none [m].
    """

    name: str
    group: str
    time: Tensor
    position: Tensor


class TrajectoryBatch(NamedTuple):
    """B trajectories from their first measured position on, padded to the longest.

    Frames count from the one after the first position: frame t is `dt[t]` after the one before it.

    Attributes:
        names: Of the trajectories.
        numbers: Of the trajectories in their data set.
        first: First measured positions (B, A) [m].
        position: Measured positions (T, B, A), 0 where there is none [m].
        observed: Whether there is a measurement (T, B) bool.
        inside: Whether the trajectory has not yet ended (T, B) bool.
        dt: Time from the frame before (T, B), positive in the padding too [s].
    """

    names: tuple[str, ...]
    numbers: tuple[int, ...]
    first: Tensor
    position: Tensor
    observed: Tensor
    inside: Tensor
    dt: Tensor

    def time_step(self) -> float | Tensor:
        """Return the time step as one number if all frames share it, else (T, B) [s]."""
        one = self.dt[0, 0]
        return float(one) if (self.dt == one).all() else self.dt


class _Frames(NamedTuple):
    """One trajectory as a batch has it: position (T, A), with NaN, and dt (T,), from `first` (A,) on."""

    first: Tensor
    position: Tensor
    dt: Tensor


class TrajectoryDataset(Dataset[tuple[int, str, _Frames]]):
    """Trajectories as items that `collate_trajectories` makes a batch of.

    Args:
        trajectories: Each with two measured positions at least.
        longest_step: Longer steps of time are taken in equal parts without a measurement [s]; None to take all as they
            are. For models whose steps are approximations: S1's are for frames of a tracker, and the path of a
            curvilinear model is straight within a step.

    Raises:
        InputError: for a trajectory with fewer than two positions, with times that do not increase, or with
            positions that are infinite.
    """

    def __init__(self, trajectories: Sequence[Trajectory], longest_step: float | None = None) -> None:
        if longest_step is not None:
            longest_step = float(as_positive(longest_step, "longest_step"))
        self.trajectories = list(trajectories)
        self._frames = [_frames(one, longest_step) for one in self.trajectories]

    def __len__(self) -> int:
        return len(self.trajectories)

    def __getitem__(self, index: int | tuple[int, int]) -> tuple[int, str, _Frames]:
        number = index[0] if isinstance(index, tuple) else index
        return number, self.trajectories[number].name, self._frames[number]


def collate_trajectories(items: Sequence[tuple[int, str, _Frames]]) -> TrajectoryBatch:
    """Return items of a `TrajectoryDataset` side by side, in torch's default precision."""
    numbers, names, frames = zip(*items, strict=True)
    dtype, step = torch.get_default_dtype(), float(frames[0].dt[0])
    # padded by a step that others have: where all steps are equal they stay so
    dt = torch.nn.utils.rnn.pad_sequence([one.dt for one in frames], padding_value=step)
    position = torch.nn.utils.rnn.pad_sequence([one.position for one in frames], padding_value=math.nan)
    observed = position.isfinite().all(-1)
    length = torch.tensor([len(one.dt) for one in frames])
    return TrajectoryBatch(
        names=names,
        numbers=numbers,
        first=torch.stack([one.first for one in frames]).to(dtype),
        position=torch.where(observed[..., None], position, 0.0).to(dtype),
        observed=observed,
        inside=torch.arange(len(dt))[:, None] < length,
        dt=dt.to(dtype),
    )


def check_trajectory(trajectory: Trajectory, max_speed: float = math.inf) -> None:
    """Raise `InputError` unless a talker can have gone that way.

    Args:
        trajectory: With gaps, where a row has a NaN.
        max_speed: What nobody exceeds from one measured position to the next [m/s].

    Raises:
        InputError: for times that do not increase, infinite positions, fewer than two positions, or a jump.
    """
    name, _, time, position = trajectory
    later = time.diff() > 0
    if not later.all():  # nor NaN
        row = int((~later).nonzero()[0, 0]) + 1
        raise InputError(f"{name}, row {row + 1}: times must increase, got {time[row]:g} s after {time[row - 1]:g} s")
    infinite = position.isinf().any(-1)
    if infinite.any():
        row = int(infinite.nonzero()[0, 0])
        raise InputError(f"{name}, row {row + 1}: a position must be finite, or empty where there is none")
    rows = position.isfinite().all(-1).nonzero()[:, 0]
    if len(rows) < 2:
        raise InputError(f"{name}: must have at least 2 measured positions, got {len(rows)}")
    speed = torch.linalg.vector_norm(position[rows].diff(dim=0), dim=-1) / time[rows].diff()
    if (speed > max_speed).any():
        jump = int((speed > max_speed).nonzero()[0, 0])
        before, row = int(rows[jump]), int(rows[jump + 1])
        raise InputError(
            f"{name}, row {row + 1}: a jump, {speed[jump]:.3g} m/s from {time[before]:g} s to {time[row]:g} s is above "
            f"max_speed = {max_speed:g} m/s"
        )


def _frames(trajectory: Trajectory, longest_step: float | None) -> _Frames:
    check_trajectory(trajectory)
    seen = trajectory.position.isfinite().all(-1).nonzero()[:, 0]
    span = slice(int(seen[0]), int(seen[-1]) + 1)  # what lies before and after says nothing
    position, dt = trajectory.position[span].double(), _regular(trajectory.time[span].double().diff())
    first, later = position[0], position[1:]
    if longest_step is None or (dt <= longest_step).all():
        return _Frames(first, later, dt)
    parts = (dt / longest_step * (1 - 1e-9)).ceil().long().clamp_min(1)
    filled = later.new_full((int(parts.sum()), later.shape[-1]), math.nan)
    filled[parts.cumsum(0) - 1] = later
    return _Frames(first, filled, (dt / parts).repeat_interleave(parts))


def _regular(dt: Tensor) -> Tensor:
    """Return time steps (T,) that are equal, or multiples, but for the rounding of files, as exactly that.

    Models work out a step once for all frames that share it.
    """
    whole = (dt / dt.median()).round().clamp_min(1)
    near = (dt - whole * dt.median()).abs() <= _ROUNDING * (1 + whole)
    unit = round(float(dt[near].sum() / whole[near].sum()), 9)
    return torch.where(near, whole * unit, dt)
