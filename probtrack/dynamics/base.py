"""Interface of a motion model, and what the rest of the filter may know of a talker's motion."""

import abc
import itertools
from collections.abc import Callable, Hashable, Iterable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import Distribution, Independent, MultivariateNormal, Normal

from probtrack.distributions import LinearGaussian, Pushforward
from probtrack.errors import InputError

_STANDING = 1e-6  # m/s

Transition = Callable[[Tensor, Tensor], Tensor]
"""One step of a motion model, `(state (..., D), noise (..., noise_dim)) -> state (..., D)`."""


Move = Callable[[Tensor, Tensor], tuple[Tensor, Tensor | None]]
"""One step into a frame, `(state, noise) -> (state, log_weight (...))`: the weight corrects for a step drawn from
another law than the model's, None if it was drawn from the model's own."""


class Kinematics(NamedTuple):
    """What a likelihood may know of a talker, whatever the layout of the state.

    Attributes:
        position: (..., A) [m], A = 2 or 3.
        velocity: (..., A) [m/s].
        modelled_heading: (...) [rad], where the talker looks, if the motion model has such a variable.
    """

    position: Tensor
    velocity: Tensor
    modelled_heading: Tensor | None = None

    @property
    def heading(self) -> Tensor:
        """Where the talker looks (...) [rad]: the direction of motion unless the model knows better."""
        if self.modelled_heading is not None:
            return self.modelled_heading
        return direction(self.velocity)


class Dynamics(nn.Module, abc.ABC):
    """Markov transition density p(x_t | x_{t-1}), with learnable, unconstrained parameters.

    A model of one's own needs `forward`, `kinematics` and `from_kinematics`; a filter drives it by
    `transition`, which works for every law that a standard normal vector can be mapped to.
    """

    state_dim: int
    """Size D of the state."""

    noise_dim: int
    """How many standard normal numbers drive one step of one particle."""

    axes: int
    """Number of spatial axes A of its kinematics."""

    @abc.abstractmethod
    def forward(self, state: Tensor, dt: float | Tensor) -> Distribution:
        """Return p(x_t | x_{t-1} = `state`) over `dt` [s]: batch (...), event (state_dim,)."""

    @abc.abstractmethod
    def kinematics(self, state: Tensor) -> Kinematics:
        """Return position, velocity and heading of `state` (..., D)."""

    @abc.abstractmethod
    def from_kinematics(self, kinematics: Kinematics) -> Tensor:
        """Return the state (..., D) of a talker that moves like `kinematics`."""

    def transition(self, dt: float | Tensor) -> Transition:
        """Return the map from (state, standard normal noise) to the next state over `dt` [s].

        What does not depend on the state is worked out here, once for many steps.
        """

        def step(state: Tensor, noise: Tensor) -> Tensor:
            return driven_by(self(state, dt), noise)

        return step

    def moves(self, observations: Any, dt: float | Tensor) -> Iterable[Move]:  # noqa: ARG002
        """Return the step into each frame of `observations` (T, *batch, ...), at least T of them.

        What a filter runs on. A model that listens to the observations, as switching on speech activity does,
        or draws from another law than its own, overrides this; all others take the same step into every frame.
        """
        transition = self.transition(dt)
        return itertools.repeat(lambda state, noise: (transition(state, noise), None))

    @property
    def layout(self) -> Hashable | None:
        """What the numbers of a state mean: models that switch and have equal layouts exchange states as they are.

        A model with a layout takes any finite numbers for a state. None, the default, is a layout of its own.
        """
        return None

    def mode(self, state: Tensor) -> Tensor | None:  # noqa: ARG002
        """Return which of S models moves each particle, ones and zeros (..., S); None if there is but one."""
        return None


def direction(vector: Tensor, *, standing: Tensor | None = None) -> Tensor:
    """Return the angle of `vector` (..., 2 or 3) in the plane [rad].

    Below a micrometre a second, where the gradient would be a million times that of a walk and overflow in the end,
    the angle is a constant.

    Args:
        vector: Velocities [m/s].
        standing: Angle of no vector at all (...) [rad], 0 by default.
    """
    x, y = vector[..., 0], vector[..., 1]
    still = torch.maximum(x.abs(), y.abs()) < _STANDING
    angle = torch.atan2(torch.where(still, y.detach(), y), torch.where(still, x.detach(), x))
    none = (x == 0) & (y == 0)  # atan2 would tell zeros by their signs
    return torch.where(none, torch.zeros_like(angle) if standing is None else standing, angle)


def checked_axes(model: Dynamics) -> int:
    """Return the number of axes of `model`, or raise `InputError` if its class does not say it."""
    axes = getattr(model, "axes", None)
    if not isinstance(axes, int):
        raise InputError(f"{type(model).__name__} must say its number of spatial `axes` to be joined with other models")
    return axes


def driven_by(law: Distribution, noise: Tensor) -> Tensor:
    """Return the sample of `law` that the standard normal `noise` (..., K) stands for.

    Raises:
        InputError: for a law that is not Gaussian; its model must define `transition` itself.
    """
    if isinstance(law, LinearGaussian | Pushforward):
        return law.at_noise(noise)
    if isinstance(law, MultivariateNormal):
        return law.loc + (law.scale_tril @ noise[..., None])[..., 0]
    if isinstance(law, Independent) and isinstance(law.base_dist, Normal):
        return law.base_dist.loc + law.base_dist.scale * noise
    raise InputError(f"a Dynamics whose forward returns {type(law).__name__} must define transition itself")
