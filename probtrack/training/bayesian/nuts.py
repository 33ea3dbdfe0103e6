"""Hamiltonian Monte Carlo on an exact evidence, by pyro."""

from dataclasses import dataclass

import torch
from pyro.infer import MCMC
from pyro.infer import NUTS as PyroNUTS
from torch import Tensor

from probtrack._checks import check_int
from probtrack.errors import InputError
from probtrack.training.bayesian.target import Draws, Method, Target

_ENOUGH = 20  # draws a dimension that tell a covariance


@dataclass(frozen=True)
class NUTS(Method):
    """The no-U-turn sampler, for an evidence that is exact and has a gradient.

    It moves in the unconstrained coordinates of the priors' supports, with the Jacobian of the map, and adapts its
    step and mass to them in the warm-up: a full matrix where that has 20 draws a dimension, else its diagonal. Every
    chain starts at a draw of the prior.

    The notes have the number of `divergences` of each chain (C,): any tells that a region was not explored.

    Args:
        num_samples: S, draws a chain.
        warmup: Draws before those.
        num_chains: C.

    References:
        M. D. Hoffman, A. Gelman, "The No-U-Turn Sampler", JMLR 15, 2014, Algorithm 6, as pyro has it: multinomial
        draws from the trajectory in place of a slice (M. Betancourt, arXiv 1701.02434, 2017).
    """

    num_samples: int = 500
    warmup: int = 300
    num_chains: int = 4

    def __post_init__(self) -> None:
        for name, low in (("num_samples", 4), ("warmup", 1), ("num_chains", 1)):
            check_int(self.__dict__[name], name, low=low)

    def __call__(self, target: Target) -> Draws:
        runs = [self._chain(target) for _ in range(self.num_chains)]
        values = {name: torch.stack([chain[name] for chain, _ in runs]) for name in runs[0][0]}
        return Draws(values, {"divergences": torch.tensor([float(count) for _, count in runs])})

    def _chain(self, target: Target) -> tuple[dict[str, Tensor], int]:
        start = target.from_prior()
        with torch.no_grad():
            if target.log_evidence(start, 0) != target.log_evidence(start, 1):
                raise InputError("NUTS must have an exact evidence, this one depends on its seed: take another method")

        def potential(sites: dict[str, Tensor]) -> Tensor:
            return -target.log_density(sites["place"], 0)

        place = target.place(start)
        kernel = PyroNUTS(potential_fn=potential, full_mass=_ENOUGH * len(place) <= self.warmup)
        chain = MCMC(kernel, self.num_samples, self.warmup, initial_params={"place": place}, disable_progbar=True)
        chain.run()
        draws = target.values(chain.get_samples()["place"])
        return draws, len(chain.diagnostics()["divergences"]["chain 0"])
