"""Which way a talker looks, beside where the talker goes."""

from collections.abc import Callable, Hashable, Iterable
from typing import Any

import torch
from torch import Tensor

from probtrack._checks import check_event
from probtrack.distributions import Concatenated, LinearGaussian, WrappedGaussian
from probtrack.dynamics.axis_models import AxisModel, DrivenVelocity
from probtrack.dynamics.base import Dynamics, Kinematics, Move, Transition, checked_axes
from probtrack.dynamics.discretisation import euler
from probtrack.dynamics.processes import TimeCorrelated
from probtrack.dynamics.uncoupled import axis_sizes
from probtrack.geometry import wrap_angle


class WithHeading(Dynamics):
    r"""Any motion model, joined by a head that turns apart from the body.

    The heading theta moves on the circle by the model of one coordinate, wrapped to [-pi, pi) after each step:

    .. math:: \alpha = (\alpha_\ell, \theta, \dot\theta), \qquad p(\alpha' \mid \alpha) =
              p(\alpha_\ell' \mid \alpha_\ell)\, p(\theta', \dot\theta' \mid \theta, \dot\theta) .

    The joint step has a density if both parts have one: give both an `exact` discretisation.

    Args:
        motion: How the talker moves.
        turning: What the heading does [rad], as a coordinate; by default S2's Langevin motion by Euler steps
            with beta = 10 /s and a turn rate of 0.1 rad/s r.m.s.

    Shape:
        state (..., D + K): that of `motion`, then theta [rad] and its derivatives. dt: float or (...) [s].
        Returns batch (...), event (D + K,).

    References:
        S2 eq. 11 and section 4.2, whose parameters are the default; the same Langevin form as S1 eq. 21.

    >>> from probtrack.dynamics import lehmann2007
    >>> model = WithHeading(lehmann2007("CU-LAN"))
    >>> state = torch.tensor([0.0, 0.0, 1.0, 0.0, 3.1, 2.0])
    >>> [round(x, 3) for x in model.transition(0.1)(state, torch.zeros(3)).tolist()]
    [0.098, 0.0, 0.98, 0.0, -3.11, 0.736]
    """

    def __init__(self, motion: Dynamics, turning: AxisModel | None = None) -> None:
        super().__init__()
        self.motion = motion
        self.turning = DrivenVelocity(TimeCorrelated(rate=10.0, std=0.1), euler) if turning is None else turning
        self._order, self._noises = axis_sizes(self.turning)
        self.axes = checked_axes(motion)
        self.state_dim = motion.state_dim + self._order
        self.noise_dim = motion.noise_dim + self._noises

    @property
    def layout(self) -> Hashable | None:
        return None if self.motion.layout is None else ("heading", self.motion.layout, self._order)

    def forward(self, state: Tensor, dt: float | Tensor) -> Concatenated:
        check_event(state, (self.state_dim,), "state")
        motion, heading = state.split([self.motion.state_dim, self._order], -1)
        matrix, gain = self.turning(dt)
        turned = LinearGaussian((matrix @ heading[..., None])[..., 0], gain)
        return Concatenated([self.motion(motion, dt), WrappedGaussian(turned, angle=0)])

    def transition(self, dt: float | Tensor) -> Transition:
        move = self.motion.transition(dt)
        joined = self._joined(lambda state, noise: (move(state, noise), None), self._turned(dt))
        return lambda state, noise: joined(state, noise)[0]

    def moves(self, observations: Any, dt: float | Tensor) -> Iterable[Move]:
        step = self._turned(dt)
        return (self._joined(move, step) for move in self.motion.moves(observations, dt))

    def mode(self, state: Tensor) -> Tensor | None:
        return self.motion.mode(state[..., : self.motion.state_dim])

    def _joined(self, move: Move, step: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Move:
        size, noises = self.motion.state_dim, self.motion.noise_dim

        def joined(state: Tensor, noise: Tensor) -> tuple[Tensor, Tensor | None]:
            check_event(state, (self.state_dim,), "state")
            check_event(noise, (self.noise_dim,), "noise")
            moved, log_weight = move(state[..., :size], noise[..., :noises])
            return step(moved, state, noise), log_weight

        return joined

    def _turned(self, dt: float | Tensor) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
        """Return what joins a motion state that has moved and the next heading of (state, noise)."""
        matrix, gain = self.turning(dt)
        size, noises = self.motion.state_dim, self.motion.noise_dim
        shared = matrix.ndim == gain.ndim == 2  # one step for all, whatever their dt

        def step(moved: Tensor, state: Tensor, noise: Tensor) -> Tensor:
            head, numbers = state[..., size:], noise[..., noises:]
            if shared and state.shape[:-1] == noise.shape[:-1] and state.ndim > 1:
                turned = _rows(matrix, head) + _rows(gain, numbers)  # variables first, as clouds lie in memory
            else:
                turned = (matrix @ head[..., None] + gain @ numbers[..., None])[..., 0].movedim(-1, 0)
            return torch.cat([moved.movedim(-1, 0), wrap_angle(turned[:1]), turned[1:]]).movedim(0, -1)

        return step

    def kinematics(self, state: Tensor) -> Kinematics:
        check_event(state, (self.state_dim,), "state")
        motion = self.motion.kinematics(state.narrow(-1, 0, self.motion.state_dim))
        return motion._replace(modelled_heading=state[..., self.motion.state_dim])

    def from_kinematics(self, kinematics: Kinematics) -> Tensor:
        """Return the state (..., D + K) of a talker who moves and looks like that, with a head that is at rest."""
        motion, heading = self.motion.from_kinematics(kinematics), kinematics.heading
        known = torch.cat([motion, wrap_angle(heading)[..., None]], -1)
        return torch.nn.functional.pad(known, (0, self._order - 1))


def _rows(matrix: Tensor, vectors: Tensor) -> Tensor:
    """Return `matrix` (I, J) times `vectors` (..., J), variables first: (I, ...)."""
    variables = vectors.movedim(-1, 0)
    return (matrix @ variables.reshape(len(variables), -1)).view(-1, *variables.shape[1:])
