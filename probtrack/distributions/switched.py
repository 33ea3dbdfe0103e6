"""A mode, and a vector whose law and size depend on the mode."""

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor
from torch.distributions import Categorical, Distribution, constraints
from torch.types import _size

from probtrack._checks import check_event
from probtrack.errors import ShapeError


class Switched(Distribution):
    r"""Joint law of a mode s and of a vector x that is drawn from the mode's own law:

    .. math:: p(x, s) = P(s)\, p_s(x) .

    A value is x, padded with zeros to the largest size, and s as its last number: a density by x and a
    probability by s. The mode is not relaxed, so that samples carry no gradient.

    Args:
        log_prob_of_mode: log P(s) (..., S), normalised; -inf for a mode that cannot be.
        laws: The S laws p_s, with events (D_s,) and batches that broadcast with (...).
        validate_args: As in `torch.distributions`; the laws check their own values.

    Shape:
        Batch (...), event (max D_s + 1,).

    >>> from torch.distributions import Independent, Normal
    >>> narrow = Independent(Normal(torch.zeros(2), 1.0), 1)
    >>> wide = Independent(Normal(torch.zeros(1), 3.0), 1)
    >>> law = Switched(torch.tensor([0.8, 0.2]).log(), [narrow, wide])
    >>> value = torch.tensor([0.0, 0.0, 1.0])  # the second mode, whose x has one number
    >>> bool(torch.isclose(law.log_prob(value), torch.tensor(0.2).log() + wide.log_prob(value[:1])))
    True
    """

    arg_constraints = {}  # noqa: RUF012 (torch declares it as a plain attribute)
    support = constraints.real_vector

    def __init__(
        self, log_prob_of_mode: Tensor, laws: Sequence[Distribution], validate_args: bool | None = None
    ) -> None:
        if not laws or any(len(law.event_shape) != 1 for law in laws):
            shapes = ", ".join(str(tuple(law.event_shape)) for law in laws)
            raise ShapeError(f"laws must be of vectors with events (D,), got {shapes or 'none'}")
        check_event(log_prob_of_mode, (len(laws),), "log_prob_of_mode")
        batch = torch.broadcast_shapes(log_prob_of_mode.shape[:-1], *(law.batch_shape for law in laws))
        self.log_prob_of_mode = log_prob_of_mode.expand(*batch, -1)
        self.laws = [law.expand(batch) for law in laws]
        size = max(law.event_shape[0] for law in laws) + 1
        super().__init__(batch, torch.Size([size]), validate_args=validate_args)

    def expand(self, batch_shape: _size, _instance: Distribution | None = None) -> "Switched":
        new = cast(Switched, self._get_checked_instance(Switched, _instance))
        new.log_prob_of_mode = self.log_prob_of_mode.expand(*batch_shape, -1)
        new.laws = [law.expand(batch_shape) for law in self.laws]
        Distribution.__init__(new, torch.Size(batch_shape), self.event_shape, validate_args=False)
        new._validate_args = self._validate_args
        return new

    def sample(self, sample_shape: _size = torch.Size()) -> Tensor:  # noqa: B008
        with torch.no_grad():
            mode = Categorical(logits=self.log_prob_of_mode).sample(sample_shape)
            value = torch.zeros(())
            for s, law in enumerate(self.laws):
                drawn = law.sample(sample_shape)
                padded = torch.nn.functional.pad(drawn, (0, self.event_shape[0] - drawn.shape[-1]))
                value = torch.where((mode == s)[..., None], padded, value.to(padded))
            value[..., -1] = mode.to(value)
            return value

    def log_prob(self, value: Tensor) -> Tensor:
        """Return log P(s) + log p_s(x) of `value` (..., D), -inf for a mode that is none of the S.

        Raises:
            SingularLawError: if a law of a mode that occurs in `value` has no density.
        """
        check_event(value, tuple(self.event_shape), "value")
        mode = value[..., -1]
        total = torch.full(torch.broadcast_shapes(mode.shape, self.batch_shape), -torch.inf).to(value)
        for s, law in enumerate(self.laws):
            here = mode == s
            if here.any():  # a law that is not asked need not have a density
                # other modes' values may lie where this law has no density and no gradient
                x = torch.where(here[..., None], value[..., : law.event_shape[0]], 0.0)
                density = law.log_prob(x)
                total = torch.where(here, self.log_prob_of_mode[..., s] + density, total)
        return total
