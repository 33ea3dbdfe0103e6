"""Resampling that draws by softened weights, so that weights keep a gradient."""

from dataclasses import dataclass

from torch import Tensor

from probtrack.errors import InputError
from probtrack.filters.resampling.base import Copying, copied


@dataclass(frozen=True)
class Soft(Copying):
    r"""A scheme that draws by a blend of the weights and equal ones, and weighs each copy by what that changed:

    .. math:: q_n = a\, w_n + \frac{1 - a}{N}, \qquad w'_n = \frac{1}{N} \frac{w_{A_n}}{q_{A_n}} .

    The weights are those of importance sampling, whose sum is 1 in expectation only: the estimate of the evidence stays
    unbiased. The gradient is that of the ratio w / q and leaves out that the draws depend on the parameters too: it is
    biased, the less the smaller a is, at the price of particles drawn in vain. `Soft(StopGradient(scheme))` has both
    parts, and the exact gradient as its mean.

    Args:
        resampler: The scheme, one that copies particles, such as `systematic`.
        share: a in (0, 1]; 1 is the scheme itself.

    References:
        P. Karkus, D. Hsu, W. S. Lee, "Particle filter networks with application to visual localization", CoRL 2018:
        soft resampling; the weights are theirs over N, and are not normalised.

    >>> import torch
    >>> from probtrack.filters.resampling import systematic
    >>> log_weight = torch.tensor([0.8, 0.2]).log()
    >>> drawn, weights = Soft(systematic)(torch.tensor([[1.0], [2.0]]), log_weight, torch.tensor([0.5]))
    >>> drawn[:, 0].tolist(), [round(x, 3) for x in weights.exp().tolist()]
    ([1.0, 2.0], [0.615, 0.286])
    """

    resampler: Copying
    share: float = 0.5

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1:
            raise InputError(f"share must be in (0, 1], got {self.share}")
        if self.resampler.follows_moves:
            raise InputError("Soft around a scheme that follows moves would leave out what it does after them")

    @property
    def normalised(self) -> bool:
        return False

    def num_uniforms(self, num_particles: int, state_dim: int) -> int:
        return self.resampler.num_uniforms(num_particles, state_dim)

    def draw(self, log_weight: Tensor, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        blended = self.share * log_weight.exp() + (1 - self.share) / log_weight.shape[-1]
        log_drawn_by = blended.log()
        ancestors, weights = self.resampler.draw(log_drawn_by, uniforms)
        return ancestors, weights + copied((log_weight - log_drawn_by)[None], ancestors)[0]
