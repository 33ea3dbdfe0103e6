"""OSPA and GOSPA of whole tracks, frame by frame."""

from typing import Literal

import torch

from probtrack.metrics.association import OfSets
from probtrack.metrics.metric import Parts
from probtrack.metrics.one_talker import sum_over_frames
from probtrack.metrics.sets import check_order, gospa, ospa
from probtrack.metrics.talkers import Talkers

_CUTOFFS = {"position": 1.0, "azimuth": torch.pi / 6}  # m; the 30 degrees of LOCATA


class _SetDistance(OfSets):
    """A distance of sets, averaged over frames."""

    def __init__(self, order: float, cutoff: float | None, by: Literal["position", "azimuth"]) -> None:
        super().__init__(_CUTOFFS.get(by, 1.0) if cutoff is None else cutoff, by)
        check_order(order, self.limit)
        self.order = order
        self.unit = "m" if by == "position" else "rad"


class OptimalSubPatternAssignment(_SetDistance):
    """OSPA, mean over frames of which the truth knows who is there, see `ospa`.

    Args:
        order: p >= 1.
        cutoff: c [m or rad]; 1 m or 30 degrees if not given.
        by: What is compared: positions, or azimuths alone.
    """

    name = "ospa"
    unit = "m"

    def __init__(
        self, order: float = 1.0, cutoff: float | None = None, by: Literal["position", "azimuth"] = "position"
    ) -> None:
        super().__init__(order, cutoff, by)

    def judge(self, estimate: Talkers, truth: Talkers) -> Parts:
        there, said = self.present(truth), self.present(estimate)
        distance = self.distance(estimate, truth)
        each = ospa(distance, there=there, said=said, order=self.order, cutoff=self.limit)
        return sum_over_frames(each.where(self.known(truth), torch.nan))


class GeneralisedSubPatternAssignment(_SetDistance):
    """GOSPA, mean over frames of which the truth knows who is there, see `gospa`.

    Args:
        order: p >= 1.
        cutoff: c [m or rad]; 1 m or 30 degrees if not given.
        by: What is compared: positions, or azimuths alone.
    """

    name = "gospa"
    unit = "m"

    def __init__(
        self, order: float = 2.0, cutoff: float | None = None, by: Literal["position", "azimuth"] = "position"
    ) -> None:
        super().__init__(order, cutoff, by)

    def judge(self, estimate: Talkers, truth: Talkers) -> Parts:
        there, said = self.present(truth), self.present(estimate)
        distance = self.distance(estimate, truth)
        each = gospa(distance, there=there, said=said, order=self.order, cutoff=self.limit).distance
        return sum_over_frames(each.where(self.known(truth), torch.nan))
