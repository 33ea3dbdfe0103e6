"""Mixture of what a talker causes and of clutter, two laws of different families."""

from typing import cast

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, constraints
from torch.nn.functional import logsigmoid
from torch.types import _size

from probtrack.distributions.wrapped_normal import circle
from probtrack.errors import ShapeError


class TargetOrClutter(Distribution):
    r"""Law of an observation that the talker causes, unless it is clutter:

    .. math:: p(y) = (1-q)\,p_\text{target}(y) + q\,p_\text{clutter}(y), \qquad q = \mathrm{sigmoid}(\text{logit}) .

    `torch.distributions.MixtureSameFamily` cannot mix two families. A value needs to be in the support of
    one of the two only. There is no `rsample`: which of the two a sample comes from is discrete, and a
    gradient that passes it by would be wrong. `mean` and `variance` are those of a mixture on the line;
    for a `WrappedNormal`, whose moments are circular, they are not implemented.

    Args:
        target: Law of what the talker causes.
        clutter: Law of everything else, of the same event shape.
        logit_clutter: Log odds of clutter, log q - log(1 - q) (...); -inf and inf are allowed: never, always.
        validate_args: As in `torch.distributions`; also replaces that of the two laws.

    Shape:
        Batch: those of the three, broadcast. Event: that of the two laws, any.

    References:
        S2, eq. 23: `TargetOrClutter(WrappedNormal(...), Uniform(-pi, pi), ...)` is the law of a heading,
        with logit_clutter = log(1 - q_T) - log(q_T).
        S1, eq. 4 mixes a steered power and a uniform law in the same way.

    >>> from torch.distributions import Normal, Uniform
    >>> law = TargetOrClutter(Normal(0.2, 0.1), Uniform(-1.0, 1.0), torch.tensor(0.0))
    >>> round(law.log_prob(torch.tensor(-0.9)).exp().item(), 4)
    0.25
    """

    arg_constraints = {"logit_clutter": constraints.real}  # noqa: RUF012 (torch declares it as a plain attribute)
    has_rsample = False

    def __init__(
        self,
        target: Distribution,
        clutter: Distribution,
        logit_clutter: Tensor | float,
        validate_args: bool | None = None,
    ) -> None:
        if target.event_shape != clutter.event_shape:
            expected, got = tuple(target.event_shape), tuple(clutter.event_shape)
            raise ShapeError(f"clutter must have the event shape of target, {expected}, got {got}")
        logit_clutter = torch.as_tensor(logit_clutter)
        batch = torch.broadcast_shapes(target.batch_shape, clutter.batch_shape, logit_clutter.shape)
        self.target, self.clutter = unchecked(target, batch), unchecked(clutter, batch)
        self.logit_clutter = logit_clutter.expand(batch)
        super().__init__(batch, target.event_shape, validate_args=validate_args)

    @constraints.dependent_property
    def support(self) -> constraints.Constraint:
        return EitherSupport(self.target, self.clutter)

    def expand(self, batch_shape: _size, _instance: Distribution | None = None) -> "TargetOrClutter":
        new = cast(TargetOrClutter, self._get_checked_instance(TargetOrClutter, _instance))
        batch = torch.Size(batch_shape)
        new.target, new.clutter = self.target.expand(batch), self.clutter.expand(batch)
        new.logit_clutter = self.logit_clutter.expand(batch)
        Distribution.__init__(new, batch, self.event_shape, validate_args=False)
        new._validate_args = self._validate_args
        return new

    @property
    def mean(self) -> Tensor:
        return mixture_moments(self.target, self.clutter, self._over_event(self.logit_clutter).sigmoid())[0]

    @property
    def variance(self) -> Tensor:
        return mixture_moments(self.target, self.clutter, self._over_event(self.logit_clutter).sigmoid())[1]

    def log_prob(self, value: Tensor) -> Tensor:
        if self._validate_args:
            self._validate_sample(value)
        target = logsigmoid(-self.logit_clutter) + log_density(self.target, value)
        clutter = logsigmoid(self.logit_clutter) + log_density(self.clutter, value)
        return log_sum(torch.stack(torch.broadcast_tensors(target, clutter), -1))

    def sample(self, sample_shape: _size = torch.Size()) -> Tensor:  # noqa: B008
        with torch.no_grad():
            target, clutter = self.target.sample(sample_shape), self.clutter.sample(sample_shape)
            q = self.logit_clutter.sigmoid().expand(torch.Size((*sample_shape, *self.batch_shape)))
            return torch.where(self._over_event(torch.rand_like(q) < q), clutter, target)

    def _over_event(self, x: Tensor) -> Tensor:
        return x[(..., *(None for _ in self.event_shape))]


class EitherSupport(constraints.Constraint):
    """Values that at least one of two laws can have."""

    def __init__(self, first: Distribution, second: Distribution) -> None:
        self.supports = [cast(constraints.Constraint, law.support) for law in (first, second)]
        self.is_discrete = any(support.is_discrete for support in self.supports)
        self.event_dim = len(first.event_shape)

    def check(self, value: Tensor) -> Tensor:
        first, second = (cast(Tensor, support.check(value)) for support in self.supports)
        return first | second


def unchecked(law: Distribution, batch: _size) -> Distribution:
    """Return a copy of `law` over `batch` that takes values outside its support."""
    copy: Distribution = law.expand(torch.Size(batch))
    inner = copy
    inner._validate_args = False
    while isinstance(inner, Independent):
        inner = inner.base_dist
        inner._validate_args = False
    return copy


def log_density(law: Distribution, value: Tensor) -> Tensor:
    """Return the log density of an `unchecked` law, -inf outside its support, whatever the law does there."""
    inside = cast(Tensor, cast(constraints.Constraint, law.support).check(value))
    return torch.where(inside, law.log_prob(value), -torch.inf)


def log_sum(terms: Tensor) -> Tensor:
    """Return the log of the sum of exp of `terms` over the last axis; none has a NaN gradient where all are -inf."""
    impossible = (terms == -torch.inf).all(-1)
    possible = torch.logsumexp(torch.where(impossible[..., None], 0, terms), -1)
    return torch.where(impossible, -torch.inf, possible)


def mixture_moments(target: Distribution, clutter: Distribution, q: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and variance of a mixture on the line with weights 1 - q and q.

    Raises:
        NotImplementedError: for angles, whose moments are circular.
    """
    if circle in (target.support, clutter.support):
        raise NotImplementedError("a mixture with a law on the circle has no mean and variance on the line")
    mean = (1 - q) * target.mean + q * clutter.mean
    within = (1 - q) * target.variance + q * clutter.variance
    return mean, within + q * (1 - q) * (target.mean - clutter.mean).square()
