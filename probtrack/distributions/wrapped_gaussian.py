"""Gaussian law of a state, one variable of which is an angle."""

import math
from typing import cast

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints
from torch.types import _size

from probtrack.distributions.linear_gaussian import LinearGaussian
from probtrack.errors import InputError
from probtrack.geometry import wrap_angle

_MAX_WINDINGS = 32
_TAIL = 9.0  # beyond nine standard deviations a normal density is nothing, even in float64


class WrappedGaussian(Distribution):
    r"""Law of a Gaussian vector, one variable of which is wrapped to [-pi, pi):

    .. math:: p(x) = \sum_k \mathcal{N}(x + 2\pi k e_a; \mathrm{loc}, \mathrm{gain}\,\mathrm{gain}^\top) .

    The sum is centred where its terms are largest, whatever the other variables are, and is as long as the
    angle's marginal standard deviation asks for: three terms for what a motion model moves in a frame, 65 at
    most. Up to a spread of 22 rad that is exact; beyond, where the angle is uniform anyhow, density is lost.

    Args:
        base: Law before wrapping, event (D,).
        angle: Index a of the angle [rad] among the D variables, from 0.
        validate_args: As in `torch.distributions`.

    Shape:
        Batch: that of `base`. Event (D,). Values may have any angle, whose turns do not count.

    References:
        S2, section 4.2: heading and its rate, (theta, theta_dot), with wrap-around.

    >>> law = WrappedGaussian(LinearGaussian(torch.tensor([3.1, 0.5]), torch.tensor([[0.1], [0.2]])), angle=0)
    >>> [round(x, 4) for x in law.at_noise(torch.tensor([1.0])).tolist()]
    [-3.0832, 0.7]
    """

    arg_constraints = {}  # noqa: RUF012 (torch declares it as a plain attribute)
    support = constraints.real_vector
    has_rsample = True

    def __init__(self, base: LinearGaussian, angle: int, validate_args: bool | None = None) -> None:
        dim = base.event_shape[0]
        if isinstance(angle, bool) or not isinstance(angle, int) or not 0 <= angle < dim:
            raise InputError(f"angle must be the index of a variable, 0 to {dim - 1}, got {angle}")
        self.base, self.angle = base, angle
        super().__init__(base.batch_shape, base.event_shape, validate_args=validate_args)

    def expand(self, batch_shape: _size, _instance: Distribution | None = None) -> "WrappedGaussian":
        new = cast(WrappedGaussian, self._get_checked_instance(WrappedGaussian, _instance))
        new.base, new.angle = self.base.expand(batch_shape), self.angle
        Distribution.__init__(new, torch.Size(batch_shape), self.event_shape, validate_args=False)
        new._validate_args = self._validate_args
        return new

    @property
    def noise_dim(self) -> int:
        """How many standard normal numbers K make one value."""
        return self.base.noise_dim

    @property
    def mean(self) -> Tensor:
        """Mean before wrapping, its angle wrapped."""
        return self._wrap(self.base.mean)

    @property
    def mode(self) -> Tensor:
        return self.mean

    @property
    def variance(self) -> Tensor:
        """Variance before wrapping (..., D)."""
        return self.base.variance

    @property
    def covariance_matrix(self) -> Tensor:
        """Covariance before wrapping (..., D, D)."""
        return self.base.covariance_matrix

    def at_noise(self, noise: Tensor) -> Tensor:
        """Return the value (..., D) that the standard normal `noise` (..., K) stands for."""
        return self._wrap(self.base.at_noise(noise))

    def rsample(self, sample_shape: _size = torch.Size()) -> Tensor:  # noqa: B008
        return self._wrap(self.base.rsample(sample_shape))

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log density of `value` (..., D).

        Raises:
            SingularLawError: if the base law has no density.
        """
        if self._validate_args:
            self._validate_sample(value)
        around = torch.arange(-1, 2).to(value)
        before, at, after = self._log_terms(value.detach(), around).detach()
        # A parabola in k, whose top is the winding nearest to the conditional mean of the angle.
        top = torch.round((after - before) / (2 * (2 * at - before - after)))
        top = torch.where(top.isfinite(), top, 0.0)  # beyond the precision of the numbers there is no curvature
        turns = self._windings(self.base.variance[..., self.angle].detach()).to(value)
        return torch.logsumexp(self._log_terms(self._turned(value, top), turns), 0)

    def _windings(self, variance: Tensor) -> Tensor:
        """Return -K to K such that terms further from the top than K are nothing at this spread."""
        spread = _TAIL / math.pi * math.sqrt(float(variance.max()))
        count = min(max(math.ceil((math.sqrt(1 + spread**2) - 1) / 2), 1), _MAX_WINDINGS)
        return torch.arange(-count, count + 1)

    def _log_terms(self, value: Tensor, turns: Tensor) -> Tensor:
        """Return the log density before wrapping of `value`, turned that often: (turns, ...)."""
        value = value.expand(*torch.broadcast_shapes(value.shape[:-1], self.batch_shape), -1)
        return self.base.log_prob(self._turned(value, turns[(..., *(None for _ in value.shape[:-1]))]))

    def _turned(self, value: Tensor, turns: Tensor) -> Tensor:
        return value + 2 * math.pi * turns[..., None] * self._axis(value)

    def _wrap(self, value: Tensor) -> Tensor:
        return torch.where(self._axis(value) > 0, wrap_angle(value), value)

    def _axis(self, value: Tensor) -> Tensor:
        return (torch.arange(self.event_shape[0], device=value.device) == self.angle).to(value)
