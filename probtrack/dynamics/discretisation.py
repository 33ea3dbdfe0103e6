"""From continuous motion to steps: how a scalar process moves a coordinate that integrates it."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from probtrack.dynamics.integrals import covariances, means
from probtrack.dynamics.processes import ScalarProcess, seconds
from probtrack.errors import NotFiniteError

Discretisation = Callable[[ScalarProcess, int, float | Tensor], tuple[Tensor, Tensor]]
"""`(process, order K, dt (...)) -> (matrix (..., K, K), gain (..., K, J))` of a coordinate whose derivative K - 1
is the process: the step s' = matrix s + gain u of (position, velocity, ...)."""


def exact(process: ScalarProcess, order: int, dt: float | Tensor) -> tuple[Tensor, Tensor]:
    r"""Return the step whose samples are those of the stochastic differential equation itself:

    .. math:: F = e^{AT}, \qquad G G^\top = \int_0^T e^{As} L L^\top e^{A^\top s}\,ds .

    G is lower triangular (K noise numbers a step) and of full rank where the process has noise: the step has
    a density, and two steps of T/2 are one of T.

    Args:
        process: Derivative K - 1 of the coordinate, a random walk or a time-correlated process.
        order: K, 2 or 3.
        dt: Time step T (...) [s].

    Raises:
        InputError: for white noise, or another order.

    References:
        C. F. Van Loan, IEEE Trans. Automatic Control 23(3):395-404, 1978: the integral. R. A. Singer, IEEE
        Trans. Aerospace and Electronic Systems 6(4):473-483, 1970: its closed form for K = 3.
    """
    rate, intensity = process.diffusion()
    step = seconds(dt, rate)
    # float64: the variance of the position is of the order of T^3 or T^5, and closed forms cancel
    elapsed = rate.double() * step.double()
    if not elapsed.detach().isfinite().all():
        raise NotFiniteError(
            "the rate of a process is NaN or infinite: a fit has diverged, or a parameter is not finite"
        )
    powers = _powers(step.double(), order)
    root = torch.linalg.cholesky(covariances(elapsed, order))
    gain = (intensity.double() * step.double().sqrt())[..., None, None] * powers[..., :, None] * root
    return _drift(process, order, dt), gain.to(step.dtype)


def single_noise(process: ScalarProcess, order: int, dt: float | Tensor) -> tuple[Tensor, Tensor]:
    r"""Return the step as S1 prints it: the exact mean, and one noise for the coordinate with all derivatives.

    .. math:: g = (T^{K-1} / (K-1)!,\; \dots,\; T,\; 1)^\top \sigma

    or, for a random walk, whose change is spread evenly over the step, (T/2, 1) in place of (T, 1). The step
    has no density; its position noise is right to first order in T only, so that a fit at one frame rate serves
    others as long as beta T is small.

    Args:
        process: Derivative K - 1 of the coordinate.
        order: K, 2 or 3.
        dt: Time step T (...) [s].

    References:
        S1 eq. 17, 18 and 20; eq. 20 with Singer's sign, (beta T - 1 + e^{-beta T}) / beta^2.
    """
    std = process(dt).std
    powers = _powers(seconds(dt, std), order)
    lead = [1 / math.factorial(order - i if process.ramps else order - 1 - i) for i in range(order)]
    vector = powers * torch.tensor(lead).to(powers)
    return _drift(process, order, dt), (vector * std[..., None])[..., None]


def euler(process: ScalarProcess, order: int, dt: float | Tensor) -> tuple[Tensor, Tensor]:
    r"""Return the Euler step, in which every derivative moves the one below it by its new value:

    .. math:: \dot x' = e^{-\beta T}\dot x + \sigma\sqrt{1 - e^{-2\beta T}}\,u, \qquad x' = x + T \dot x' .

    One noise drives the coordinate with all derivatives, so that the step has no density.

    Args:
        process: Derivative K - 1 of the coordinate.
        order: K, 2 or 3.
        dt: Time step T (...) [s].

    References:
        S1 eq. 21; S3 eq. A.2 to A.5; J. Vermaak, A. Blake, "Nonlinear filtering for speaker tracking in noisy
        and reverberant environments", ICASSP 2001, eq. 1.
    """
    decay, std = process(dt)
    step = seconds(dt, std)
    matrix = _chain(step, order, last=decay[..., None].expand(*decay.shape, order))
    return matrix, (_powers(step, order) * std[..., None])[..., None]


def _drift(process: ScalarProcess, order: int, dt: float | Tensor) -> Tensor:
    """Return e^{AT} (..., K, K) of a coordinate whose last derivative decays."""
    rate = process.diffusion().rate
    step = seconds(dt, rate)
    return _chain(step, order, last=means(rate.double() * step.double(), order).to(step))


def _chain(step: Tensor, order: int, *, last: Tensor) -> Tensor:
    """Return the upper triangular matrix of T^(j - i), j > i, with its last column times `last` (..., K).

    The columns but the last are Taylor's: up to order 3 no factorial but 1 stands in them.
    """
    exponents = (torch.arange(order)[None, :] - torch.arange(order)[:, None]).to(step)
    powers = torch.where(exponents >= 0, step[..., None, None] ** exponents.clamp_min(0), torch.zeros(()).to(step))
    return torch.cat([powers[..., :-1], (powers[..., -1] * last)[..., None]], -1)


def _powers(step: Tensor, order: int) -> Tensor:
    """Return (T^(K-1), ..., T, 1), shape (..., K)."""
    return step[..., None] ** torch.arange(order - 1, -1, -1).to(step)
