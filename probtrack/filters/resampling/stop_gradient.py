"""Resampling that leaves the gradient of the evidence unbiased."""

from dataclasses import dataclass

from torch import Tensor

from probtrack.errors import InputError
from probtrack.filters.resampling.base import Copying, copied


@dataclass(frozen=True)
class StopGradient(Copying):
    r"""A scheme whose copies keep the gradient of the weight they were drawn by:

    .. math:: w' = \frac{1}{N} \frac{w}{\bar w}, \qquad \bar w = w \text{ as a constant} .

    In value that is 1/N: clouds, tracks and evidence are those of the scheme, number by number. The gradient of the
    evidence has the exact gradient as its mean, while copies of equal weight forget what earlier weights owed to
    the parameters: all of it for the probabilities of a switching model, which act through weights alone.

    Args:
        resampler: The scheme, one that copies particles, such as `systematic`.

    References:
        A. Scibior, F. Wood, "Differentiable particle filtering without modifying the forward pass", arXiv 2106.10314,
        2021, section 4.
    """

    resampler: Copying

    def __post_init__(self) -> None:
        if not self.resampler.normalised:
            raise InputError("StopGradient around Soft would count weights twice: write Soft(StopGradient(scheme))")

    @property
    def normalised(self) -> bool:
        return self.resampler.normalised

    def num_uniforms(self, num_particles: int, state_dim: int) -> int:
        return self.resampler.num_uniforms(num_particles, state_dim)

    def draw(self, log_weight: Tensor, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        ancestors, weights = self.resampler.draw(log_weight, uniforms)
        if not log_weight.requires_grad:
            return ancestors, weights
        drawn = copied(log_weight[None], ancestors)[0]
        return ancestors, weights + (drawn - drawn.detach())
