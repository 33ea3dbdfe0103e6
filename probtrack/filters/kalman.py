"""Exact filter and smoother of a linear Gaussian system, batched and differentiable."""

import math
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from probtrack._checks import as_positive, check_event
from probtrack.dynamics.base import Kinematics
from probtrack.errors import InputError, NotFiniteError, ShapeError


class LinearSystem(NamedTuple):
    """Linear Gaussian system x_t = F x_{t-1} + G u_t, y_t = H x_t + e_t, with e_t ~ N(0, R).

    Leading dimensions broadcast to (T, *batch): a matrix without them serves all frames and all of the
    batch, one that changes in time is (T, ..., D, D) with as many dimensions between as the batch has.

    Attributes:
        F: Transition into frame t (..., D, D).
        G: How K standard normal numbers enter (..., D, K), any rank.
        H: What is observed of the state (..., J, D).
        R: Covariance of the observation error (..., J, J).
    """

    F: Tensor
    G: Tensor
    H: Tensor
    R: Tensor


class Gaussian(NamedTuple):
    """Normal law of a state.

    Attributes:
        mean: (..., D).
        covariance: (..., D, D), may be singular.
    """

    mean: Tensor
    covariance: Tensor


class KalmanResult(NamedTuple):
    """Filtered beliefs of all frames, and what the smoother wants to know of them.

    Attributes:
        filtered: p(x_t | y_1:t): mean (T, *batch, D), covariance (T, *batch, D, D).
        predicted: p(x_t | y_1:t-1), the same shapes.
        log_evidence: log p(y_1:T) of the observed frames (*batch,).
        increments: log p(y_t | y_1:t-1) (T, *batch), zero where nothing was observed.
        innovation: y_t less its prediction (T, *batch, J), zero where nothing was observed.
        precision: Inverse covariance of the innovation (T, *batch, J, J), zero where nothing was observed.
        gain: Kalman gain (T, *batch, D, J), zero where nothing was observed.
    """

    filtered: Gaussian
    predicted: Gaussian
    log_evidence: Tensor
    increments: Tensor
    innovation: Tensor
    precision: Tensor
    gain: Tensor


@runtime_checkable
class LinearDynamics(Protocol):
    """Motion model whose step is X' = F X + G u with F and G free of the state."""

    state_dim: int

    def matrices(self, dt: float | Tensor) -> tuple[Tensor, Tensor]:
        """Return F (..., D, D) and G (..., D, K) over `dt` (...) [s]."""

    def kinematics(self, state: Tensor) -> Kinematics:
        """Return position and velocity of `state`, linear in it."""


def position_system(dynamics: LinearDynamics, dt: float | Tensor, std: float | Tensor) -> LinearSystem:
    """Return the system in which the position of a talker is observed with independent errors.

    Args:
        dynamics: How the talker moves.
        dt: Time from the frame before [s], one number or any shape that broadcasts to (T, *batch).
        std: Standard deviation of the observation error [m], () or one for each axis (..., A).
    """
    F, G = dynamics.matrices(dt)
    H = dynamics.kinematics(torch.eye(dynamics.state_dim, dtype=F.dtype, device=F.device)).position.mT
    spread = as_positive(std, "std").to(F)
    return LinearSystem(F, G, H, torch.diag_embed(spread.square().expand(*spread.shape[:-1], H.shape[-2])))


