"""Metropolis steps on an estimated evidence that are exact all the same."""

from dataclasses import dataclass

import pyro
import torch
from torch import Tensor

from probtrack._checks import check_int
from probtrack.training.bayesian.target import Draws, Method, Target, new_seed

_WANTED = 0.2  # acceptance: below the 0.234 of an exact evidence, since an estimate is refused more often
_FIRST = 0.3  # standard deviation of the first proposals
_FADING = 2 / 3
_SEEDS = 20


@dataclass(frozen=True)
class ParticleMetropolis(Method):
    r"""Particle marginal Metropolis-Hastings: a random walk accepted by estimates of the evidence,

    .. math:: \min\left\{1, \frac{\hat p(y \mid x')\, p(x')\, |J(x')|}{\hat p(y \mid x)\, p(x)\, |J(x)|}\right\} ,

    in unconstrained coordinates, J the Jacobian of the map to physical values. As long as the mean of the estimate is
    the evidence, and the estimate of the values that a chain stands on is kept, the posterior is exact for any number
    of particles; with few of them it is explored slowly. Fastest is a standard deviation of the log evidence of
    about 1 to 1.7, which the notes have as `log_evidence_std` (), at the posterior mean. No gradient is used.

    In the warm-up the proposal's covariance is adapted, and the estimate of the values that a chain stands on is made
    anew in each step, so that none is held for long by a lucky one where it started, at a draw of the prior. The notes
    also have the `acceptance` of each chain (C,).

    Args:
        num_samples: S, draws a chain.
        warmup: Steps before those; each asks for two estimates.
        num_chains: C.

    References:
        C. Andrieu, A. Doucet, R. Holenstein, "Particle Markov chain Monte Carlo methods", JRSS B 72(3), 2010,
        section 2.4.2 and eq. 13. M. Vihola, "Robust adaptive Metropolis algorithm with coerced acceptance rate",
        Statistics and Computing 22, 2012, eq. 1: the adaptation. A. Doucet, M. K. Pitt, G. Deligiannidis,
        R. Kohn, "Efficient implementation of Markov chain Monte Carlo when using an unbiased likelihood
        estimator", Biometrika 102(2), 2015: how many particles.
    """

    num_samples: int = 2000
    warmup: int = 500
    num_chains: int = 4

    def __post_init__(self) -> None:
        for name, low in (("num_samples", 4), ("warmup", 1), ("num_chains", 1)):
            check_int(self.__dict__[name], name, low=low)

    @torch.no_grad()
    def __call__(self, target: Target) -> Draws:
        starts = [target.from_prior() for _ in range(self.num_chains)]
        for start in starts:
            target.log_evidence(start, new_seed())  # says what is wrong if it is
        here = torch.stack([target.place(start) for start in starts])
        with pyro.validation_enabled(False):  # far out a value rounds to the end of its support: density zero
            places, acceptance = self._run(target, here)
        values = target.values(places.movedim(0, 1))
        centre = {name: value.mean((0, 1)) for name, value in values.items()}
        spread = torch.stack([target.log_evidence(centre, new_seed()) for _ in range(_SEEDS)]).std()
        return Draws(values, {"acceptance": acceptance, "log_evidence_std": spread})

    def _run(self, target: Target, here: Tensor) -> tuple[Tensor, Tensor]:
        """Return the places (S, C, K) of chains that start `here` (C, K), and their acceptance after the warm-up."""
        root = _FIRST * torch.eye(here.shape[-1]).to(here).expand(len(here), -1, -1)
        level, places, accepted = _levels(target, here), [], torch.zeros(len(here))
        for step in range(1, self.warmup + self.num_samples + 1):
            warming = step <= self.warmup
            if warming:
                level = _levels(target, here)
            push = torch.randn_like(here)
            there = here + (root @ push[..., None])[..., 0]
            new = _levels(target, there)
            chance = (new - level).exp().nan_to_num(0.0).clamp_max(1.0)  # nowhere to nowhere: stay
            taken = torch.rand(len(here)) < chance
            here, level = torch.where(taken[:, None], there, here), torch.where(taken, new, level)
            if warming:
                root = _adapted(root, push, chance, step)
            else:
                places.append(here)
                accepted += taken
        return torch.stack(places), accepted / self.num_samples


def _adapted(root: Tensor, push: Tensor, chance: Tensor, step: int) -> Tensor:
    """Return the roots (C, K, K) of the proposals' covariances, wider along `push` if accepted too easily (eq. 1)."""
    size = push.shape[-1]
    rate = min(1.0, size * step**-_FADING)
    direction = root @ (push / push.norm(dim=-1, keepdim=True))[..., None]
    wider = rate * (chance - _WANTED)[:, None, None] * direction @ direction.mT
    adapted: Tensor = torch.linalg.cholesky(root @ root.mT + wider)
    return adapted


def _levels(target: Target, places: Tensor) -> Tensor:
    """Return the estimated log densities (C,) at `places` (C, K), each by a seed of its own."""
    return torch.stack([target.log_density(place, new_seed()) for place in places])
