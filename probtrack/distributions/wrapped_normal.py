"""Normal law wrapped around the circle, for angles."""

import math
from typing import cast

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints
from torch.distributions.utils import broadcast_all
from torch.types import _size

from probtrack.geometry import wrap_angle

# At this spread both series below, as long as they are, leave out less than 1e-16 of the density.
_SWITCH = math.sqrt(math.pi)
_WINDINGS = 2
_HARMONICS = 4


class _Circle(constraints.Constraint):
    """Angles, once around; the end pi is the point -pi again, as atan2 returns both."""

    def check(self, value: Tensor) -> Tensor:
        return (value >= -math.pi) & (value <= math.pi)


circle = _Circle()
"""Support of angles from -pi to pi: laws on it have circular moments, which do not mix like those on a line."""


class WrappedNormal(Distribution):
    r"""Law of an angle that is normal before it is wrapped to [-pi, pi):

    .. math:: p(\theta) = \sum_k \mathcal{N}(\theta + 2\pi k; \mu, \sigma^2)
        = \frac{1}{2\pi} \Big(1 + 2 \sum_{n \ge 1} e^{-n^2\sigma^2/2} \cos n(\theta-\mu)\Big) .

    The first series is used for a small `scale`, in the log domain, the second for a large one; where they
    meet, both are exact to rounding. A very large `scale` gives the uniform law. `mean` is the circular
    mean and `variance` the circular variance 1 - exp(-sigma^2 / 2), from 0 to 1.

    Args:
        loc: Mean mu [rad], any number (...).
        scale: Standard deviation sigma before wrapping [rad], > 0 (...).
        validate_args: As in `torch.distributions`.

    Shape:
        Batch: that of the arguments, broadcast. Event (), an angle [rad] counter-clockwise. Samples are in
        [-pi, pi); pi too has a density, that of -pi, since atan2 returns it.

    References:
        K. V. Mardia, P. E. Jupp, "Directional Statistics", Wiley, 2000, section 3.5.7.
        S2, eq. 20 writes a normal law of an angle; here it is wrapped, so that it is a density on the circle.

    >>> law = WrappedNormal(torch.tensor(3.0), torch.tensor(0.5))
    >>> bool(law.log_prob(torch.tensor(-3.1)) > law.log_prob(torch.tensor(2.6)))
    True
    """

    arg_constraints = {"loc": constraints.real, "scale": constraints.positive}  # noqa: RUF012 (as torch declares it)
    support = circle
    has_rsample = True

    def __init__(self, loc: Tensor | float, scale: Tensor | float, validate_args: bool | None = None) -> None:
        self.loc, self.scale = broadcast_all(loc, scale)
        super().__init__(self.loc.shape, validate_args=validate_args)

    def expand(self, batch_shape: _size, _instance: Distribution | None = None) -> "WrappedNormal":
        new = cast(WrappedNormal, self._get_checked_instance(WrappedNormal, _instance))
        batch = torch.Size(batch_shape)
        new.loc, new.scale = self.loc.expand(batch), self.scale.expand(batch)
        Distribution.__init__(new, batch, validate_args=False)
        new._validate_args = self._validate_args
        return new

    @property
    def mean(self) -> Tensor:
        return wrap_angle(self.loc)

    @property
    def mode(self) -> Tensor:
        return wrap_angle(self.loc)

    @property
    def variance(self) -> Tensor:
        return -torch.expm1(-0.5 * self.scale.square())

    def log_prob(self, value: Tensor) -> Tensor:
        if self._validate_args:
            self._validate_sample(value)
        offset = wrap_angle(value - self.loc)
        is_narrow = self.scale <= _SWITCH
        narrow = _sum_of_windings(offset, torch.where(is_narrow, self.scale, _SWITCH))
        wide = _fourier_series(offset, torch.where(is_narrow, _SWITCH, self.scale))
        return torch.where(is_narrow, narrow, wide)

    def rsample(self, sample_shape: _size = torch.Size()) -> Tensor:  # noqa: B008
        shape = self._extended_shape(sample_shape)
        return wrap_angle(self.loc + self.scale * torch.randn(shape, dtype=self.loc.dtype, device=self.loc.device))


def _sum_of_windings(offset: Tensor, scale: Tensor) -> Tensor:
    windings = 2 * math.pi * torch.arange(-_WINDINGS, _WINDINGS + 1).to(offset)
    exponent = -0.5 * ((offset[..., None] + windings) / scale[..., None]).square()
    return torch.logsumexp(exponent, -1) - scale.log() - 0.5 * math.log(2 * math.pi)


def _fourier_series(offset: Tensor, scale: Tensor) -> Tensor:
    n = torch.arange(1, _HARMONICS + 1).to(offset)
    terms = torch.exp(-0.5 * (n * scale[..., None]).square()) * torch.cos(n * offset[..., None])
    return torch.log1p(2 * terms.sum(-1)) - math.log(2 * math.pi)
