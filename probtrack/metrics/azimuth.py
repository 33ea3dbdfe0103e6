"""Errors of direction, the short way round."""

from probtrack.metrics.functional import root_mean_square
from probtrack.metrics.metric import Parts, TrackMetric
from probtrack.metrics.one_talker import angle_errors, one_a_run, sum_over_frames
from probtrack.metrics.talkers import Talkers


class AzimuthError(TrackMetric):
    """Mean over frames of the absolute azimuth error [rad], in [0, pi], of one talker.

    References:
        C. Evers et al., "The LOCATA challenge: acoustic source localization and tracking", IEEE/ACM Transactions on
        Audio, Speech, and Language Processing 28, 2020, eq. (12a), here without a gate.
    """

    name = "azimuth_error"
    unit = "rad"
    needs = ("azimuth",)
    wants = ("azimuth",)

    def judge(self, estimate: Talkers, truth: Talkers) -> Parts:
        return sum_over_frames(angle_errors(estimate, truth, "azimuth"))


class AzimuthRootMeanSquareError(TrackMetric):
    """Mean over runs of the root mean square azimuth error over frames [rad], of one talker.

    As the position's in S1 eq. (7), so that the two go by the same rule.
    """

    name = "azimuth_rmse"
    unit = "rad"
    needs = ("azimuth",)
    wants = ("azimuth",)

    def judge(self, estimate: Talkers, truth: Talkers) -> Parts:
        return one_a_run(root_mean_square(angle_errors(estimate, truth, "azimuth")))
