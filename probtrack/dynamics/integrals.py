r"""Closed-form integrals of decaying motion, accurate from no decay at all to a decay within the step.

With x = beta T, a coordinate answers a unit change of its derivative j by

.. math:: \phi_0(x) = e^{-x}, \qquad \phi_1(x) = (1 - e^{-x}) / x, \qquad \phi_2(x) = (x - 1 + e^{-x}) / x^2

and white noise in that derivative by the covariances

.. math:: C_{ij}(x) = \int_0^1 s^{i+j} \phi_i(xs) \phi_j(xs)\,ds .

Each is x^-d times a sum of c x^k e^{-mx} whose singularity at 0 is removable; a table of these sums gives both
the closed form, used for x >= 1, and the power series, used below, where the closed form would cancel.
"""

import math
from fractions import Fraction
from typing import NamedTuple

import torch
from torch import Tensor

from probtrack.errors import InputError

_TERMS = 30  # of the power series: 2^30 / 30! is far below a rounding error
_POLYNOMIAL, _DECAYS = 4, 3  # powers k = 0 to 3 and decays m = 0 to 2


class _Sum(NamedTuple):
    """x^-divide times the sum of c x^k e^{-mx} over `terms` (k, m) -> c."""

    divide: int
    terms: dict[tuple[int, int], Fraction]


def _half(divide: int, terms: dict[tuple[int, int], float]) -> _Sum:
    return _Sum(divide, {key: Fraction(c).limit_denominator(10) / 2 for key, c in terms.items()})


_PHI = (
    _half(0, {(0, 1): 2}),
    _half(1, {(0, 0): 2, (0, 1): -2}),
    _half(2, {(1, 0): 2, (0, 0): -2, (0, 1): 2}),
)
_COVARIANCE = {
    (0, 0): _half(1, {(0, 0): 1, (0, 2): -1}),
    (0, 1): _half(2, {(0, 0): 1, (0, 1): -2, (0, 2): 1}),
    (1, 1): _half(3, {(1, 0): 2, (0, 0): -3, (0, 1): 4, (0, 2): -1}),
    (0, 2): _half(3, {(0, 0): 1, (1, 1): -2, (0, 2): -1}),
    (1, 2): _half(4, {(2, 0): 1, (1, 0): -2, (0, 0): 1, (1, 1): 2, (0, 1): -2, (0, 2): 1}),
    (2, 2): _half(5, {(3, 0): 2 / 3, (2, 0): -2, (1, 0): 2, (0, 0): 1, (1, 1): -4, (0, 2): -1}),
}


class _Table(NamedTuple):
    """Coefficients of some sums, float64.

    Attributes:
        divide: d of each (S,).
        series: Coefficients of x^n (_TERMS, S).
        weights: c of x^k e^{-mx} (_POLYNOMIAL, _DECAYS, S).
    """

    divide: Tensor
    series: Tensor
    weights: Tensor


def _table(sums: list[_Sum]) -> _Table:
    series = [[_coefficient(s, n + s.divide) for s in sums] for n in range(_TERMS)]
    weights = [[[float(s.terms.get((k, m), 0)) for s in sums] for m in range(_DECAYS)] for k in range(_POLYNOMIAL)]
    return _Table(*(torch.tensor(x, dtype=torch.float64) for x in ([s.divide for s in sums], series, weights)))


def _coefficient(of: _Sum, n: int) -> float:
    """Return the coefficient of x^n in the sum before it is divided, in exact fractions until the end."""
    terms = ((c, k, m) for (k, m), c in of.terms.items() if n >= k)
    return float(sum(c * Fraction((-m) ** (n - k), math.factorial(n - k)) for c, k, m in terms))


def _square(order: int) -> list[_Sum]:
    orders = range(order - 1, -1, -1)
    return [_COVARIANCE[min(i, j), max(i, j)] for i in orders for j in orders]


_MEANS = {order: _table(list(reversed(_PHI[:order]))) for order in (2, 3)}
_COVARIANCES = {order: _table(_square(order)) for order in (2, 3)}


def means(elapsed: Tensor, order: int) -> Tensor:
    """Return (phi_{K-1}, ..., phi_0) (..., K) of `elapsed` x = beta T (...), K = `order`, in float64."""
    return _values(elapsed, _MEANS[_checked(order)])


def covariances(elapsed: Tensor, order: int) -> Tensor:
    """Return C_ij (..., K, K) of `elapsed` x (...), the position i = K - 1 first, in float64."""
    return _values(elapsed, _COVARIANCES[_checked(order)]).reshape(*elapsed.shape, order, order)


def _values(x: Tensor, table: _Table) -> Tensor:
    """Return the value (..., S) of each sum of `table` at `x` (...) >= 0."""
    x = x.double()[..., None]
    divide, series, weights = (tensor.to(x.device) for tensor in table)
    small = x < 1
    # each branch sees only arguments it can take: 0 / 0 would reach the gradient through `where`
    near, far = torch.where(small, x, 0.0), torch.where(small, 1.0, x)
    inside = near ** torch.arange(_TERMS, dtype=x.dtype, device=x.device) @ series
    decays = torch.exp(-far * torch.arange(_DECAYS, dtype=x.dtype, device=x.device))
    closed = sum((far**k * (decays @ weights[k]) for k in range(1, _POLYNOMIAL)), decays @ weights[0])
    return torch.where(small, inside, closed * far**-divide)


def _checked(order: int) -> int:
    if order not in _MEANS:
        raise InputError(f"order must be 2 (position, velocity) or 3 (and acceleration), got {order}")
    return order