def kalman_filter(
    observations: Tensor, system: LinearSystem, initial: Gaussian, *, observed: Tensor | None = None
) -> KalmanResult:
    """Return the exact beliefs and evidence of a linear Gaussian system.

    G G^T is never inverted, so that G may have any rank. Covariances are updated in Joseph's form, which
    keeps them positive semi-definite in float32; they are worked out once for a batch that shares them.

    Args:
        observations: (T, *batch, J); what is not observed may hold anything, NaN too.
        system: Matrices of the motion and of the observation.
        initial: Law of the state one step before the first observation.
        observed: (T, *batch) bool, whether there is an observation; all by default.

    Raises:
        ShapeError: for shapes that do not go together.
        InputError: for an R or initial covariance that is no covariance.
        NotFiniteError: for an observation that is NaN or infinite but not marked as missing.

    References:
        B. D. O. Anderson, J. B. Moore, "Optimal Filtering", 1979, chapter 3.
    """
    frames, batch = observations.shape[0], observations.shape[1:-1]
    _check(observations, system, initial)
    observations, flags = _without_missing(observations, observed)
    F, G, H, R = (_by_frame(matrix, frames, len(batch)) for matrix in system)
    belief, steps = initial, []
    for t in range(frames):
        ahead = _predict(belief, F[t], G[t])
        belief, *update = _update(ahead, observations[t], flags[t], H[t], R[t], frame=t)
        steps.append((*belief, *ahead, *update))
    event_dims = (1, 2, 1, 2, 0, 1, 2, 2)
    mean, covariance, mean_ahead, covariance_ahead, increments, innovation, precision, gain = (
        torch.stack([x.expand(batch + x.shape[x.ndim - dims :]) for x in frames_of])
        for frames_of, dims in zip(zip(*steps, strict=True), event_dims, strict=True)
    )
    return KalmanResult(
        Gaussian(mean, covariance),
        Gaussian(mean_ahead, covariance_ahead),
        increments.sum(0),
        increments,
        innovation,
        precision,
        gain,
    )


def kalman_smoother(result: KalmanResult, system: LinearSystem) -> Gaussian:
    r"""Return p(x_t | y_1:T) of every frame: mean (T, *batch, D), covariance (T, *batch, D, D).

    The modified Bryson-Frazier recursion carries what later frames say of x_t backwards,

    .. math:: x_{t|T} = x_{t|t} - P_{t|t} \hat\lambda_t, \qquad
              P_{t|T} = P_{t|t} - P_{t|t} \hat\Lambda_t P_{t|t} ,

    and inverts no covariance of the state: predicted covariances may be singular.

    Args:
        result: What `kalman_filter` returned.
        system: The system it was given.

    References:
        G. J. Bierman, "Fixed interval smoothing with discrete measurements", International Journal of
        Control 18(1):65-75, 1973.
    """
    frames, batch_dims = result.increments.shape[0], result.increments.ndim - 1
    F, H = _by_frame(system.F, frames, batch_dims), _by_frame(system.H, frames, batch_dims)
    mean, covariance = result.filtered
    score, information = torch.zeros_like(mean[0]), torch.zeros_like(covariance[0])
    smoothed = []
    for t in reversed(range(frames)):
        m, P = mean[t], covariance[t]
        smoothed.append((m - _times(P, score), _symmetric(P - P @ information @ P)))
        kept = torch.eye(m.shape[-1]).to(m) - result.gain[t] @ H[t]
        weighted = H[t].mT @ result.precision[t]
        score = _times(kept.mT, score) - _times(weighted, result.innovation[t])
        information = kept.mT @ information @ kept + weighted @ H[t]
        score, information = _times(F[t].mT, score), F[t].mT @ information @ F[t]
    means, covariances = zip(*reversed(smoothed), strict=True)
    return Gaussian(torch.stack(means), torch.stack(covariances))


def _predict(belief: Gaussian, F: Tensor, G: Tensor) -> Gaussian:
    return Gaussian(_times(F, belief.mean), _symmetric(F @ belief.covariance @ F.mT + G @ G.mT))


def _update(
    ahead: Gaussian, y: Tensor, flag: Tensor | None, H: Tensor, R: Tensor, *, frame: int
) -> tuple[Gaussian, Tensor, Tensor, Tensor, Tensor]:
    """Return the filtered belief, the evidence increment, the innovation, its precision and the gain."""
    mean, P = ahead
    S = _symmetric(H @ P @ H.mT + R)
    root, info = torch.linalg.cholesky_ex(S)
    if info.any():
        raise InputError(f"H P H^T + R must be finite and positive definite, it is not in frame {frame}")
    innovation = y - _times(H, mean)
    gain = torch.cholesky_solve(H @ P, root).mT
    precision = torch.cholesky_inverse(root)
    whitened = torch.linalg.solve_triangular(root, innovation[..., None], upper=False)[..., 0]
    log_volume = root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    increment = -0.5 * (whitened.square().sum(-1) + y.shape[-1] * math.log(2 * math.pi)) - log_volume
    if flag is not None:
        increment, innovation = increment * flag, innovation * flag[..., None]
        precision, gain = precision * flag[..., None, None], gain * flag[..., None, None]
    kept = torch.eye(mean.shape[-1]).to(mean) - gain @ H
    covariance = _symmetric(kept @ P @ kept.mT + gain @ R @ gain.mT)
    return Gaussian(mean + _times(gain, innovation), covariance), increment, innovation, precision, gain


