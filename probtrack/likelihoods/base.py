"""Interface of an observation model."""

import abc
from typing import Any

from torch import Tensor, nn

from probtrack.dynamics import Kinematics


class Likelihood(nn.Module, abc.ABC):
    """Observation density p(y_t | x_t), seen as a function of the state.

    It knows a talker by `Kinematics` alone, whatever the layout of the state.
    """

    def prepare(self, observations: Any) -> Any:
        """Return `observations` (T, *batch, ...) with everything added that particles do not change.

        A filter calls this once a block of frames and hands one frame of the result to each `forward`.
        """
        return observations

    @abc.abstractmethod
    def forward(self, observation: Any, kinematics: Kinematics) -> Tensor:
        """Return log p(y_t | x_t) (*batch, N) of one prepared frame, -inf where it cannot be."""
