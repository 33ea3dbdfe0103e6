"""Motion along a path: how fast, and which way."""

from collections.abc import Hashable

import torch
from torch import Tensor

from probtrack._checks import check_event
from probtrack.distributions import Pushforward
from probtrack.dynamics.axis_models import AxisModel, DrivenVelocity
from probtrack.dynamics.base import Dynamics, Kinematics, Transition, direction
from probtrack.dynamics.processes import ScalarProcess, TimeCorrelated, seconds
from probtrack.dynamics.turning import Turning
from probtrack.dynamics.uncoupled import axis_sizes
from probtrack.errors import InputError


class Curvilinear(Dynamics):
    r"""A talker who walks at a speed v in a direction phi, both with dynamics of their own:

    .. math:: x' = x + T v' \cos\phi', \qquad y' = y + T v' \sin\phi' .

    The speed has a sign: below 0 the talker walks backwards, as the equations of S1 have it. The position
    follows from speed and direction without noise of its own, so that the step can be sampled but has no
    density; there is no other discretisation, since the motion in continuous time has no closed form.

    Args:
        speed: What the speed does [m/s].
        turning: What the direction does, `TurnAngle` or `NormalAcceleration`.
        axes: Number of coordinates A, 2 or 3.
        height: What the height of the mouth does in 3-D, independently of the walk; by default a slow process,
            a velocity of 5 cm/s that lasts a second.

    Shape:
        state (..., D): x, y, (z,) v, phi, and with a normal acceleration a; in 3-D the derivatives of z
        follow. dt: float or (...) [s]. Returns batch (...), event (D,).

    References:
        S1 eq. 22 to 24 and 27. Height is not in S1.

    >>> from probtrack.dynamics import RandomWalk, TurnAngle
    >>> model = Curvilinear(RandomWalk(0.1), TurnAngle(RandomWalk(0.5)))
    >>> state = model.from_kinematics(Kinematics(torch.zeros(2), torch.tensor([2.0, 0.0])))
    >>> [round(x, 3) for x in model(state, 0.5).at_noise(torch.zeros(2)).tolist()]
    [1.0, 0.0, 2.0, 0.0]
    """

    def __init__(
        self, speed: ScalarProcess, turning: Turning, *, axes: int = 2, height: AxisModel | None = None
    ) -> None:
        super().__init__()
        if not isinstance(axes, int) or axes not in (2, 3):
            raise InputError(f"axes must be 2 or 3, got {axes}")
        if not isinstance(speed, ScalarProcess) or not isinstance(turning, Turning):
            raise InputError(
                "speed must be a ScalarProcess and turning a Turning such as TurnAngle(process), "
                f"got {type(speed).__name__} and {type(turning).__name__}"
            )
        if axes == 2 and height is not None:
            raise InputError("height needs axes=3, got axes=2")
        if axes == 3 and height is None:
            height = DrivenVelocity(TimeCorrelated(rate=1.0, std=0.05))
        self.speed, self.turning, self.height, self.axes = speed, turning, height, axes
        order, noises = (0, 0) if height is None else axis_sizes(height)
        self.state_dim = 3 + turning.num_variables + order
        self.noise_dim = 2 + noises

    @property
    def layout(self) -> Hashable | None:
        return "speed and direction", self.axes, self.turning.num_variables, self.state_dim

    def forward(self, state: Tensor, dt: float | Tensor) -> Pushforward:
        check_event(state, (self.state_dim,), "state")
        step = self.transition(dt)
        batch = state.shape[:-1] if isinstance(dt, float | int) else torch.broadcast_shapes(state.shape[:-1], dt.shape)
        return Pushforward(lambda noise: step(state, noise), self.noise_dim, batch, self.state_dim, like=state)

    def transition(self, dt: float | Tensor) -> Transition:
        decay, std = self.speed(dt)
        time, turn = seconds(dt, std), self.turning.turn(dt)
        rise = None if self.height is None else self.height(dt)
        first, last = self.axes + 1, self.axes + 1 + self.turning.num_variables

        def step(state: Tensor, noise: Tensor) -> Tensor:
            check_event(state, (self.state_dim,), "state")
            check_event(noise, (self.noise_dim,), "noise")
            # variables first, as clouds lie in memory: everything here runs along rows
            rows, numbers = state.movedim(-1, 0).unbind(0), noise.movedim(-1, 0)
            speed = torch.addcmul(decay * rows[self.axes], std, numbers[0])
            turned = turn(list(rows[first:last]), speed, numbers[1])
            way = time * speed
            x, y = torch.addcmul(rows[0], way, turned[0].cos()), torch.addcmul(rows[1], way, turned[0].sin())
            moved = [x, y, speed, *turned]
            if rise is not None:
                matrix, gain = rise
                vertical = torch.stack([rows[2], *rows[last:]], -1)
                height, *rates = (_times(matrix, vertical) + _times(gain, numbers[2:].movedim(0, -1))).unbind(-1)
                moved = [x, y, height, speed, *turned, *rates]
            return torch.stack(moved).movedim(0, -1)

        return step

    def kinematics(self, state: Tensor) -> Kinematics:
        check_event(state, (self.state_dim,), "state")
        speed, phi = state[..., self.axes], state[..., self.axes + 1]
        velocity = [speed * phi.cos(), speed * phi.sin()]
        if self.axes == 3:
            velocity.append(state[..., self.axes + 1 + self.turning.num_variables])
        return Kinematics(state.narrow(-1, 0, self.axes), torch.stack(velocity).movedim(0, -1))

    def from_kinematics(self, kinematics: Kinematics) -> Tensor:
        """Return the state (..., D) with that position and velocity; acceleration and higher derivatives are zero.

        The direction of a talker who stands is the modelled heading if there is one, or else phi = 0.
        """
        position, velocity = kinematics.position, kinematics.velocity
        check_event(position, (self.axes,), "position")
        check_event(velocity, (self.axes,), "velocity")
        known = [
            *position.unbind(-1),
            _speed(velocity),
            direction(velocity, standing=kinematics.modelled_heading),
            *[torch.zeros_like(velocity[..., 0])] * (self.turning.num_variables - 1),
            *velocity[..., 2:].unbind(-1),
        ]
        missing = self.state_dim - len(known)
        return torch.nn.functional.pad(torch.stack(known).movedim(0, -1), (0, missing))

    def extra_repr(self) -> str:
        return f"axes={self.axes}"


def _speed(velocity: Tensor) -> Tensor:
    """Return the speed (...) in the plane; the floor below every normal number keeps its gradient finite at rest."""
    x, y = velocity[..., 0], velocity[..., 1]
    return torch.addcmul(x * x, y, y).clamp_min(torch.finfo(x.dtype).tiny).sqrt()


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return `matrix` (..., I, J) times `vector` (..., J), batches broadcast."""
    return (matrix @ vector[..., None])[..., 0]
