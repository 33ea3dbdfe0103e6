"""Interface of an observation model."""

import abc
from typing import Any

import torch
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

    def possible(self, position: Tensor) -> Tensor:
        """Return whether a talker can be at `position` (..., A) at all, whatever is observed, (...) bool."""
        return torch.ones(position.shape[:-1], dtype=torch.bool, device=position.device)

    @abc.abstractmethod
    def forward(self, observation: Any, kinematics: Kinematics) -> Tensor:
        """Return log p(y_t | x_t) (*batch, N) of one prepared frame, -inf where it cannot be."""
