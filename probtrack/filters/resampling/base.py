"""What a resampling scheme is, and the one way from offspring counts to a new cloud."""

import abc
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


class Resampler(abc.ABC):
    """Exchange of a weighted cloud for another that stands for the same law.

    Schemes that carry gradients or adapt to the weights wrap or replace `Ancestral`; a filter needs no more
    than this.
    """

    @abc.abstractmethod
    def num_uniforms(self, num_particles: int) -> int:
        """Return how many uniform numbers one run of `num_particles` needs a frame."""

    @abc.abstractmethod
    def __call__(self, state: Tensor, log_weight: Tensor, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        """Return the new (state, log_weight).

        Args:
            state: Particles (*batch, N, D).
            log_weight: Normalised log weights (*batch, N).
            uniforms: Uniform numbers in [0, 1), (*batch, num_uniforms(N)).
        """


@dataclass(frozen=True)
class Ancestral(Resampler):
    """Resampling by copies: each particle leaves as many offspring as `offspring` says, all of weight 1/N.

    Args:
        offspring: (weight (*batch, N), uniforms) -> counts (*batch, N), integers that sum to N.
        each: Whether every particle needs a uniform number of its own, or one does for the whole cloud.
    """

    offspring: Callable[[Tensor, Tensor], Tensor]
    each: bool

    def num_uniforms(self, num_particles: int) -> int:
        return num_particles if self.each else 1

    def __call__(self, state: Tensor, log_weight: Tensor, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        counts = self.offspring(log_weight.detach().exp(), uniforms)
        # each row's counts sum to N: repeated over the flattened clouds they stay in their rows
        ancestors = torch.repeat_interleave(counts.flatten(), output_size=counts.numel())
        equal = torch.full_like(log_weight, -math.log(log_weight.shape[-1]), requires_grad=False)
        variables = state.mT  # (*batch, D, N): clouds lie in memory by variable, and stay so
        if variables.ndim == 2:
            return variables.index_select(1, ancestors).mT, equal
        rows = torch.arange(0, counts.numel(), counts.shape[-1], device=counts.device)
        local = (ancestors.view(-1, counts.shape[-1]) - rows[:, None]).view(*counts.shape[:-1], 1, counts.shape[-1])
        return variables.gather(-1, local.expand(variables.shape)).mT, equal


def cumulative(weight: Tensor) -> Tensor:
    """Return the cumulative weights (*batch, N), exactly 1 from the last particle of positive weight on.

    Sums of float32 miss 1 by more than 1/N at a million particles; without this the last particle would
    collect what is missing, even at weight 0.
    """
    total = weight.cumsum(-1)
    return total / total[..., -1:]


def counts(below: Tensor) -> Tensor:
    """Return the differences (*batch, N) of how many draws lie below each cumulative weight, as integers."""
    difference = below.long()
    difference[..., 1:].sub_(difference[..., :-1].clone())
    return difference
