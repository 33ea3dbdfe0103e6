"""The figures of S2: mean square error and mean spread of the cloud, of location and orientation."""

import torch
from torch import Tensor

from probtrack.metrics.metric import Parts, TrackMetric
from probtrack.metrics.one_talker import angle_errors, column, position_errors, sum_over_frames
from probtrack.metrics.talkers import Talkers


def mean_square_error(error: Tensor) -> Tensor:
    r"""Return :math:`\frac1K \sum_k \varepsilon_k^2` over the first axis of `error` (K, ...), without frames of NaN."""
    return error.square().nanmean(0)


def position_std(covariance: Tensor) -> Tensor:
    r"""Return :math:`\sqrt{\operatorname{tr} \Sigma}` (...) [m] of covariances (..., A, A) [m^2].

    That is the root mean square distance of a cloud from its mean: the one number that compares with an error.
    """
    return covariance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()


class MeanSquareError(TrackMetric):
    """Mean over frames of the squared position error [m^2], of one talker.

    References:
        S2 Table 1, "Location MSE".
    """

    name = "mse"
    unit = "m^2"

    def judge(self, estimate: Talkers, truth: Talkers) -> Parts:
        return sum_over_frames(position_errors(estimate, truth).square())


class MeanSpread(TrackMetric):
    r"""Mean over all frames of the spread :math:`\sqrt{\operatorname{tr} \Sigma}` [m] that a track states.

    References:
        S2 Table 1, "Location MSTD", which gives no formula; the mean standard deviation of the particle set.
    """

    name = "mstd"
    unit = "m"
    needs = ()
    wants = ("covariance",)

    def judge(self, estimate: Talkers, truth: Talkers) -> Parts:  # noqa: ARG002
        return sum_over_frames(_stated(position_std(column(estimate, "covariance")[..., 0, :, :])))


class HeadingMeanSquareError(TrackMetric):
    """Mean over frames of the squared heading error, the short way round [rad^2], of one talker.

    References:
        S2 Table 1, "Orientation MSE".
    """

    name = "heading_mse"
    unit = "rad^2"
    needs = ("heading",)
    wants = ("heading",)

    def judge(self, estimate: Talkers, truth: Talkers) -> Parts:
        return sum_over_frames(angle_errors(estimate, truth, "heading").square())


class HeadingMeanSpread(TrackMetric):
    """Mean over all frames of the circular standard deviation of the heading [rad] that a track states.

    References:
        S2 Table 1, "Orientation MSTD".
    """

    name = "heading_mstd"
    unit = "rad"
    needs = ()
    wants = ("std_heading",)

    def judge(self, estimate: Talkers, truth: Talkers) -> Parts:  # noqa: ARG002
        return sum_over_frames(_stated(column(estimate, "std_heading")[..., 0]))


def _stated(spread: Tensor) -> Tensor:
    """Return `spread`, infinite where a track states none: what says nothing is never sure."""
    return spread.nan_to_num(nan=torch.inf, posinf=torch.inf)
