"""A measured position with Gaussian error."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from probtrack._checks import as_positive
from probtrack.dynamics import Kinematics
from probtrack.errors import NotFiniteError, ShapeError
from probtrack.likelihoods.base import Likelihood


class Positions(NamedTuple):
    """Measured positions, of which some are missing.

    Attributes:
        position: (T, *batch, A) [m]; what is missing may hold anything, NaN too.
        observed: Whether there is a measurement (T, *batch) bool.
    """

    position: Tensor
    observed: Tensor


class MeasuredPosition(NamedTuple):
    """Measured positions with the two numbers that make a log density of a squared error.

    Attributes:
        position: (T, *batch, 1, A) [m].
        scale: -1 / (2 sigma^2) (T, 1), or (T, *batch, 1) and 0 where nothing was measured.
        constant: -A log(sigma sqrt(2 pi)), of the same shape, 0 where nothing was measured.
    """

    position: Tensor
    scale: Tensor
    constant: Tensor


class GaussianPosition(Likelihood):
    r"""The position is measured with the same independent Gaussian error on every axis.

    .. math:: y = \ell + \sigma u, \qquad u \sim \mathcal N(0, I_A)

    A frame without a measurement says nothing: its log density is 0 everywhere. With a linear motion model the exact
    answer is the Kalman filter's.

    Args:
        std: Initial standard deviation sigma of the error [m]; learnable as `log_std`.

    Shape:
        `prepare` takes observations (T, *batch, A) [m], or `Positions`. Returns (*batch, N).

    Raises:
        InputError: for a std that is not positive.
        ShapeError: for flags of another shape than the positions have.
        NotFiniteError: for a measured position of `Positions` that is NaN or infinite.
    """

    def __init__(self, std: float) -> None:
        super().__init__()
        self.log_std = nn.Parameter(as_positive(std, "std").log())

    def prepare(self, observations: Tensor | Positions) -> MeasuredPosition:
        position, observed = (observations, None) if isinstance(observations, Tensor) else _present(observations)
        constant = -position.shape[-1] * (self.log_std + 0.5 * math.log(2 * math.pi))
        scale = -0.5 * (-2 * self.log_std).exp()
        if observed is None:
            frames = (len(position), 1)
            return MeasuredPosition(position[..., None, :], scale.expand(frames), constant.expand(frames))
        return MeasuredPosition(position[..., None, :], scale * observed, constant * observed)

    def forward(self, observation: MeasuredPosition, kinematics: Kinematics) -> Tensor:
        # axes first, as clouds lie in memory: so do gradients
        first, *others = (kinematics.position - observation.position).movedim(-1, 0).unbind(0)
        squares = first * first
        for error in others:  # a sum over so short an axis costs four times as much
            squares = torch.addcmul(squares, error, error)
        return torch.addcmul(observation.constant, squares, observation.scale)


def _present(observations: Positions) -> tuple[Tensor, Tensor]:
    """Return positions with 0 where there is none, and 1 where there is one, else 0 (T, *batch, 1)."""
    position, observed = observations
    if observed.dtype != torch.bool or observed.shape != position.shape[:-1]:
        raise ShapeError(
            f"observed must be bool of shape {tuple(position.shape[:-1])}, got {observed.dtype} of shape "
            f"{tuple(observed.shape)}"
        )
    bad = observed & ~position.isfinite().all(-1)
    if bad.any():
        frame = int(bad.nonzero()[0, 0])
        raise NotFiniteError(f"measured positions must be finite, not so in frame {frame}: mark it as not observed")
    flags = observed[..., None]
    return torch.where(flags, position, 0.0), flags.to(position)
