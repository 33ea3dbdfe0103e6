"""What one coordinate of a talker does between two frames, when the other coordinates play no part."""

import abc
import math

import torch
from torch import Tensor, nn

from probtrack._checks import as_positive


class AxisModel(nn.Module, abc.ABC):
    """Linear motion of one coordinate, driven by one standard normal number a step.

    The state of the coordinate is its position and K - 1 derivatives, s' = matrix s + gain u.
    """

    order: int
    """How many variables K describe the coordinate: 2 for position and velocity."""

    @abc.abstractmethod
    def forward(self, dt: float | Tensor) -> tuple[Tensor, Tensor]:
        """Return the matrix (..., K, K) and the gain (..., K) of a step of `dt` (...) [s]."""


class RandomWalkVelocity(AxisModel):
    r"""Velocity that is a random walk, "nearly constant velocity" (CU-RWVE):

    .. math:: x' = x + T \dot x + \tfrac{T}{2} q\sqrt{T}\,u, \qquad \dot x' = \dot x + q\sqrt{T}\,u .

    Args:
        diffusion: Initial q, the standard deviation of the velocity after one second [m/s per sqrt(s)].

    Shape:
        dt: float or (...) [s]. Returns (..., 2, 2) and (..., 2).

    References:
        E. A. Lehmann, A. M. Johansson, "Dynamics models for acoustic speaker tracking: preliminary results",
        report PRJ-NICTA-PM-023, 2007, Eq. 17. There sigma_v is per step and T is not in it; here
        sigma_v = q sqrt(T), so that the frame rate may change.

    >>> matrix, gain = RandomWalkVelocity(diffusion=2.0)(0.25)
    >>> matrix.tolist(), [round(x, 3) for x in gain.tolist()]
    ([[1.0, 0.25], [0.0, 1.0]], [0.125, 1.0])
    """

    order = 2

    def __init__(self, *, diffusion: float) -> None:
        super().__init__()
        self.log_diffusion = nn.Parameter(as_positive(diffusion, "diffusion").log())

    def forward(self, dt: float | Tensor) -> tuple[Tensor, Tensor]:
        step = _seconds(dt, self.log_diffusion)
        one = torch.ones_like(step)
        sigma = self.log_diffusion.exp() * step.sqrt()
        return _square(one, step, 0 * one, one), torch.stack([step / 2 * sigma, sigma], -1)

    def extra_repr(self) -> str:
        return f"diffusion={self.log_diffusion.exp().item():.3g} m/s per sqrt(s)"


class TimeCorrelatedVelocity(AxisModel):
    r"""Velocity that forgets itself at a rate beta and has a stationary spread (CU-TCVE):

    .. math::
        x' = x + \frac{1 - e^{-\beta T}}{\beta} \dot x + T w, \qquad \dot x' = e^{-\beta T} \dot x + w,
        \qquad w = \sigma_v \sqrt{1 - e^{-2\beta T}}\,u .

    Args:
        rate: Initial beta [1/s]; 1/beta is how long a manoeuvre lasts.
        speed: Initial sigma_v, the stationary standard deviation of the velocity [m/s].

    Shape:
        dt: float or (...) [s]. Returns (..., 2, 2) and (..., 2).

    References:
        E. A. Lehmann, A. M. Johansson, "Dynamics models for acoustic speaker tracking: preliminary results",
        report PRJ-NICTA-PM-023, 2007, Eq. 18, as printed: one noise enters position and velocity, so that
        the step has no density (see `LinearGaussian`).

    >>> matrix, gain = TimeCorrelatedVelocity(rate=2.0, speed=0.7)(0.5)
    >>> [round(x, 4) for x in (*matrix.flatten().tolist(), *gain.tolist())]
    [1.0, 0.3161, 0.0, 0.3679, 0.3255, 0.6509]
    """

    order = 2

    def __init__(self, *, rate: float, speed: float) -> None:
        super().__init__()
        self.log_rate = nn.Parameter(as_positive(rate, "rate").log())
        self.log_speed = nn.Parameter(as_positive(speed, "speed").log())

    def forward(self, dt: float | Tensor) -> tuple[Tensor, Tensor]:
        step = _seconds(dt, self.log_rate)
        elapsed = self.log_rate.exp() * step
        return _velocity_step(self.log_speed, step, elapsed, drift=step * _mean_decay(elapsed))

    def extra_repr(self) -> str:
        return f"rate={self.log_rate.exp().item():.3g}/s, speed={self.log_speed.exp().item():.3g} m/s"


