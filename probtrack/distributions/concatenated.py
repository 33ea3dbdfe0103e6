"""Independent vectors side by side."""

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints
from torch.types import _size

from probtrack._checks import check_event
from probtrack.errors import ShapeError


class Concatenated(Distribution):
    r"""Law of independent vectors written one after the other, :math:`p(x, y) = p(x)\,p(y)`.

    It has a density where all its parts have one, and reparametrised samples likewise.

    Args:
        parts: Laws with event (D_i,); their batches broadcast.
        validate_args: As in `torch.distributions`; the parts check their own values.

    Shape:
        Batch (...), event (sum of D_i,).

    >>> from torch.distributions import Independent, Normal
    >>> law = Concatenated([Independent(Normal(torch.zeros(2), 1.0), 1), Independent(Normal(torch.ones(1), 2.0), 1)])
    >>> law.mean.tolist()
    [0.0, 0.0, 1.0]
    """

    arg_constraints = {}  # noqa: RUF012 (torch declares it as a plain attribute)
    support = constraints.real_vector

    def __init__(self, parts: Sequence[Distribution], validate_args: bool | None = None) -> None:
        if not parts or any(len(part.event_shape) != 1 for part in parts):
            shapes = ", ".join(str(tuple(part.event_shape)) for part in parts)
            raise ShapeError(f"parts must be laws of vectors with events (D,), got {shapes or 'none'}")
        batch = torch.broadcast_shapes(*(part.batch_shape for part in parts))
        self.parts = [part.expand(batch) for part in parts]
        self._sizes = [part.event_shape[0] for part in parts]
        super().__init__(batch, torch.Size([sum(self._sizes)]), validate_args=validate_args)

    @property
    def has_rsample(self) -> bool:  # type: ignore[override]
        """Whether samples carry gradients: those of all parts do."""
        return all(part.has_rsample for part in self.parts)

    def expand(self, batch_shape: _size, _instance: Distribution | None = None) -> "Concatenated":
        new = cast(Concatenated, self._get_checked_instance(Concatenated, _instance))
        new.parts, new._sizes = [part.expand(batch_shape) for part in self.parts], self._sizes
        Distribution.__init__(new, torch.Size(batch_shape), self.event_shape, validate_args=False)
        new._validate_args = self._validate_args
        return new

    @property
    def mean(self) -> Tensor:
        return torch.cat([part.mean for part in self.parts], -1)

    @property
    def variance(self) -> Tensor:
        return torch.cat([part.variance for part in self.parts], -1)

    def rsample(self, sample_shape: _size = torch.Size()) -> Tensor:  # noqa: B008
        return torch.cat([part.rsample(sample_shape) for part in self.parts], -1)

    def sample(self, sample_shape: _size = torch.Size()) -> Tensor:  # noqa: B008
        return torch.cat([part.sample(sample_shape) for part in self.parts], -1)

    def log_prob(self, value: Tensor) -> Tensor:
        check_event(value, tuple(self.event_shape), "value")
        pieces = value.split(self._sizes, -1)
        return torch.stack([part.log_prob(piece) for part, piece in zip(self.parts, pieces, strict=True)]).sum(0)
