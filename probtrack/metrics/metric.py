"""What every metric of tracks is: a ratio of sums over frames, runs and recordings."""

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torchmetrics import Metric

from probtrack.errors import InputError, ShapeError
from probtrack.metrics.talkers import TIME_ROUNDING, Talkers


class Parts(NamedTuple):
    """A figure of each run as a fraction, so that figures of several runs are never averages of averages.

    Attributes:
        total: Numerator (*batch).
        count: Denominator (*batch); 0 where a run has nothing to judge.
    """

    total: Tensor
    count: Tensor  # type: ignore[assignment]  # the count of a tuple is of no use here


class TrackMetric(Metric, ABC):
    """A metric of tracks: `update` takes what is said and what is true, of one recording or a batch of runs.

    States are sums, so that results of several processes add up. A metric of one's own is a class with the attributes
    below and `judge`; callers use `parts`, which checks first.

    Attributes:
        name: What it is called in studies.
        unit: Of its value: "m", "rad", "s", "%" for a share, which is reported times 100, and so on.
        needs: Which columns of the truth it compares with; none for what is judged without truth.
        wants: Which columns of the estimate it looks at.
        one_talker: Whether it is of one track and one talker alone.
    """

    name: str
    unit: str = ""
    needs: tuple[str, ...] = ("position",)
    wants: tuple[str, ...] = ("position",)
    one_talker: bool = True
    full_state_update = False

    total: Tensor
    count: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    @abstractmethod
    def judge(self, estimate: Talkers, truth: Talkers) -> Parts:
        """Return the figure of each run (*batch); both are checked, in float64 and have as many axes of batch."""

    def parts(self, estimate: Talkers, truth: Talkers) -> Parts:
        """Return the figure of each run (*batch) of `estimate`, whose frames are at the times of `truth`.

        Raises:
            InputError: if either lacks a column that this metric looks at, there is more than one talker where it is
                of one, or the times of the two differ by more than rounding.
            ShapeError: if the two have different numbers of frames, or batches that do not broadcast.
        """
        self.checked(truth)
        lacking = [name for name in self.wants if getattr(estimate, name) is None]
        if lacking:
            raise InputError(f"metric {self.name} needs an estimate with {', '.join(lacking)}")
        if self.needs:
            _check_times(estimate.time, truth.time)
        if self.one_talker:
            for whose, one in (("tracks", estimate), ("true talkers", truth)):
                if one.num_talkers > 1:
                    raise InputError(f"metric {self.name} is of one talker, got {one.num_talkers} {whose}")
        try:
            batch = np.broadcast_shapes(estimate.batch, truth.batch)  # torch's own loads its compiler, 2 s
        except ValueError:
            raise ShapeError(f"truth must have the batch {estimate.batch} of the estimate, got {truth.batch}") from None
        parts = self.judge(estimate.as_double(len(batch)), truth.as_double(len(batch)))
        return Parts(parts.total.expand(batch), parts.count.expand(batch))

    def update(self, estimate: Talkers, truth: Talkers) -> None:
        """Take one more recording, or a batch of runs, into account."""
        parts = self.parts(estimate, truth)
        self.total += parts.total.sum()
        self.count += parts.count.sum()

    def compute(self) -> Tensor:
        """Return the figure of all that was taken into account, NaN where there was nothing to judge."""
        return self.total / self.count

    def checked(self, truth: Talkers) -> Talkers:
        """Return `truth`, or raise `InputError` where it lacks a column that this metric needs."""
        lacking = [name for name in self.needs if getattr(truth, name) is None]
        if lacking:
            raise InputError(f"metric {self.name} needs a truth with {', '.join(lacking)}")
        return truth


def _check_times(estimate: Tensor, truth: Tensor) -> None:
    """Raise `ShapeError` or `InputError` unless the times (T,) [s] of both are the same but for rounding."""
    if len(estimate) != len(truth):
        raise ShapeError(f"truth must have the {len(estimate)} frames of the estimate, got {len(truth)}")
    coarse = max(torch.finfo(time.dtype).eps for time in (estimate, truth))
    said, true = estimate.double(), truth.double()
    rounding = TIME_ROUNDING + 4 * coarse * true.abs()
    other = ~((said - true).abs() <= rounding)
    if other.any():
        frame = int(other.nonzero()[0])
        raise InputError(
            f"estimate must be at the times of the truth, got {said[frame]:g} s for {true[frame]:g} s at frame {frame}"
        )
