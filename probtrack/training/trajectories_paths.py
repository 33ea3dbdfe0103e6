"""Gradients of curvilinear motion by weights: paths of talkers who turn about are chaotic."""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from probtrack.dynamics import Curvilinear, Dynamics, Kinematics, Move, NormalAcceleration, ScalarProcess, TurnAngle
from probtrack.errors import InputError


class FixedPaths(Dynamics):
    r"""Curvilinear motion whose particles are drawn as if parameters were constants, and weighted by the ratio of laws:

    .. math:: w = \frac{p_\theta(v', \xi' \mid v, \xi)}{p_{\bar\theta}(v', \xi' \mid v, \xi)}, \qquad
              \bar\theta = \theta \text{ as a constant} .

    Speed v and what turns the direction, xi (that itself or the normal acceleration), are Gaussian; the rest of the
    state follows from them without a parameter. In value the weights are 1: clouds and evidence are those of the
    motion. Their gradient has the same mean as that along paths, which grows from step to step without bound where a
    talker is slow: a turn T a v / (v^2 + v_0^2) depends on the speed as on its inverse. Resampling must carry gradients
    of weights, as `StopGradient` does.

    Args:
        motion: The model, with two axes.

    References:
        A. Scibior, F. Wood, arXiv 2106.10314, 2021: the gradient of proposals that are taken as fixed.
    """

    def __init__(self, motion: Curvilinear) -> None:
        super().__init__()
        if motion.axes != 2 or not isinstance(motion.turning, TurnAngle | NormalAcceleration):
            raise InputError("motion must be curvilinear with two axes, and turn by TurnAngle or NormalAcceleration")
        self.motion, self.turning = motion, motion.turning
        self.state_dim, self.noise_dim, self.axes = motion.state_dim, motion.noise_dim, motion.axes

    def forward(self, state: Tensor, dt: float | Tensor) -> Distribution:
        law: Distribution = self.motion(state, dt)
        return law

    def kinematics(self, state: Tensor) -> Kinematics:
        return self.motion.kinematics(state)

    def from_kinematics(self, kinematics: Kinematics) -> Tensor:
        return self.motion.from_kinematics(kinematics)

    def moves(self, observations: Any, dt: float | Tensor) -> Iterable[Move]:  # noqa: ARG002
        with torch.no_grad():
            step = self.motion.transition(dt)
        ratios = [_ratio(process, dt) for process in (self.motion.speed, self.turning.process)]
        variables = (self.axes, self.axes + self.turning.num_variables)

        def move(state: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
            state = state.detach()
            first, second = (
                ratio(state[..., variable], noise[..., number])
                for number, (variable, ratio) in enumerate(zip(variables, ratios, strict=True))
            )
            return step(state, noise), first + second

        while True:
            yield move


def _ratio(process: ScalarProcess, dt: float | Tensor) -> Callable[[Tensor, Tensor], Tensor]:
    """Return the log ratio of laws, 0 in value, of the value before and the number that drove it."""
    decay, std = process(dt)
    if not (std > 0).all():  # a value without noise has no law to weigh by
        return lambda _, noise: torch.zeros_like(noise)
    decay_now, std_now = decay.detach(), std.detach()

    def ratio(value: Tensor, noise: Tensor) -> Tensor:
        whitened = (std_now * noise + (decay_now - decay) * value) / std
        log_ratio: Tensor = 0.5 * (noise.square() - whitened.square()) - (std / std_now).log()
        return log_ratio

    return ratio
