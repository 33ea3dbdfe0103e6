"""A measured position with Gaussian error."""

import math

from torch import Tensor, nn

from probtrack._checks import as_positive
from probtrack.dynamics import Kinematics
from probtrack.likelihoods.base import Likelihood


class GaussianPosition(Likelihood):
    r"""The position is measured with the same independent Gaussian error on every axis.

    .. math:: y = \ell + \sigma u, \qquad u \sim \mathcal N(0, I_A)

    With a linear motion model the exact answer is the Kalman filter's.

    Args:
        std: Initial standard deviation sigma of the error [m]; learnable as `log_std`.

    Shape:
        observation (*batch, A) [m]; returns (*batch, N).
    """

    def __init__(self, std: float) -> None:
        super().__init__()
        self.log_std = nn.Parameter(as_positive(std, "std").log())

    def forward(self, observation: Tensor, kinematics: Kinematics) -> Tensor:
        error = kinematics.position - observation[..., None, :]
        squares = error.square().sum(-1)
        constant = error.shape[-1] * (self.log_std + 0.5 * math.log(2 * math.pi))
        return squares * (-0.5 * (-2 * self.log_std).exp()) - constant
