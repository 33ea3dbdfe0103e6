"""Normal law confined to an interval, accurate however far outside the interval it is centred."""

import math
from functools import cache
from typing import cast

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints
from torch.distributions.utils import broadcast_all
from torch.types import _size

from probtrack.errors import InputError

_NODES = 32
_DROP = 40.0  # exp(-40) of the largest density is nothing, even in float64
_NEWTON_STEPS = 6  # from the starts below, four reach float64


class TruncatedNormal(Distribution):
    r"""Normal law confined to an interval:

    .. math:: p(x) = \frac{\mathcal{N}(x; \mu, \sigma^2)}{\Phi(\frac{h-\mu}{\sigma}) - \Phi(\frac{l-\mu}{\sigma})},
        \qquad l \le x \le h .

    Everything is measured from the mode, the point of the interval nearest to `loc`, so that nothing
    underflows or cancels: `loc` may lie thousands of `scale` outside, and a very large `scale` gives the
    uniform law. Where `loc` is inside, the constant is that of the error function; outside, where its
    differences would cancel, a Gauss-Legendre sum of 32 terms. Samples are differentiable once.

    Args:
        loc: Mean mu of the normal law, inside the interval or not (...).
        scale: Its standard deviation sigma, > 0 (...).
        low: Lower end l of the interval, finite (...).
        high: Upper end h, finite, > low (...).
        validate_args: As in `torch.distributions`; if False, the density outside the interval is 0.

    Shape:
        Batch: that of the arguments, broadcast. Event ().

    References:
        S2, eq. 14: the delay of a peak that is due to the talker, confined to what the distance of two
        microphones admits.

    >>> law = TruncatedNormal(torch.tensor(3.0), torch.tensor(1.0), torch.tensor(-1.0), torch.tensor(1.0))
    >>> round(law.mean.item(), 4), round(law.cdf(torch.tensor(0.5)).item(), 4)
    (0.6294, 0.2719)
    """

    arg_constraints = {  # noqa: RUF012 (torch declares it as a plain attribute)
        "loc": constraints.real,
        "scale": constraints.positive,
        "low": constraints.real,
        "high": constraints.real,
    }
    has_rsample = True

    def __init__(
        self,
        loc: Tensor | float,
        scale: Tensor | float,
        low: Tensor | float,
        high: Tensor | float,
        validate_args: bool | None = None,
    ) -> None:
        self.loc, self.scale, self.low, self.high = broadcast_all(loc, scale, low, high)
        super().__init__(self.loc.shape, validate_args=validate_args)
        if self._validate_args:
            ordered = (self.low < self.high) & self.low.isfinite() & self.high.isfinite()
            if not ordered.all():
                raise InputError(f"low must be less than high and both finite, got low {low} and high {high}")

    @constraints.dependent_property(is_discrete=False, event_dim=0)
    def support(self) -> constraints.Constraint:
        return constraints.interval(self.low, self.high)

    def expand(self, batch_shape: _size, _instance: Distribution | None = None) -> "TruncatedNormal":
        new = cast(TruncatedNormal, self._get_checked_instance(TruncatedNormal, _instance))
        batch = torch.Size(batch_shape)
        for name in self.arg_constraints:
            setattr(new, name, getattr(self, name).expand(batch))
        Distribution.__init__(new, batch, validate_args=False)
        new._validate_args = self._validate_args
        return new

    @property
    def mode(self) -> Tensor:
        return _nearest(self.loc, self.low, self.high)

    @property
    def mean(self) -> Tensor:
        offset, weight = self._rule()
        return self.mode + self.scale * (offset * weight).sum(-1)

    @property
    def variance(self) -> Tensor:
        offset, weight = self._rule()
        centred = offset - (offset * weight).sum(-1, keepdim=True)
        return self.scale.square() * (centred.square() * weight).sum(-1)

    def log_prob(self, value: Tensor) -> Tensor:
        if self._validate_args:
            self._validate_sample(value)
        slope = (self.mode - self.loc) / self.scale
        offset = (value - self.mode) / self.scale
        log_density = -offset * (slope + 0.5 * offset) - (self._mass(self.low, self.high) * self.scale).log()
        return torch.where((value < self.low) | (value > self.high), -math.inf, log_density)

    def cdf(self, value: Tensor) -> Tensor:
        if self._validate_args:
            self._validate_sample(value)
        inside = _nearest(value, self.low, self.high)
        nearest = _nearest(self.loc, self.low, inside)
        slope = (self.mode - self.loc) / self.scale
        offset = (nearest - self.mode) / self.scale
        peak = torch.exp(-offset * (slope + 0.5 * offset))
        return peak * self._mass(self.low, inside) / self._mass(self.low, self.high)

    def icdf(self, value: Tensor) -> Tensor:
        """Return the quantile of probability `value`, differentiable in it and in every parameter, once."""
        if self._validate_args and not ((value >= 0) & (value <= 1)).all():
            raise InputError(f"value must be a probability in [0, 1], got {value}")
        with torch.no_grad():
            x = self._solve(value)
            a, b, z = ((end - self.loc) / self.scale for end in (self.low, self.high, x))
            # By the theorem of implicit functions, with the density at x in the denominator.
            by_low = torch.exp(torch.log1p(-value) + 0.5 * (z - a) * (z + a))
            by_high = torch.exp(torch.log(value) + 0.5 * (z - b) * (z + b))
        moved = self.loc + self.scale * z + by_low * (self.low - self.loc - self.scale * a)
        moved = moved + by_high * (self.high - self.loc - self.scale * b)
        if value.requires_grad:
            slope = (self.mode - self.loc) / self.scale
            offset = (x - self.mode) / self.scale
            density = torch.exp(-offset * (slope + 0.5 * offset)) / (self._mass(self.low, self.high) * self.scale)
            moved = moved + value / density.detach()
        return x + (moved - moved.detach())

    def rsample(self, sample_shape: _size = torch.Size()) -> Tensor:  # noqa: B008
        uniform = torch.rand(self._extended_shape(sample_shape), dtype=self.loc.dtype, device=self.loc.device)
        return self.icdf(uniform)

    def _mass(self, low: Tensor, high: Tensor) -> Tensor:
        """Return the integral over [low, high], in units of scale, of a density of 1 at the point nearest to loc."""
        nearest = _nearest(self.loc, low, high)
        inside = nearest == self.loc
        below, above = (nearest - low) / self.scale, (high - nearest) / self.scale
        around = math.sqrt(math.pi / 2) * (torch.erf(below * math.sqrt(0.5)) + torch.erf(above * math.sqrt(0.5)))
        _, density, width = _quadrature(((nearest - self.loc) / self.scale).abs(), (high - low) / self.scale)
        return torch.where(inside, around, (density * width).sum(-1))

    def _rule(self) -> tuple[Tensor, Tensor]:
        """Return offsets from the mode in units of scale and their probabilities, each (..., 2 * 32)."""
        slope = ((self.mode - self.loc) / self.scale).abs()
        below = _quadrature(slope, (self.mode - self.low) / self.scale)
        above = _quadrature(slope, (self.high - self.mode) / self.scale)
        offset = torch.cat([-below[0], above[0]], -1)
        weight = torch.cat([below[1] * below[2], above[1] * above[2]], -1)
        return offset, weight / weight.sum(-1, keepdim=True)

    def _solve(self, probability: Tensor) -> Tensor:
        """Return the quantile, found from the mode outwards on the side that it is on."""
        total = self._mass(self.low, self.high)
        mode = self.mode
        lower = torch.where(mode > self.low, self._mass(self.low, mode) / total, 0)
        lower = torch.where(mode < self.high, lower, 1)
        is_below = (probability < lower) | (lower == 1)
        share = torch.where(is_below, lower, 1 - lower)
        beyond = torch.where(is_below, probability, 1 - probability) / share
        within = torch.where(is_below, lower - probability, probability - lower) / share
        width = torch.where(is_below, mode - self.low, self.high - mode) / self.scale
        slope = ((mode - self.loc) / self.scale).abs()
        offset = _solve_tail(slope, width, within.clamp(0, 1), beyond.clamp(0, 1)) * self.scale
        found = mode + torch.where(is_below, -offset, offset)
        return _nearest(found, self.low, self.high)


