"""What a resampling scheme is, and the one way from the draws to a new cloud."""

import abc
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.distributions import Distribution

Law = Callable[[Tensor], Distribution]
"""Motion into a frame: states (*batch, 1, N, D) to the laws of the next ones."""

_SMALL = 1024  # particles for which a search is quicker than a scatter


class Resampler(abc.ABC):
    """Exchange of a weighted cloud for another that stands for the same law.

    Schemes that carry gradients or adapt to the weights wrap or replace `Ancestral`; a filter needs no more
    than this.
    """

    @property
    def copies(self) -> bool:
        """Whether every new particle is an old one; others are blends, which modes and wrapped angles forbid."""
        return False

    @property
    def normalised(self) -> bool:
        """Whether new weights sum to 1, not in expectation only."""
        return True

    @property
    def follows_moves(self) -> bool:
        """Whether `after_move` does anything."""
        return False

    @abc.abstractmethod
    def num_uniforms(self, num_particles: int, state_dim: int) -> int:
        """Return how many uniform numbers one run of `num_particles` of D = `state_dim` variables needs a frame."""

    @abc.abstractmethod
    def __call__(self, state: Tensor, log_weight: Tensor, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        """Return the new (state, log_weight).

        Args:
            state: Particles (*batch, N, D).
            log_weight: Normalised log weights (*batch, N).
            uniforms: Uniform numbers in [0, 1), (*batch, num_uniforms(N, D)).
        """

    def after_move(
        self,
        before: tuple[Tensor, Tensor],  # noqa: ARG002
        state: Tensor,
        log_weight: Tensor,
        law: Law,  # noqa: ARG002
    ) -> tuple[Tensor, Tensor]:
        """Return (state, log_weight) of a cloud that was resampled and has moved since: other gradients, same values.

        Args:
            before: The cloud before it was resampled: particles (*batch, N, D), normalised log weights (*batch, N).
            state: Particles after the move (*batch, N, D).
            log_weight: Their log weights (*batch, N).
            law: What they moved by.
        """
        return state, log_weight


class Copying(Resampler):
    """Resampling by copies: which particles are drawn is decided by the weights alone."""

    @property
    def copies(self) -> bool:
        return True

    @abc.abstractmethod
    def draw(self, log_weight: Tensor, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        """Return the particle of every draw, as an index into the flattened clouds, and the new log weights.

        Args:
            log_weight: Normalised log weights (*batch, N).
            uniforms: Uniform numbers in [0, 1), (*batch, num_uniforms(N, D)).
        """

    def __call__(self, state: Tensor, log_weight: Tensor, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        ancestors, weights = self.draw(log_weight, uniforms)
        # clouds lie in memory variables first, and stay so
        return copied(state.movedim(-1, 0), ancestors).movedim(0, -1), weights


@dataclass(frozen=True)
class Ancestral(Copying):
    """N draws of particles by their weights, and all copies weigh 1/N.

    A gradient passes to the states that were drawn and stops at the weights.

    Args:
        ends: (weight (*batch, N), uniforms) -> how many of the N draws fall on each particle or one before it,
            (*batch, N), whole numbers up to N.
        each: Whether every particle needs a uniform number of its own, or one does for the whole cloud.
    """

    ends: Callable[[Tensor, Tensor], Tensor]
    each: bool

    def num_uniforms(self, num_particles: int, state_dim: int) -> int:  # noqa: ARG002
        return num_particles if self.each else 1

    def offspring(self, weight: Tensor, uniforms: Tensor) -> Tensor:
        """Return how often each particle is drawn, (*batch, N) integers that sum to N."""
        ends = self.ends(weight, uniforms).long()
        return torch.cat([ends[..., :1], ends.diff(dim=-1)], -1)

    def draw(self, log_weight: Tensor, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        ancestors = drawn_by(self.ends(log_weight.detach().exp(), uniforms))
        return ancestors, torch.full_like(log_weight, -math.log(log_weight.shape[-1]), requires_grad=False)


def copied(values: Tensor, ancestors: Tensor) -> Tensor:
    """Return the `values` (J, *batch, N) of the particles that were drawn, given their flat indices (batch * N,)."""
    rows = values.reshape(len(values), -1)
    if rows.requires_grad:
        # its gradient is a scatter, ten times as fast as that of index_select
        return rows.gather(1, ancestors.long().expand(len(rows), -1)).view(values.shape)
    return rows.index_select(1, ancestors).view(values.shape)


def drawn_by(ends: Tensor) -> Tensor:
    """Return the particle of every draw, as an index into the flattened clouds, given the `ends` (*batch, N).

    Draw j is of the first particle whose end is beyond j: the number of ends up to j.
    """
    size = ends.shape[-1]
    if ends.numel() <= _SMALL and ends.ndim == 1:
        draws = torch.arange(size, dtype=ends.dtype, device=ends.device)
        return torch.searchsorted(ends, draws, right=True, out_int32=True)
    # counted by one scatter and one sum: at 1e5 particles 40 times as fast as the search, 6 times as repeat_interleave
    before, ones = _rows(ends.numel(), size, ends.device)
    reached = torch.zeros(ends.numel() + 1, dtype=torch.int32, device=ends.device)
    index = ends.reshape(-1).long()
    reached.scatter_add_(0, index if ends.ndim == 1 else index + before, ones)
    return reached.cumsum(0, dtype=torch.int32).narrow(0, 0, ends.numel())


@functools.lru_cache(maxsize=8)  # the same every frame
def _rows(numel: int, size: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return how many particles lie in clouds of `size` before that of each of `numel`, and as many ones."""
    with torch.inference_mode(False):
        starts = torch.arange(0, numel, size, device=device)
        return starts.repeat_interleave(size), torch.ones(numel, dtype=torch.int32, device=device)


def cumulative(weight: Tensor) -> Tensor:
    """Return the cumulative weights (*batch, N), exactly 1 from the last particle of positive weight on.

    Sums of float32 miss 1 by more than 1/N at a million particles; without this the last particle would
    collect what is missing, even at weight 0.
    """
    total = weight.cumsum(-1)
    return total / total.narrow(-1, total.shape[-1] - 1, 1)
