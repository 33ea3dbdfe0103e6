"""How a talker's direction of motion changes: by itself, or as a normal acceleration bends the path."""

import abc
from collections.abc import Callable

import torch
from torch import Tensor, nn

from probtrack._checks import as_positive
from probtrack.dynamics.processes import ScalarProcess, seconds
from probtrack.errors import InputError
from probtrack.geometry import wrap_angle

Turn = Callable[[list[Tensor], Tensor, Tensor], list[Tensor]]
"""One step of the direction, `(variables, speed, noise) -> variables`, each (...): the direction phi comes first,
`speed` is the new one, `noise` one standard normal number."""


class Turning(nn.Module, abc.ABC):
    """What the direction of motion phi of a curvilinear model does."""

    num_variables: int
    """How many variables the direction needs in the state: phi, and what drives it."""

    @abc.abstractmethod
    def turn(self, dt: float | Tensor) -> Turn:
        """Return the step of the direction over `dt` (...) [s]."""


class TurnAngle(Turning):
    r"""A direction that is a scalar process itself (TU of S1): :math:`\phi = \xi`.

    A random walk has no preferred direction and is wrapped to [-pi, pi). A time-correlated angle is printed
    as it is: it reverts to phi = 0, the x axis of the room, and is not wrapped, as that would change its law.

    Args:
        process: What the angle does [rad].

    References:
        S1 eq. 25, 26, second rows.
    """

    num_variables = 1

    def __init__(self, process: ScalarProcess) -> None:
        super().__init__()
        self.process = process

    def turn(self, dt: float | Tensor) -> Turn:
        decay, std = self.process(dt)
        wrap = wrap_angle if self.process.unbounded else _unchanged

        def turn(variables: list[Tensor], speed: Tensor, noise: Tensor) -> list[Tensor]:  # noqa: ARG001
            return [wrap(torch.addcmul(decay * variables[0], std, noise))]

        return turn


class NormalAcceleration(Turning):
    r"""A direction that turns as an acceleration a across the path demands (RA, RW or TC "AC" of S1):

    .. math:: \phi' = \phi + T a' \frac{v'}{v'^2 + v_0^2} .

    On a circle a = v dphi/dt: who walks fast turns slowly. S1 has T a' / v', which is infinite for a talker
    who stands; here the turn rate falls back to 0 below v_0, smoothly, and differs from S1's by less than
    1 % above 10 v_0.

    Args:
        process: What the acceleration does [m/s^2]: white noise, a random walk or a time-correlated process.
        min_speed: v_0, the speed of fastest turning [m/s], a constant of at least 1e-6.

    References:
        S1 eq. 27, 28; second rows of eq. 29 (white noise), 30 (random walk), 31 (time-correlated).
    """

    num_variables = 2

    def __init__(self, process: ScalarProcess, min_speed: float = 0.02) -> None:
        super().__init__()
        self.process = process
        self.min_speed = float(as_positive(min_speed, "min_speed"))
        if self.min_speed < 1e-6:  # its square must not vanish in float32
            raise InputError(f"min_speed must be at least 1e-6 m/s, got {min_speed}")

    def turn(self, dt: float | Tensor) -> Turn:
        decay, std = self.process(dt)
        step = seconds(dt, std)

        def turn(variables: list[Tensor], speed: Tensor, noise: Tensor) -> list[Tensor]:
            direction, acceleration = variables
            acceleration = torch.addcmul(decay * acceleration, std, noise)
            rate = acceleration * speed / torch.addcmul(speed.new_tensor(self.min_speed**2), speed, speed)
            return [wrap_angle(torch.addcmul(direction, step, rate)), acceleration]

        return turn

    def extra_repr(self) -> str:
        return f"min_speed={self.min_speed:g} m/s"


def _unchanged(angle: Tensor) -> Tensor:
    return angle
