"""Motion in which every coordinate goes its own way."""

from collections.abc import Hashable

import torch
from torch import Tensor

from probtrack._checks import check_event, check_int
from probtrack.distributions import LinearGaussian
from probtrack.dynamics.axis_models import AxisModel
from probtrack.dynamics.base import Dynamics, Kinematics, Transition
from probtrack.errors import ShapeError


class CoordinateUncoupled(Dynamics):
    r"""Coordinates that move independently, each by the same linear model and with its own noise:

    .. math:: X' = (F \otimes I_A)\,X + (G \otimes I_A)\,u, \qquad u \sim \mathcal{N}(0, I_{JA}) .

    Whether a step has a density is the axis model's affair: it has one if G has full row rank.

    Args:
        axis_model: What one coordinate does: F (K, K) and G (K, J) for a step.
        axes: Number of coordinates A.

    Shape:
        state (..., K A): positions [m], then velocities [m/s], then higher derivatives. dt: float or
        (...) [s], broadcast with the batch of `state`. Returns batch (...), event (K A,).

    References:
        S1 eq. 15, 16: the layout of the state.

    >>> from probtrack.dynamics import DrivenVelocity, TimeCorrelated
    >>> model = CoordinateUncoupled(DrivenVelocity(TimeCorrelated(rate=2.0, std=0.7)))
    >>> law = model(torch.tensor([1.0, 2.0, 0.5, -0.5]), 0.5)
    >>> [round(x, 3) for x in law.mean.tolist()]
    [1.158, 1.842, 0.184, -0.184]
    """

    def __init__(self, axis_model: AxisModel, axes: int = 2) -> None:
        super().__init__()
        self.axis_model = axis_model
        self.axes = check_int(axes, "axes", low=1)
        order, noises = axis_sizes(axis_model)
        self.state_dim, self.noise_dim = order * axes, noises * axes

    @property
    def layout(self) -> Hashable | None:
        return "positions and their derivatives", self.axes, self.state_dim

    def matrices(self, dt: float | Tensor) -> tuple[Tensor, Tensor]:
        """Return F (..., D, D) and G (..., D, J A) of the step X' = F X + G u over `dt` (...) [s]."""
        matrix, gain = self.axis_model(dt)
        return _kron_eye(matrix, self.axes), _kron_eye(gain, self.axes)

    def forward(self, state: Tensor, dt: float | Tensor) -> LinearGaussian:
        check_event(state, (self.state_dim,), "state")
        matrix, gain = self.matrices(dt)
        return LinearGaussian((matrix @ state[..., None])[..., 0], gain)

    def transition(self, dt: float | Tensor) -> Transition:
        matrix, gain = self.matrices(dt)
        if matrix.ndim > 2 or gain.ndim > 2:
            return lambda state, noise: (matrix @ state[..., None] + gain @ noise[..., None])[..., 0]

        def step(state: Tensor, noise: Tensor) -> Tensor:
            check_event(state, (self.state_dim,), "state")
            check_event(noise, (self.noise_dim,), "noise")
            if state.ndim < 2 or state.shape[:-1] != noise.shape[:-1]:
                return state @ matrix.mT + noise @ gain.mT
            # Variables first in memory, whatever the batch: one product for all clouds, and rows to run along.
            if state.ndim == 2:
                return (matrix @ state.mT).addmm_(gain, noise.mT).mT
            moved = matrix @ state.movedim(-1, 0).reshape(state.shape[-1], -1)
            # In place: at 1e5 particles another buffer costs as much as the product.
            moved.addmm_(gain, noise.movedim(-1, 0).reshape(noise.shape[-1], -1))
            return moved.view(-1, *state.shape[:-1]).movedim(0, -1)

        return step

    def kinematics(self, state: Tensor) -> Kinematics:
        check_event(state, (self.state_dim,), "state")
        if state.requires_grad:
            # split variables first: gradients lie in memory as clouds do, and one is not copied to meet another
            position, velocity, *_ = state.movedim(-1, 0).split(self.axes)
            return Kinematics(position.movedim(0, -1), velocity.movedim(0, -1))
        # narrow: a third of the time of an index, and a filter asks every frame
        return Kinematics(state.narrow(-1, 0, self.axes), state.narrow(-1, self.axes, self.axes))

    def from_kinematics(self, kinematics: Kinematics) -> Tensor:
        """Return the state (..., K A) with that position and velocity; higher derivatives are zero."""
        check_event(kinematics.position, (self.axes,), "position")
        check_event(kinematics.velocity, (self.axes,), "velocity")
        known = torch.cat([kinematics.position, kinematics.velocity], -1)
        return torch.nn.functional.pad(known, (0, self.state_dim - 2 * self.axes))

    def extra_repr(self) -> str:
        return f"axes={self.axes}"


def axis_sizes(axis_model: AxisModel) -> tuple[int, int]:
    """Return how many variables K and noise numbers J an axis model has, read off a step of a second."""
    with torch.no_grad():
        matrix, gain = axis_model(1.0)
    order = matrix.shape[-1] if matrix.ndim else 0
    if order < 2 or matrix.shape != (order, order) or gain.ndim != 2 or gain.shape[0] != order:
        raise ShapeError(
            "an axis model must return a matrix (K, K) and a gain (K, J) with K at least 2, "
            f"got {tuple(matrix.shape)} and {tuple(gain.shape)}"
        )
    return order, gain.shape[-1]


def _kron_eye(matrix: Tensor, size: int) -> Tensor:
    """Return the Kronecker product of `matrix` (..., I, J) and the identity: (..., I size, J size)."""
    rows, columns = matrix.shape[-2:]
    eye = torch.eye(size, dtype=matrix.dtype, device=matrix.device)
    blocks = matrix[..., :, None, :, None] * eye[:, None, :]
    return blocks.reshape(*matrix.shape[:-2], rows * size, columns * size)
