"""Law of a deterministic map of standard normal noise."""

from collections.abc import Callable
from typing import cast

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints
from torch.types import _size

from probtrack.errors import SingularLawError


class Pushforward(Distribution):
    r"""Law of what a map makes of standard normal noise, :math:`x = f(u), \; u \sim \mathcal N(0, I_K)`.

    It can be sampled, with gradients. Where fewer numbers than variables drive a step, as in the curvilinear
    motion models, there is no density, and `log_prob` says so; mean and variance have no closed form.

    Args:
        transport: f, noise (..., K) -> value (..., D), whose batch broadcasts with the noise's.
        noise_dim: K.
        batch_shape: Of the law.
        event_dim: D.

    Shape:
        Batch (...), event (D,).

    >>> law = Pushforward(lambda u: torch.cat([u.cos(), u.sin()], -1), 1, torch.Size(), 2)
    >>> law.at_noise(torch.zeros(1)).tolist()
    [1.0, 0.0]
    """

    arg_constraints = {}  # noqa: RUF012 (torch declares it as a plain attribute)
    support = constraints.real_vector
    has_rsample = True

    def __init__(
        self,
        transport: Callable[[Tensor], Tensor],
        noise_dim: int,
        batch_shape: torch.Size,
        event_dim: int,
        like: Tensor | None = None,
        validate_args: bool | None = None,
    ) -> None:
        self.transport, self.noise_dim = transport, noise_dim
        self._like = torch.empty(()) if like is None else like
        super().__init__(batch_shape, torch.Size([event_dim]), validate_args=validate_args)

    def expand(self, batch_shape: _size, _instance: Distribution | None = None) -> "Pushforward":
        new = cast(Pushforward, self._get_checked_instance(Pushforward, _instance))
        new.transport, new.noise_dim, new._like = self.transport, self.noise_dim, self._like
        Distribution.__init__(new, torch.Size(batch_shape), self.event_shape, validate_args=False)
        new._validate_args = self._validate_args
        return new

    def at_noise(self, noise: Tensor) -> Tensor:
        """Return the value (..., D) that the standard normal `noise` (..., K) stands for."""
        return self.transport(noise)

    def rsample(self, sample_shape: _size = torch.Size()) -> Tensor:  # noqa: B008
        shape = (*sample_shape, *self.batch_shape, self.noise_dim)
        return self.transport(torch.randn(shape, dtype=self._like.dtype, device=self._like.device))

    def log_prob(self, value: Tensor) -> Tensor:  # noqa: ARG002
        """Raise `SingularLawError`: there is no density.

        Raises:
            SingularLawError: always.
        """
        raise SingularLawError(
            f"this law has no density: {self.noise_dim} noise numbers drive {self.event_shape[0]} variables "
            "through a map that is not linear. Sample it"
        )
