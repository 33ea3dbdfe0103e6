"""Whether the truth is as far from a track as the track says: calibration of the stated spread."""

from abc import ABC

import torch
from torch import Tensor

from probtrack._checks import as_non_negative, check_event
from probtrack.metrics.metric import Parts, TrackMetric
from probtrack.metrics.one_talker import column, sum_over_frames
from probtrack.metrics.talkers import Talkers


def normalised_square_error(error: Tensor, covariance: Tensor) -> Tensor:
    r"""Return :math:`e^\top \Sigma^{-1} e` (...) of errors (..., A) [m] and covariances (..., A, A) [m^2].

    Chi-square with A degrees of freedom, so A on average, if the truth is drawn from the stated Gaussian. Infinite
    where the covariance is not positive definite (a cloud of one point is certain, and wrong) or either is not known.

    >>> normalised_square_error(torch.tensor([2.0, 3.0]), torch.diag(torch.tensor([4.0, 1.0])))
    tensor(10.)
    """
    axes = error.shape[-1]
    check_event(covariance, (axes, axes), "covariance")
    square = torch.zeros((), dtype=error.dtype, device=error.device)
    for _ in range(axes):  # each axis given those before: far faster than a factorisation a frame
        variance = covariance[..., 0, 0]
        square = square + (error[..., 0].square() / variance).where(variance > 0, torch.inf)
        gain = covariance[..., 1:, 0] / variance[..., None]
        error = error[..., 1:] - gain * error[..., :1]
        covariance = covariance[..., 1:, 1:] - gain[..., :, None] * covariance[..., :1, 1:]
    return square.nan_to_num(nan=torch.inf, posinf=torch.inf)


def inside_region(error: Tensor, covariance: Tensor, probability: float) -> Tensor:
    r"""Return whether errors (..., A) lie in the ellipsoid that holds `probability` of the Gaussian N(0, covariance).

    That is where :math:`F_A(e^\top \Sigma^{-1} e) \le p`, with F_A the chi-square distribution of A degrees of freedom.
    """
    square = normalised_square_error(error, covariance).double()
    half = square.new_tensor(error.shape[-1] / 2)
    held: Tensor = torch.special.gammainc(half, square / 2)
    return held <= probability


class Coverage(TrackMetric, ABC):
    """Share of frames whose truth lies in the region that holds `probability` of the stated Gaussian, of one talker.

    As much as `probability` of a track that is calibrated: less of one too sure of itself, more of one too modest.

    Attributes:
        probability: That the region holds, in (0, 1).
    """

    unit = "%"
    wants = ("position", "covariance")
    probability: float

    def judge(self, estimate: Talkers, truth: Talkers) -> Parts:
        error, covariance, known = _stated(estimate, truth)
        inside = inside_region(error, covariance, self.probability)
        return sum_over_frames(inside.to(error.dtype).where(known, torch.nan))


class Coverage50(Coverage):
    """Share of frames whose truth lies in the 50 % region of the stated Gaussian."""

    name = "coverage_50"
    probability = 0.5


class Coverage90(Coverage):
    """Share of frames whose truth lies in the 90 % region of the stated Gaussian."""

    name = "coverage_90"
    probability = 0.9


class NormalisedSquareError(TrackMetric):
    r"""Mean over frames of :math:`e^\top \Sigma^{-1} e`, the normalised estimation error squared (NEES), of one talker.

    As much as the number of axes A of a track that is calibrated, with standard error :math:`\sqrt{2A/n}` over n frames
    whose errors are independent (those of neighbouring frames are not). More of one that is too sure of itself.

    A cloud with all its weight on one particle states that nothing is uncertain, which makes one frame infinite and the
    mean useless: `floor` is added to what is stated, as an error that no talker's mouth is free of.

    Args:
        floor: Standard deviation on every axis [m]; 0 takes the stated covariance as it is.

    References:
        Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with applications to tracking and navigation", 2001,
        section 5.4.2.
    """

    name = "nees"
    wants = ("position", "covariance")

    def __init__(self, floor: float = 0.01) -> None:
        super().__init__()
        self.floor = float(as_non_negative(floor, "floor"))

    def judge(self, estimate: Talkers, truth: Talkers) -> Parts:
        error, covariance, known = _stated(estimate, truth)
        covariance = covariance + self.floor**2 * torch.eye(
            covariance.shape[-1], dtype=covariance.dtype, device=covariance.device
        )
        return sum_over_frames(normalised_square_error(error, covariance).where(known, torch.nan))


def _stated(estimate: Talkers, truth: Talkers) -> tuple[Tensor, Tensor, Tensor]:
    """Return errors (T, *batch, A), their stated covariances, and where the truth is known (T, *batch)."""
    at, truly = column(estimate, "position")[..., 0, :], column(truth, "position")[..., 0, :]
    axes = min(at.shape[-1], truly.shape[-1])
    covariance = column(estimate, "covariance")[..., 0, :axes, :axes]
    return at[..., :axes] - truly[..., :axes], covariance, truly[..., :axes].isfinite().all(-1)
