"""Stop-gradient resampling whose gradient is averaged over the ancestors that a particle might have had."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from probtrack.filters.resampling.base import Copying, Law
from probtrack.filters.resampling.stop_gradient import StopGradient


@dataclass(frozen=True)
class MarginalStopGradient(Copying):
    r"""A scheme after which a moved particle x', as a constant, has the gradient of the law it was drawn from:

    .. math:: w' = \frac{1}{N} \frac{p(x')}{\bar p(x')}, \qquad p(x') = \sum_j w_j f(x' \mid x_j), \qquad
        \bar p = p \text{ as a constant} .

    In value that is 1/N: clouds, tracks and evidence are those of the scheme. `StopGradient` knows the one ancestor
    and follows the path of the particle; here the sum is over all ancestors, at the price of N^2 densities f a frame,
    and the path counts as chance. Which varies less depends on the model: a motion with wide, learnable noise is better
    followed. Motion without a density, such as S1's printed steps, cannot be had; take `exact` ones.

    Moved particles are known inside one call of a filter: between two calls the gradient is `StopGradient`'s.

    Args:
        resampler: The scheme, one that copies particles, such as `systematic`.

    References:
        A. Scibior, F. Wood, "Differentiable particle filtering without modifying the forward pass", arXiv 2106.10314,
        2021: the marginal form. M. Klaas, N. de Freitas, A. Doucet, "Toward practical N^2 Monte Carlo: the marginal
        particle filter", UAI 2005.
    """

    resampler: Copying

    @property
    def follows_moves(self) -> bool:
        return True

    @property
    def normalised(self) -> bool:
        return self.resampler.normalised

    def num_uniforms(self, num_particles: int, state_dim: int) -> int:
        return self.resampler.num_uniforms(num_particles, state_dim)

    def draw(self, log_weight: Tensor, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        return StopGradient(self.resampler).draw(log_weight, uniforms)

    def after_move(
        self, before: tuple[Tensor, Tensor], state: Tensor, log_weight: Tensor, law: Law
    ) -> tuple[Tensor, Tensor]:
        if not torch.is_grad_enabled():
            return state, log_weight
        state = state.detach()
        # worked out again in the backward pass: N^2 numbers a frame are not kept
        mixture: Tensor = checkpoint(_log_mixture, *before, state, law, use_reentrant=False, preserve_rng_state=False)
        return state, log_weight.detach() + (mixture - mixture.detach())


def _log_mixture(state: Tensor, log_weight: Tensor, moved: Tensor, law: Law) -> Tensor:
    """Return log sum_j w_j f(moved_i | state_j) (*batch, N)."""
    log_density: Tensor = law(state[..., None, :, :]).log_prob(moved[..., None, :])  # (*batch, moved, state)
    return torch.logsumexp(log_density + log_weight[..., None, :], -1)
