"""Joint law of the candidate peaks of a frame, at most one of which the talker causes."""

from typing import cast

import torch
from torch import Tensor
from torch.distributions import Categorical, Distribution, constraints
from torch.types import _size

from probtrack._checks import check_int
from probtrack.distributions.target_or_clutter import EitherSupport, log_density, log_sum, mixture_moments, unchecked
from probtrack.errors import InputError, ShapeError


class PeaksAmongClutter(Distribution):
    r"""Law of C peaks, none or one of which the talker causes, while all others are clutter:

    .. math:: p(y_1, \dots, y_C) = q_0 \prod_i p_\text{clutter}(y_i)
        + \sum_{c=1}^{C} q_c\, p_\text{target}(y_c) \prod_{i \ne c} p_\text{clutter}(y_i) .

    The priors q are made to sum to one here. Peaks that are not present play no part: the priors of those
    that are, and q_0, are made to sum to one, and with no peak present the log density is 0. Samples have a
    value in every slot, present or not. There is no `rsample`: which peak is the talker's is discrete. `mean`
    and `variance` are of each slot by itself, and not implemented on the circle.

    Args:
        target: Law of the peak that the talker causes, scalar event, batch (..., C) or (..., 1) or ().
        clutter: Law of every other peak, likewise.
        log_prior: Log probabilities of no peak and of each one, log q_0 to log q_C (..., C + 1); -inf is never.
        present: Which peaks exist, bool (..., C); all if None. What stands in the others' slots is ignored, NaN too.
        validate_args: As in `torch.distributions`; also replaces that of the two laws.

    Shape:
        Batch: those of the arguments without their last axis, broadcast. Event (C,).

    References:
        S2, eq. 14-16, with c = 0 for clutter only and c >= 1 for peak c, where the paper says H_0 for the
        talker and H_1 for clutter and then sums from 0.
        S3, eq. B.5 prints q_0 without a density of clutter: as a function of the state it is this law with
        uniform clutter of density u and priors proportional to q_0 and u q_c; its q_c of eq. B.6 are `equal_priors`.
        S3, eq. 4.20 is this law up to a constant with q_0 = 0, uniform clutter, peaks tan(theta_c) and target
        Normal(x / y, sigma), whose exponent has the minus and the 2 sigma^2 that the paper lacks.

    >>> from torch.distributions import Normal, Uniform
    >>> law = PeaksAmongClutter(Normal(0.2, 0.1), Uniform(-1.0, 1.0), equal_priors(0.3, 2))
    >>> law.log_prob(torch.tensor([[0.2, 0.7], [0.9, 0.7]])).exp().mul(1e3).round().tolist()
    [773.0, 75.0]
    """

    arg_constraints = {"log_prior": constraints.real_vector}  # noqa: RUF012 (torch declares it as a plain attribute)
    has_rsample = False

    def __init__(
        self,
        target: Distribution,
        clutter: Distribution,
        log_prior: Tensor,
        present: Tensor | None = None,
        validate_args: bool | None = None,
    ) -> None:
        for name, law in (("target", target), ("clutter", clutter)):
            if law.event_shape:
                raise ShapeError(f"{name} must have a scalar event, got event shape {tuple(law.event_shape)}")
        if log_prior.ndim < 1 or log_prior.shape[-1] < 2:
            raise ShapeError(f"log_prior must have shape (..., C + 1) with C >= 1, got {tuple(log_prior.shape)}")
        if present is None:
            present = torch.ones(log_prior.shape[-1] - 1, dtype=torch.bool, device=log_prior.device)
        peaks = (log_prior.shape[-1] - 1,)
        for name, shape in (
            ("target", target.batch_shape),
            ("clutter", clutter.batch_shape),
            ("present", present.shape),
        ):
            if tuple(shape[-1:]) not in ((), (1,), peaks):
                raise ShapeError(f"{name} must have batch (..., {peaks[0]}) or (..., 1), got {tuple(shape)}")
        slots = torch.broadcast_shapes(
            target.batch_shape, clutter.batch_shape, present.shape, (*log_prior.shape[:-1], *peaks)
        )
        self.target, self.clutter = unchecked(target, slots), unchecked(clutter, slots)
        # Not broadcast: constants are worked out once for all peaks that share them.
        self._parts = unchecked(target, target.batch_shape), unchecked(clutter, clutter.batch_shape)
        self.present = present.expand(slots)
        self.log_prior = log_prior.expand(*slots[:-1], -1)
        super().__init__(slots[:-1], slots[-1:], validate_args=validate_args)
        if self._validate_args and not self.log_weights.isfinite().any(-1).all():
            raise InputError(f"log_prior must allow some hypothesis on the peaks present, got {log_prior}")

    @constraints.dependent_property
    def support(self) -> constraints.Constraint:
        return constraints.independent(EitherSupport(self.target, self.clutter), 1)

    def expand(self, batch_shape: _size, _instance: Distribution | None = None) -> "PeaksAmongClutter":
        new = cast(PeaksAmongClutter, self._get_checked_instance(PeaksAmongClutter, _instance))
        slots = torch.Size((*batch_shape, *self.event_shape))
        new.target, new.clutter = self.target.expand(slots), self.clutter.expand(slots)
        new._parts = self._parts
        new.present = self.present.expand(slots)
        new.log_prior = self.log_prior.expand(*batch_shape, -1)
        Distribution.__init__(new, torch.Size(batch_shape), self.event_shape, validate_args=False)
        new._validate_args = self._validate_args
        return new

    @property
    def log_weights(self) -> Tensor:
        """Log probabilities (..., C + 1) of the hypotheses that are left when absent peaks are."""
        none = torch.where(self.present.any(-1), self.log_prior[..., 0], 0)  # all that is left without any peak
        each = torch.where(self.present, self.log_prior[..., 1:], -torch.inf)
        left = torch.cat([none[..., None], each], -1)
        return left - log_sum(left)[..., None]

    @property
    def mean(self) -> Tensor:
        return mixture_moments(self.target, self.clutter, -torch.expm1(self.log_weights[..., 1:]))[0]

    @property
    def variance(self) -> Tensor:
        return mixture_moments(self.target, self.clutter, -torch.expm1(self.log_weights[..., 1:]))[1]

    def log_prob(self, value: Tensor) -> Tensor:
        value = torch.where(self.present, value, self.clutter.mean.detach())  # absent ones: any point will do
        if self._validate_args:
            self._validate_sample(value)
        target, clutter = (torch.where(self.present, log_density(law, value), 0) for law in self._parts)
        # Products over all other peaks, without a division, since a density may be zero.
        nothing = torch.zeros_like(clutter[..., :1])
        before = torch.cat([nothing, clutter.cumsum(-1)], -1)
        after = torch.cat([clutter.flip(-1).cumsum(-1).flip(-1), nothing], -1)
        each = before[..., :-1] + target + after[..., 1:]
        return log_sum(self.log_weights + torch.cat([before[..., -1:], each], -1))

    def sample(self, sample_shape: _size = torch.Size()) -> Tensor:  # noqa: B008
        with torch.no_grad():
            target, clutter = self.target.sample(sample_shape), self.clutter.sample(sample_shape)
            hypothesis = Categorical(logits=self.log_weights, validate_args=False).sample(sample_shape)
            slot = torch.arange(1, self.event_shape[0] + 1, device=hypothesis.device)
            return torch.where(hypothesis[..., None] == slot, target, clutter)


def equal_priors(clutter_probability: Tensor | float, peaks: int) -> Tensor:
    r"""Return log q_0 to log q_C (..., C + 1), the talker being as likely at one peak as at another.

    .. math:: q_c = (1 - q_0) / C, \qquad c = 1, \dots, C .

    Args:
        clutter_probability: Probability q_0, in [0, 1], that no peak is the talker's (...).
        peaks: Number C of peaks.

    References:
        S3, eq. B.6.

    >>> equal_priors(0.4, 3).exp().mul(10).round().tolist()
    [4.0, 2.0, 2.0, 2.0]
    """
    q = torch.as_tensor(clutter_probability)
    check_int(peaks, "peaks", low=1)
    if not ((q >= 0) & (q <= 1)).all():
        raise InputError(f"clutter_probability must be in [0, 1], got {clutter_probability}")
    each = ((1 - q) / peaks)[..., None].expand(*q.shape, peaks)
    return torch.cat([q[..., None], each], -1).log()
