"""Resampling only where the weights have degenerated."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from probtrack.errors import InputError
from probtrack.filters.resampling.base import Law, Resampler


def effective_sample_size(log_weight: Tensor) -> Tensor:
    r"""Return :math:`N_{\mathrm{eff}} = 1 / \sum_n w_n^2` of normalised `log_weight` (*batch, N), (*batch).

    References:
        S1 Algorithm 1, step 3.
    """
    return 1 / log_weight.exp().square().sum(-1)


@dataclass(frozen=True)
class Adaptive(Resampler):
    """Resample the clouds whose effective sample size is below a share of N, leave the others as they are.

    Args:
        resampler: What is done to those.
        threshold: N_thr / N in [0, 1]; 0 never resamples, S1 has 0.75.

    References:
        S1 Algorithm 1, step 3.
    """

    resampler: Resampler
    threshold: float = 0.75

    def __post_init__(self) -> None:
        if not 0 <= self.threshold <= 1:
            raise InputError(f"threshold must be in [0, 1], a share of the particles, got {self.threshold}")

    @property
    def copies(self) -> bool:
        return self.resampler.copies

    @property
    def follows_moves(self) -> bool:
        return self.resampler.follows_moves

    @property
    def normalised(self) -> bool:
        return self.resampler.normalised

    def num_uniforms(self, num_particles: int, state_dim: int) -> int:
        return self.resampler.num_uniforms(num_particles, state_dim)

    def __call__(self, state: Tensor, log_weight: Tensor, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        poor = self._poor(log_weight)
        if poor.ndim == 0:
            return self.resampler(state, log_weight, uniforms) if poor.item() else (state, log_weight)
        rows = poor.flatten().nonzero()[:, 0]
        if len(rows) == 0:
            return state, log_weight
        num_particles = log_weight.shape[-1]
        variables = state.movedim(-1, 0)  # in memory variables first
        clouds, weights = variables.reshape(len(variables), -1, num_particles), log_weight.reshape(-1, num_particles)
        new_clouds, new_weights = self.resampler(
            clouds.index_select(1, rows).movedim(0, -1),
            weights.index_select(0, rows),
            uniforms.reshape(len(weights), -1).index_select(0, rows),
        )
        clouds = clouds.index_copy(1, rows, new_clouds.movedim(-1, 0))
        weights = weights.index_copy(0, rows, new_weights)
        return clouds.view(variables.shape).movedim(0, -1), weights.view(log_weight.shape)

    def after_move(
        self, before: tuple[Tensor, Tensor], state: Tensor, log_weight: Tensor, law: Law
    ) -> tuple[Tensor, Tensor]:
        poor = self._poor(before[1])[..., None]
        if not poor.any():
            return state, log_weight
        # a cloud that was left alone may hold particles that no other could have become: it is worked out as if its
        # weights were equal, so that no infinity comes near the gradient, and then not used
        weights = torch.where(poor, before[1], -math.log(log_weight.shape[-1]))
        followed, weighed = self.resampler.after_move((before[0], weights), state, log_weight, law)
        return torch.where(poor[..., None], followed, state), torch.where(poor, weighed, log_weight)

    def _poor(self, log_weight: Tensor) -> Tensor:
        """Return whether the effective sample size of each cloud is below the threshold (*batch)."""
        weight = log_weight.detach().exp()
        most = 1 / (self.threshold * log_weight.shape[-1]) if self.threshold > 0 else float("inf")  # of 1 / N_eff
        return (weight.dot(weight) if weight.ndim == 1 else weight.square_().sum(-1)) > most
