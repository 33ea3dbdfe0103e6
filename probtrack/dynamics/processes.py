"""How one variable of a talker's motion changes by itself: the scalar processes all of S1's models are made of."""

import abc
from typing import NamedTuple

import torch
from torch import Tensor, nn

from probtrack._checks import as_non_negative, as_positive
from probtrack.errors import InputError


class ProcessStep(NamedTuple):
    """A step of a scalar Gauss-Markov process, value' = decay value + std u with u ~ N(0, 1).

    Attributes:
        decay: (...), what is left of the old value.
        std: (...), in the unit of the value.
    """

    decay: Tensor
    std: Tensor


class Diffusion(NamedTuple):
    """The same process in continuous time, d value = -rate value dt + intensity dW.

    Attributes:
        rate: () [1/s].
        intensity: () [unit of the value per sqrt(s)].
    """

    rate: Tensor
    intensity: Tensor


class ScalarProcess(nn.Module, abc.ABC):
    """Gauss-Markov process of one variable xi: a velocity, a speed, an angle, an acceleration.

    Parameters are rates per second, so that one fit serves every frame rate.
    """

    unbounded: bool
    """Whether the value wanders off for ever: an angle may then be wrapped without changing its law."""

    ramps: bool
    """Whether S1 spreads a change evenly over the step (eq. 17) or lets it come at its start (eq. 18, 20)."""

    @abc.abstractmethod
    def forward(self, dt: float | Tensor) -> ProcessStep:
        """Return decay and noise of a step of `dt` (...) [s]."""

    @abc.abstractmethod
    def diffusion(self) -> Diffusion:
        """Return the stochastic differential equation that the steps are exact samples of.

        Raises:
            InputError: for a process that has none.
        """


class RandomWalk(ScalarProcess):
    r"""A value that wanders without ever coming back (RW of S1):

    .. math:: \xi' = \xi + q\sqrt{T}\,u, \qquad d\xi = q\,dW .

    Args:
        diffusion: Initial q, the standard deviation of the value after one second, at least 0 [unit per
            sqrt(s)]; learnable as `log_diffusion`. A value of 0 is a constant and stays 0 in learning.

    Shape:
        dt: float or (...) [s]. Returns (...).

    References:
        S1 eq. 9, where sigma is per step: sigma = q sqrt(T).

    >>> RandomWalk(diffusion=2.0)(0.25).std.item()
    1.0
    """

    unbounded, ramps = True, True

    def __init__(self, diffusion: float) -> None:
        super().__init__()
        self.log_diffusion = _log(diffusion, "diffusion")

    def forward(self, dt: float | Tensor) -> ProcessStep:
        step = seconds(dt, self.log_diffusion)
        return ProcessStep(torch.ones_like(step), self.log_diffusion.exp() * step.sqrt())

    def diffusion(self) -> Diffusion:
        return Diffusion(torch.zeros_like(self.log_diffusion), self.log_diffusion.exp())

    def extra_repr(self) -> str:
        return f"diffusion={self.log_diffusion.exp().item():.3g}"


class TimeCorrelated(ScalarProcess):
    r"""A value that forgets itself at a rate beta and has a stationary spread (TC of S1), Ornstein and Uhlenbeck's:

    .. math::
        \xi' = e^{-\beta T}\xi + \sigma\sqrt{1 - e^{-2\beta T}}\,u, \qquad
        d\xi = -\beta\xi\,dt + \sigma\sqrt{2\beta}\,dW, \qquad R_\xi(\tau) = \sigma^2 e^{-\beta|\tau|} .

    Args:
        rate: Initial beta, at least 0 [1/s]; learnable as `log_rate`. 1/beta is how long a manoeuvre lasts.
            At 0 the value never changes, and the rate stays 0 in learning.
        std: Initial sigma, the stationary standard deviation, at least 0 [unit of the value]; learnable as
            `log_std`. At 0 a value decays without noise, and sigma stays 0 in learning.

    Shape:
        dt: float or (...) [s]. Returns (...).

    References:
        S1 eq. 11 and 13.

    >>> step = TimeCorrelated(rate=2.0, std=0.7)(0.5)
    >>> round(step.decay.item(), 4), round(step.std.item(), 4)
    (0.3679, 0.6509)
    """

    unbounded, ramps = False, False

    def __init__(self, rate: float, std: float) -> None:
        super().__init__()
        self.log_rate = _log(rate, "rate")
        self.log_std = _log(std, "std")

    def forward(self, dt: float | Tensor) -> ProcessStep:
        elapsed = self.log_rate.exp() * seconds(dt, self.log_rate)
        renewed = -torch.expm1(-2 * elapsed)  # 1 - e^{-2 beta T} without cancellation
        return ProcessStep(torch.exp(-elapsed), self.log_std.exp() * _root(renewed))

    def diffusion(self) -> Diffusion:
        rate = self.log_rate.exp()
        return Diffusion(rate, self.log_std.exp() * _root(2 * rate))

    def extra_repr(self) -> str:
        return f"rate={self.log_rate.exp().item():.3g}/s, std={self.log_std.exp().item():.3g}"


class WhiteNoise(ScalarProcess):
    r"""A value that is new in every step (RA of S1), held for its length:

    .. math:: \xi' = \frac{s}{\sqrt T}\,u .

    The integral of the value over a second has standard deviation s at every frame rate: what the value
    drives moves alike however often it is redrawn.

    Args:
        intensity: Initial s, at least 0 [unit times sqrt(s)]; learnable as `log_intensity`. 0 stays 0.

    Shape:
        dt: float or (...) [s]. Returns (...).

    References:
        S1 eq. 29, second row, where sigma is per step: sigma = s / sqrt(T).

    >>> WhiteNoise(intensity=0.5)(0.25).std.item()
    1.0
    """

    unbounded, ramps = False, False

    def __init__(self, intensity: float) -> None:
        super().__init__()
        self.log_intensity = _log(intensity, "intensity")

    def forward(self, dt: float | Tensor) -> ProcessStep:
        step = seconds(dt, self.log_intensity)
        return ProcessStep(torch.zeros_like(step), self.log_intensity.exp() * step.rsqrt())

    def diffusion(self) -> Diffusion:
        raise InputError(
            "WhiteNoise has no value in continuous time: let RandomWalk drive one derivative lower, or take euler steps"
        )

    def extra_repr(self) -> str:
        return f"intensity={self.log_intensity.exp().item():.3g}"


def seconds(dt: float | Tensor, parameter: Tensor) -> Tensor:
    """Return `dt` as a tensor like `parameter`, or raise `InputError` unless it is finite and > 0."""
    as_positive(dt, "dt")
    return torch.as_tensor(dt, dtype=parameter.dtype, device=parameter.device)


def _log(value: float, name: str) -> nn.Parameter:
    """Return the logarithm of `value` as a parameter, or raise `InputError` unless it is one number >= 0."""
    number = as_non_negative(value, name)
    if number.ndim > 0:
        raise InputError(f"{name} must be one number, got shape {tuple(number.shape)}")
    return nn.Parameter(number.log())


def _root(x: Tensor) -> Tensor:
    """Return sqrt(x) of x >= 0, with a gradient of zero, not infinity, where x is zero."""
    zero = x == 0
    return torch.where(zero, x, torch.where(zero, 1.0, x).sqrt())
