"""Whether runs of one recording agree, and whether that is as well as each of them says: no truth is needed."""

import torch
from torch import Tensor

from probtrack.errors import ShapeError
from probtrack.metrics.fallon2006 import position_std
from probtrack.metrics.functional import azimuth_error, root_mean_square
from probtrack.metrics.metric import Parts
from probtrack.metrics.one_talker import column, one_a_run
from probtrack.metrics.smoothness import WithoutTruth
from probtrack.metrics.talkers import Talkers


def azimuth_disagreement(azimuth: Tensor) -> Tensor:
    r"""Return how far each of R runs is from the mean direction of all (..., R) [rad], of azimuths (T, ..., R) [rad].

    .. math:: \sqrt{\frac{1}{T} \sum_t \frac{R}{R - 1} \angle(\theta_{tr}, \bar\theta_t)^2}

    so that independent runs differ by the standard deviation of a run (as :math:`s^2` divides by R - 1). Runs that say
    nothing at a frame are infinitely far there, and not in the mean. NaN where there are not two runs.
    """
    said = azimuth.isfinite()
    east, north = (f(azimuth).where(said, 0.0).sum(-1, keepdim=True) for f in (torch.cos, torch.sin))
    return _root_mean_square(azimuth_error(azimuth, torch.atan2(north, east)), said)


def position_disagreement(position: Tensor) -> Tensor:
    r"""Return how far each of R runs is from the mean of all (..., R) [m], of positions (T, ..., R, A) [m].

    .. math:: \sqrt{\frac{1}{T} \sum_t \frac{R}{R - 1} \lVert \hat\ell_{tr} - \bar\ell_t \rVert^2}

    with runs that say nothing as in `azimuth_disagreement`.
    """
    said = position.isfinite().all(-1)
    total = position.where(said[..., None], 0.0).sum(-2, keepdim=True)
    mean = total / said.sum(-1).clamp_min(1)[..., None, None]
    return _root_mean_square(torch.linalg.vector_norm(position - mean, dim=-1), said)


class AzimuthDisagreement(WithoutTruth):
    """Mean over runs of the root mean square deviation of a run's azimuth from the mean direction of all runs [rad].

    Compares with `AzimuthSpread`: more means that runs are surer than they may be. Batches end with the axis of runs.

    Args:
        begin: Frames before do not count [s]; None counts from the first.
        end: Frames from then on do not count [s]; None counts to the last.
    """

    name = "azimuth_disagreement"

    def judge_alone(self, estimate: Talkers) -> Parts:
        return one_a_run(azimuth_disagreement(_of_runs(column(estimate, "azimuth")[..., 0], events=0)))


class PositionDisagreement(WithoutTruth):
    """Mean over runs of the root mean square distance of a run from the mean position of all runs [m].

    Compares with `PositionSpread`, as the azimuth's with `AzimuthSpread`. Batches end with the axis of runs.

    Args:
        begin: Frames before do not count [s]; None counts from the first.
        end: Frames from then on do not count [s]; None counts to the last.
    """

    name = "position_disagreement"
    unit = "m"
    wants = ("position",)

    def judge_alone(self, estimate: Talkers) -> Parts:
        return one_a_run(position_disagreement(_of_runs(column(estimate, "position")[..., 0, :], events=1)))


class AzimuthSpread(WithoutTruth):
    """Mean over runs of the root mean square, over frames, of the stated standard deviation of the azimuth [rad].

    Args:
        begin: Frames before do not count [s]; None counts from the first.
        end: Frames from then on do not count [s]; None counts to the last.
    """

    name = "azimuth_spread"
    wants = ("std_azimuth",)

    def judge_alone(self, estimate: Talkers) -> Parts:
        std = column(estimate, "std_azimuth")[..., 0]
        return one_a_run(root_mean_square(std.nan_to_num(nan=torch.inf, posinf=torch.inf)))


class PositionSpread(WithoutTruth):
    """Mean over runs of the root mean square, over frames, of the stated distance from the mean [m].

    Args:
        begin: Frames before do not count [s]; None counts from the first.
        end: Frames from then on do not count [s]; None counts to the last.
    """

    name = "position_spread"
    unit = "m"
    wants = ("covariance",)

    def judge_alone(self, estimate: Talkers) -> Parts:
        std = position_std(column(estimate, "covariance")[..., 0, :, :])
        return one_a_run(root_mean_square(std.nan_to_num(nan=torch.inf, posinf=torch.inf)))


def _of_runs(values: Tensor, *, events: int) -> Tensor:
    """Return `values` (T, *batch, ...), or raise `ShapeError` unless the batch has an axis of runs."""
    if values.ndim - events < 2:
        raise ShapeError("runs can disagree if the batch ends with their axis, got a track without a batch")
    return values


def _root_mean_square(deviation: Tensor, said: Tensor) -> Tensor:
    """Return the root mean square over frames of `deviation` (T, ..., R) of the runs that have `said` something."""
    runs = said.sum(-1, keepdim=True).to(deviation.dtype)
    square = (deviation.square() * runs / (runs - 1)).where(said, torch.inf)
    return root_mean_square(square.where(runs > 1, torch.nan).sqrt())
