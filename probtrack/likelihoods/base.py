"""Interface of an observation model."""

import abc
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from probtrack.dynamics import Kinematics


class EvidenceMap(NamedTuple):
    """What frames alone say of where the talker is, on the cells of a regular grid.

    Attributes:
        log_evidence: (T, *batch, G), up to a constant of the frame.
        centre: Of the cells (G, A) [m].
        size: Edges of a cell (A,) [m].
    """

    log_evidence: Tensor
    centre: Tensor
    size: Tensor


class Likelihood(nn.Module, abc.ABC):
    """Observation density p(y_t | x_t), seen as a function of the state.

    It knows a talker by `Kinematics` alone, whatever the layout of the state.
    """

    def prepare(self, observations: Any) -> Any:
        """Return `observations` (T, *batch, ...) with everything added that particles do not change.

        A filter calls this once a block of frames and hands one frame of the result to each `forward`.
        """
        return observations

    def evidence_map(self, prepared: Any) -> EvidenceMap | None:  # noqa: ARG002
        """Return where each of the `prepared` frames says the talker is, or None if it does not tell by itself."""
        return None

    def possible(self, position: Tensor) -> Tensor:
        """Return whether a talker can be at `position` (..., A) at all, whatever is observed, (...) bool."""
        return torch.ones(position.shape[:-1], dtype=torch.bool, device=position.device)

    @abc.abstractmethod
    def forward(self, observation: Any, kinematics: Kinematics) -> Tensor:
        """Return log p(y_t | x_t) (*batch, N) of one prepared frame, -inf where it cannot be."""
