"""The figures of S1: root mean square error and track loss."""

from typing import ClassVar

from torch import Tensor

from probtrack._checks import as_positive
from probtrack.errors import InputError
from probtrack.metrics.functional import position_error
from probtrack.metrics.metric import Parts, TrackMetric
from probtrack.metrics.talkers import Talkers


class RootMeanSquareError(TrackMetric):
    r"""Mean over runs of :math:`\bar\varepsilon = \sqrt{\frac1K \sum_k \varepsilon_k^2}` [m], of one talker.

    Frames whose truth is not known do not count.

    References:
        S1 eq. (7), averaged over runs as in its Figure 6 and Table 2.
    """

    name: ClassVar[str] = "rmse"
    unit: ClassVar[str] = "m"

    def parts(self, estimate: Talkers, truth: Talkers) -> Parts:
        error = error_of_one(estimate, truth)
        mean_square = error.square().nanmean(0)
        known = mean_square.isfinite()
        return Parts(mean_square.sqrt().where(known, 0.0), known.double())


class TrackLoss(TrackMetric):
    r"""Share of runs whose mean error over the last :math:`k^* = \lceil 0.5\,\mathrm s / T \rceil` frames is large.

    Args:
        threshold: delta [m].
        window: Length of the end that counts [s].

    References:
        S1 eq. (8), whose left side sums k* + 1 terms and divides by k* - 1: here the mean of k* frames.
    """

    name: ClassVar[str] = "track_loss"
    unit: ClassVar[str] = "%"

    def __init__(self, threshold: float = 0.1, window: float = 0.5) -> None:
        super().__init__()
        self.threshold, self.window = float(as_positive(threshold, "threshold")), float(as_positive(window, "window"))

    def parts(self, estimate: Talkers, truth: Talkers) -> Parts:
        raise NotImplementedError


def error_of_one(estimate: Talkers, truth: Talkers) -> Tensor:
    """Return the position errors (T, *batch) [m] of one talker, NaN where the truth is not known."""
    if truth.position is None or estimate.position is None:
        raise InputError("position errors need positions of the estimate and of the truth")
    talkers = truth.position.shape[-2], estimate.position.shape[-2]
    if talkers != (1, 1):
        raise InputError(f"a metric of one talker got {talkers[1]} tracks and {talkers[0]} true talkers")
    axes = min(truth.position.shape[-1], estimate.position.shape[-1])
    return position_error(estimate.position[..., 0, :axes], truth.position[..., 0, :axes])
