"""A measured position with Gaussian error."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from probtrack._checks import as_positive
from probtrack.dynamics import Kinematics
from probtrack.likelihoods.base import Likelihood


class MeasuredPosition(NamedTuple):
    """Measured positions with the two numbers that make a log density of a squared error.

    Attributes:
        position: (T, *batch, 1, A) [m].
        scale: -1 / (2 sigma^2) (T, 1).
        constant: -A log(sigma sqrt(2 pi)) (T, 1).
    """

    position: Tensor
    scale: Tensor
    constant: Tensor


class GaussianPosition(Likelihood):
    r"""The position is measured with the same independent Gaussian error on every axis.

    .. math:: y = \ell + \sigma u, \qquad u \sim \mathcal N(0, I_A)

    With a linear motion model the exact answer is the Kalman filter's.

    Args:
        std: Initial standard deviation sigma of the error [m]; learnable as `log_std`.

    Shape:
        `prepare` takes observations (T, *batch, A) [m]. Returns (*batch, N).
    """

    def __init__(self, std: float) -> None:
        super().__init__()
        self.log_std = nn.Parameter(as_positive(std, "std").log())

    def prepare(self, observations: Tensor) -> MeasuredPosition:
        axes = observations.shape[-1]
        constant = -axes * (self.log_std + 0.5 * math.log(2 * math.pi))
        scale = -0.5 * (-2 * self.log_std).exp()
        frames = (len(observations), 1)
        return MeasuredPosition(observations[..., None, :], scale.expand(frames), constant.expand(frames))

    def forward(self, observation: MeasuredPosition, kinematics: Kinematics) -> Tensor:
        first, *others = (kinematics.position - observation.position).unbind(-1)
        squares = first * first
        for error in others:  # a sum over so short an axis costs four times as much
            squares = torch.addcmul(squares, error, error)
        return torch.addcmul(observation.constant, squares, observation.scale)
