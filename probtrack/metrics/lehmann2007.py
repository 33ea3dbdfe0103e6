"""The figures of S1: root mean square error and track loss."""

from probtrack._checks import as_positive
from probtrack.metrics.functional import final_error, root_mean_square
from probtrack.metrics.metric import Parts, TrackMetric
from probtrack.metrics.one_talker import one_a_run, position_errors
from probtrack.metrics.talkers import TIME_ROUNDING, Talkers


class RootMeanSquareError(TrackMetric):
    r"""Mean over runs of :math:`\bar\varepsilon = \sqrt{\frac1K \sum_k \varepsilon_k^2}` [m], of one talker.

    Frames whose truth is not known do not count. An estimate that is missing makes the error infinite.

    References:
        S1 eq. (7), averaged over runs as in its Figure 6 and Table 2.
    """

    name = "rmse"
    unit = "m"

    def judge(self, estimate: Talkers, truth: Talkers) -> Parts:
        return one_a_run(root_mean_square(position_errors(estimate, truth)))


class TrackLoss(TrackMetric):
    r"""Share of runs whose mean error over the last :math:`k^* = \lceil 0.5\,\mathrm s / T \rceil` frames is large.

    They are the last k* frames *whose truth is known*: a truth that ends before the recording is judged at its end. A
    run with fewer has nothing to judge. A run that has no estimate at one of them is lost.

    Args:
        threshold: delta [m].
        window: Length of the end that counts [s].

    References:
        S1 eq. (8), whose left side sums k* + 1 terms and divides by k* - 1: here the mean of k* frames.
    """

    name = "track_loss"
    unit = "%"

    def __init__(self, threshold: float = 0.1, window: float = 0.5) -> None:
        super().__init__()
        as_positive(threshold, "threshold")
        as_positive(window, "window")
        self.threshold, self.window = threshold, window

    def judge(self, estimate: Talkers, truth: Talkers) -> Parts:
        # times may be rounded to a microsecond: a hair more, so that 0.5 s of frames of 1/30 s are 15 and not 16
        dt = estimate.dt + 2 * TIME_ROUNDING
        final = final_error(position_errors(estimate, truth), dt, window=self.window)
        return one_a_run((final > self.threshold).to(final.dtype).where(~final.isnan(), final))