def _without_missing(y: Tensor, observed: Tensor | None) -> tuple[Tensor, list[Tensor] | list[None]]:
    """Return the observations with zeros where there is none, and each frame's flags (*batch), 0 or 1."""
    if observed is None:
        present, flags = torch.ones_like(y[..., 0], dtype=torch.bool), [None] * y.shape[0]
    else:
        if observed.dtype != torch.bool or observed.shape != y.shape[:-1]:
            raise ShapeError(
                f"observed must be bool of shape {tuple(y.shape[:-1])}, got {observed.dtype} of shape "
                f"{tuple(observed.shape)}"
            )
        present, flags = observed, list(observed.to(y))
    bad = present & ~y.isfinite().all(-1)
    if bad.any():
        frame = int(bad.nonzero()[0, 0])
        raise NotFiniteError(
            f"observations must be finite, not so in frame {frame}: mark what is missing by observed = False"
        )
    return torch.where(present[..., None], y, torch.zeros_like(y)), flags


def _check(y: Tensor, system: LinearSystem, initial: Gaussian) -> None:
    """Raise `InputError` unless shapes go together and covariances are some."""
    if y.ndim < 2 or y.shape[0] == 0:
        raise ShapeError(f"observations must have shape (T, *batch, J) with T > 0, got {tuple(y.shape)}")
    dim, seen = system.F.shape[-1], y.shape[-1]
    check_event(system.F, (dim, dim), "F")
    check_event(system.G, (dim, system.G.shape[-1]), "G")
    check_event(system.H, (seen, dim), "H")
    check_event(system.R, (seen, seen), "R")
    check_event(initial.mean, (dim,), "initial mean")
    check_event(initial.covariance, (dim, dim), "initial covariance")
    for name, matrix in [*system._asdict().items(), ("initial covariance", initial.covariance)]:
        target = y.shape[1:-1] if name == "initial covariance" else y.shape[:-1]
        _check_broadcast(matrix.shape[:-2], target, name)
    _check_broadcast(initial.mean.shape[:-1], y.shape[1:-1], "initial mean")
    _check_covariance(system.R, "R")
    _check_covariance(initial.covariance, "initial covariance")


def _check_broadcast(shape: torch.Size, target: torch.Size, name: str) -> None:
    padded = (1,) * (len(target) - len(shape)) + tuple(shape)
    if len(padded) != len(target) or any(n not in (1, m) for n, m in zip(padded, target, strict=True)):
        raise ShapeError(f"leading dimensions of {name} must broadcast to {tuple(target)}, got {tuple(shape)}")


def _check_covariance(matrix: Tensor, name: str) -> None:
    x = matrix.detach()
    slack = 100 * x.shape[-1] * torch.finfo(x.dtype).eps * x.diagonal(dim1=-2, dim2=-1).abs().amax(-1)
    if not x.isfinite().all():
        raise NotFiniteError(f"{name} must be finite")
    if ((x - x.mT).abs().amax((-2, -1)) > slack).any():
        raise InputError(f"{name} must be symmetric")
    if (torch.linalg.eigvalsh(x).amin(-1) < -slack).any():
        raise InputError(f"{name} must be positive semi-definite")


def _by_frame(matrix: Tensor, frames: int, batch_dims: int) -> list[Tensor]:
    """Return each frame's matrix; one that does not change is not copied."""
    if matrix.ndim - 2 <= batch_dims:
        return [matrix] * frames
    return list(matrix.expand(frames, *matrix.shape[1:]))


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector[..., None])[..., 0]


def _symmetric(matrix: Tensor) -> Tensor:
    return 0.5 * (matrix + matrix.mT)