def _nearest(x: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return the point of [low, high] nearest to x; unlike a clamp, at a tie its gradient is that of x alone."""
    return torch.where(x < low, low, torch.where(x > high, high, x))


def _quadrature(slope: Tensor, width: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return nodes s (..., 32), exp(-slope s - s^2 / 2) and weights over [0, width], or as far as it matters."""
    matters = 2 * _DROP / (torch.sqrt(slope.square() + 2 * _DROP) + slope)
    half = 0.5 * torch.minimum(width, matters)[..., None]
    nodes, weights = (half * x.to(half) for x in _gauss_legendre())
    density = torch.exp(-nodes * (slope[..., None] + 0.5 * nodes))
    return nodes, density, weights


@cache
def _gauss_legendre() -> tuple[Tensor, Tensor]:
    """Return nodes and weights over [0, 2], from the eigenvectors of the Jacobi matrix (Golub and Welsch 1969)."""
    n = torch.arange(1, _NODES, dtype=torch.float64)
    beside = n / torch.sqrt(4 * n.square() - 1)
    nodes, vectors = torch.linalg.eigh(torch.diag(beside, 1) + torch.diag(beside, -1))
    return 1 + nodes, 2 * vectors[0].square()


def _solve_tail(slope: Tensor, width: Tensor, within: Tensor, beyond: Tensor) -> Tensor:
    """Return s with the share `within` of the integral of exp(-slope s - s^2 / 2) over [0, width] below it."""

    def integral(to: Tensor) -> Tensor:
        _, density, weight = _quadrature(slope, to)
        return (density * weight).sum(-1)

    def mills(x: Tensor) -> Tensor:
        scaled: Tensor = torch.special.erfcx(x * math.sqrt(0.5))
        return math.sqrt(math.pi / 2) * scaled

    drop = width * (slope + 0.5 * width)
    narrow = within * width  # nearly uniform: Newton's method on the integral
    goal = within * integral(width)
    wide_goal = torch.log(beyond + within * torch.exp(-drop) * mills(slope + width) / mills(slope))
    wide_goal = wide_goal.clamp(max=-torch.finfo(width.dtype).tiny)  # 0 at the mode, where the start is 0 / 0
    wide = -2 * wide_goal / (torch.sqrt(slope.square() - 2 * wide_goal) + slope)  # on the log of the upper tail
    for _ in range(_NEWTON_STEPS):
        narrow = narrow + (goal - integral(narrow)) * torch.exp(narrow * (slope + 0.5 * narrow))
        log_tail = -wide * (slope + 0.5 * wide) + (mills(slope + wide) / mills(slope)).log()
        wide = wide + (log_tail - wide_goal) * mills(slope + wide)
    return torch.where(beyond == 0, width, torch.where(drop < 1, narrow, wide))
