"""How far a track is from the truth: the figures of S1, and azimuth."""

import math

import torch
from torch import Tensor

from probtrack._checks import as_positive
from probtrack.errors import InputError


def position_error(estimate: Tensor, truth: Tensor) -> Tensor:
    r"""Return :math:`\varepsilon_k = \lVert \ell_k - \hat\ell_k \rVert` (...) [m] of positions (..., A) (S1 eq. 6)."""
    error: Tensor = torch.linalg.vector_norm(estimate - truth, dim=-1)
    return error


def root_mean_square(error: Tensor) -> Tensor:
    r"""Return :math:`\sqrt{\frac1K \sum_k \varepsilon_k^2}` over the first axis of `error` (K, ...) (S1 eq. 7).

    Frames of NaN do not count; NaN where there is no other.
    """
    return error.square().nanmean(0).sqrt()


def final_error(error: Tensor, dt: float, *, window: float = 0.5) -> Tensor:
    r"""Return the mean (...) [m] of `error` (K, ...) of the last :math:`k^* = \lceil 0.5\,\mathrm s / T \rceil` frames.

    Frames of NaN do not count: the last k* others do; NaN where there are fewer.

    Args:
        error: Position errors [m], time first.
        dt: Time between frames T [s].
        window: Length of the end that counts [s].

    References:
        S1 eq. (8), left side, which sums k* + 1 terms and divides by k* - 1: here the mean of k* frames.
    """
    frames = frames_within(window, dt)
    if len(error) < frames:
        raise InputError(f"track loss looks at the last {frames} frames ({window:g} s), got {len(error)}")
    known = ~error.isnan()
    after = known.flip(0).cumsum(0).flip(0)  # how many frames from here on are known
    total = error.where(known & (after <= frames), 0.0).sum(0)
    return (total / frames).where(after[0] >= frames, torch.nan)


def frames_within(window: float, dt: float) -> int:
    r"""Return :math:`\lceil w / T \rceil`, how many frames of `dt` [s] it takes to fill `window` [s].

    >>> frames_within(0.5, 0.1), frames_within(0.5, 0.016)
    (5, 32)
    """
    as_positive(dt, "dt")
    as_positive(window, "window")
    # a hair less, so that 0.5 s of frames of 0.1 s are 5 and not 6 by rounding
    return math.ceil(window / dt * (1 - 1e-9))


def track_lost(error: Tensor, dt: float, *, threshold: float = 0.1, window: float = 0.5) -> Tensor:
    r"""Return :math:`\zeta = [\text{final error} > \delta]` (...) bool: whether the track is lost at the end.

    Its mean over runs, in per cent, is the track loss percentage (TLP). A run without a final error is not lost.

    Args:
        error: Position errors (K, ...) [m], time first.
        dt: Time between frames T [s].
        threshold: delta [m].
        window: Length of the end that counts [s].

    References:
        S1 eq. (8), read as in `final_error`.
    """
    return final_error(error, dt, window=window) > threshold


def azimuth_error(estimate: Tensor, truth: Tensor) -> Tensor:
    """Return the angle between azimuths (...), the short way round, in [0, pi] [rad]."""
    difference = estimate - truth
    return torch.atan2(difference.sin(), difference.cos()).abs()  # NaN where either is
