"""What every metric of tracks is: a ratio of sums over frames, runs and recordings."""

from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor
from torchmetrics import Metric

from probtrack.errors import InputError
from probtrack.metrics.talkers import Talkers


class Parts(NamedTuple):
    """A figure of each run as a fraction, so that figures of several runs are never averages of averages.

    Attributes:
        total: Numerator (*batch).
        count: Denominator (*batch); 0 where a run has nothing to judge.
    """

    total: Tensor
    count: Tensor


class TrackMetric(Metric, ABC):  # type: ignore[misc]
    """A metric of tracks: `update` takes what is said and what is true, of one recording or a batch of runs.

    States are sums, so that results of several processes add up. A metric of one's own gives `parts`.

    Attributes:
        name: What it is called in studies.
        unit: Of its value: "m", "rad", "s", "%" for a share, which is reported times 100, and so on.
        needs: Which columns of the truth it compares with; none for what is judged without truth.
    """

    name: ClassVar[str]
    unit: ClassVar[str] = ""
    needs: ClassVar[tuple[str, ...]] = ("position",)
    full_state_update = False

    total: Tensor
    count: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    @abstractmethod
    def parts(self, estimate: Talkers, truth: Talkers) -> Parts:
        """Return the figure of each run (*batch) of `estimate`, at the same times as `truth`."""

    def update(self, estimate: Talkers, truth: Talkers) -> None:
        """Take one more recording, or a batch of runs, into account."""
        parts = self.parts(estimate, self.checked(truth))
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