class Langevin(AxisModel):
    r"""Time-correlated velocity whose new value moves the position, an Euler step (CU-LAN):

    .. math:: x' = x + T \dot x', \qquad \dot x' = e^{-\beta T} \dot x + \sigma_v\sqrt{1 - e^{-2\beta T}}\,u .

    Args:
        rate: Initial beta [1/s]; 1/beta is how long a manoeuvre lasts.
        speed: Initial sigma_v, the stationary standard deviation of the velocity [m/s].

    Shape:
        dt: float or (...) [s]. Returns (..., 2, 2) and (..., 2).

    References:
        E. A. Lehmann, A. M. Johansson, "Dynamics models for acoustic speaker tracking: preliminary results",
        report PRJ-NICTA-PM-023, 2007, Eq. 21, as printed: one noise enters position and velocity, so that
        the step has no density (see `LinearGaussian`).
        J. Vermaak, A. Blake, "Nonlinear filtering for speaker tracking in noisy and reverberant
        environments", ICASSP 2001, where the model comes from.

    >>> matrix, gain = Langevin(rate=2.0, speed=0.7)(0.5)
    >>> [round(x, 4) for x in (*matrix.flatten().tolist(), *gain.tolist())]
    [1.0, 0.1839, 0.0, 0.3679, 0.3255, 0.6509]
    """

    order = 2

    def __init__(self, *, rate: float, speed: float) -> None:
        super().__init__()
        self.log_rate = nn.Parameter(as_positive(rate, "rate").log())
        self.log_speed = nn.Parameter(as_positive(speed, "speed").log())

    def forward(self, dt: float | Tensor) -> tuple[Tensor, Tensor]:
        step = _seconds(dt, self.log_rate)
        elapsed = self.log_rate.exp() * step
        return _velocity_step(self.log_speed, step, elapsed, drift=step * torch.exp(-elapsed))

    def extra_repr(self) -> str:
        return f"rate={self.log_rate.exp().item():.3g}/s, speed={self.log_speed.exp().item():.3g} m/s"


def _velocity_step(log_speed: Tensor, step: Tensor, elapsed: Tensor, *, drift: Tensor) -> tuple[Tensor, Tensor]:
    """Return matrix and gain of a time-correlated velocity, `elapsed` = beta T, that moves by `drift` [s]."""
    one = torch.ones_like(elapsed)
    renewed = -torch.expm1(-2 * elapsed)  # 1 - e^{-2 beta T} without cancellation
    # The floor is below every normal number: it keeps the gradient of the square root finite at 0.
    sigma = log_speed.exp() * renewed.clamp_min(torch.finfo(renewed.dtype).tiny).sqrt()
    return _square(one, drift, 0 * one, torch.exp(-elapsed)), torch.stack([step * sigma, sigma], -1)


def _mean_decay(x: Tensor) -> Tensor:
    """Return (1 - e^-x) / x, the mean of e^-s over 0 < s < x; its Taylor series where x is tiny."""
    tiny = x < 1e-3
    # Each branch sees only arguments it can take: 0 / 0 or inf - inf would reach the gradient through `where`.
    near, far = torch.where(tiny, x, torch.zeros_like(x)), torch.where(tiny, torch.ones_like(x), x)
    series = 1 - near / 2 * (1 - near / 3 * (1 - near / 4))  # error x^4 / 120
    return torch.where(tiny, series, -torch.expm1(-far) / far)


def _square(*entries: Tensor) -> Tensor:
    """Return the matrix (..., K, K) of K^2 `entries` (...), row by row."""
    order = math.isqrt(len(entries))
    rows = torch.stack(torch.broadcast_tensors(*entries), -1)
    return rows.reshape(*rows.shape[:-1], order, order)


def _seconds(dt: float | Tensor, parameter: Tensor) -> Tensor:
    """Return `dt` as a tensor like `parameter`, or raise `InputError` unless it is finite and > 0."""
    as_positive(dt, "dt")
    return torch.as_tensor(dt, dtype=parameter.dtype, device=parameter.device)
