"""What can be asked of one run without a truth: whether it jumps, and whether it says it knows."""

import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor

from probtrack._checks import as_positive
from probtrack.errors import InputError
from probtrack.metrics.functional import azimuth_error
from probtrack.metrics.metric import Parts, TrackMetric
from probtrack.metrics.one_talker import column, one_a_run, sum_over_frames
from probtrack.metrics.talkers import Talkers


def largest_jump(azimuth: Tensor) -> Tensor:
    """Return the largest angle (...) [rad] between directions (T, ...) [rad] of neighbouring frames.

    Infinite where a direction is missing; NaN of fewer than two frames.
    """
    if len(azimuth) < 2:
        return azimuth.new_full(azimuth.shape[1:], torch.nan)
    return azimuth_error(azimuth[1:], azimuth[:-1]).nan_to_num(nan=torch.inf).amax(0)


class WithoutTruth(TrackMetric, ABC):
    """A metric of what a track says alone, in the part of a recording in which somebody talks.

    Args:
        begin: Frames before do not count [s]; None counts from the first.
        end: Frames from then on do not count [s]; None counts to the last.
    """

    unit = "rad"
    needs = ()
    wants = ("azimuth",)

    def __init__(self, begin: float | None = None, end: float | None = None) -> None:
        super().__init__()
        self.begin = -math.inf if begin is None else begin
        self.end = math.inf if end is None else end
        if not self.begin < self.end:
            raise InputError(f"begin must be before end, got {begin} and {end}")

    def judge(self, estimate: Talkers, truth: Talkers) -> Parts:  # noqa: ARG002
        return self.judge_alone(estimate.between(self.begin, self.end))

    @abstractmethod
    def judge_alone(self, estimate: Talkers) -> Parts:
        """Return the figure of each run (*batch) of one track, of the frames that count."""


class LargestJump(WithoutTruth):
    """Mean over runs of the largest jump of azimuth between neighbouring frames [rad]."""

    name = "largest_jump"

    def judge_alone(self, estimate: Talkers) -> Parts:
        return one_a_run(largest_jump(column(estimate, "azimuth")[..., 0]))


class AzimuthJumps(WithoutTruth):
    """Share of runs whose azimuth jumps by more than `jump` between neighbouring frames.

    Args:
        jump: What a talker cannot do from one frame to the next [rad].
        begin: Frames before do not count [s]; None counts from the first.
        end: Frames from then on do not count [s]; None counts to the last.
    """

    name = "azimuth_jumps"
    unit = "%"

    def __init__(self, jump: float = math.pi / 12, begin: float | None = None, end: float | None = None) -> None:
        super().__init__(begin, end)
        as_positive(jump, "jump")
        self.jump = jump

    def judge_alone(self, estimate: Talkers) -> Parts:
        jumps = largest_jump(column(estimate, "azimuth")[..., 0])
        return one_a_run((jumps > self.jump).to(jumps.dtype).where(~jumps.isnan(), jumps))


class Locked(WithoutTruth):
    """Share of frames whose stated circular standard deviation of the azimuth is under `limit`.

    Args:
        limit: Spread of a track that knows where the talker is [rad].
        begin: Frames before do not count [s]; None counts from the first.
        end: Frames from then on do not count [s]; None counts to the last.
    """

    name = "locked"
    unit = "%"
    wants = ("std_azimuth",)

    def __init__(self, limit: float = math.pi / 12, begin: float | None = None, end: float | None = None) -> None:
        super().__init__(begin, end)
        as_positive(limit, "limit")
        self.limit = limit

    def judge_alone(self, estimate: Talkers) -> Parts:
        std = column(estimate, "std_azimuth")[..., 0]
        return sum_over_frames((std < self.limit).to(std.dtype))
