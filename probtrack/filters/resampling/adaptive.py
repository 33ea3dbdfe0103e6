"""Resampling only where the weights have degenerated."""

from dataclasses import dataclass

from torch import Tensor

from probtrack.errors import InputError
from probtrack.filters.resampling.base import Resampler


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

    def num_uniforms(self, num_particles: int) -> int:
        return self.resampler.num_uniforms(num_particles)

    def __call__(self, state: Tensor, log_weight: Tensor, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        weight = log_weight.detach().exp()
        most = 1 / (self.threshold * log_weight.shape[-1]) if self.threshold > 0 else float("inf")  # of 1 / N_eff
        if weight.ndim == 1:
            degenerate = weight.dot(weight).item() > most
            return self.resampler(state, log_weight, uniforms) if degenerate else (state, log_weight)
        poor = weight.square_().sum(-1) > most
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
