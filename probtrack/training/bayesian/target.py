"""What is sampled: prior times evidence of a module's parameters."""

import abc
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import pyro
import torch
from pyro.distributions.torch_distribution import TorchDistributionMixin
from torch import Tensor, nn
from torch.func import functional_call

from probtrack.errors import InputError, NotFiniteError, ShapeError
from probtrack.training.bayesian.latents import latents_of

LogEvidence = Callable[[Any, int], Tensor]
"""`(module, seed) -> log p(y | parameters)`, of any shape and then summed; an exact evidence ignores the seed, an
estimate draws its random numbers from it and has the evidence, not its logarithm, as its mean."""

Values = Mapping[str, Tensor]
"""Physical value of every latent, by its name."""


class Draws(NamedTuple):
    """What a method returns.

    Attributes:
        values: Physical values, name -> (C, S, *shape), C chains of S draws.
        notes: What the method says of its run, name -> numbers.
    """

    values: dict[str, Tensor]
    notes: dict[str, Tensor]


class Target:
    r"""Posterior density of the latent values up to a constant,

    .. math:: \pi(x) \propto p(x)\, p(y \mid \theta(x)) ,

    where x are physical values, theta the parameters of the module, which is left as it is: it sees other parameters
    for the length of a call only. Parameters without a prior keep their values.

    Args:
        module: The models.
        priors: As for `latents_of`.
        log_evidence: As for `LogEvidence`.
    """

    def __init__(
        self, module: nn.Module, priors: Mapping[str, TorchDistributionMixin], log_evidence: LogEvidence
    ) -> None:
        self.module, self.latents = module, latents_of(module, priors)
        self._evidence = _Evidence(module, log_evidence)
        self._like = {latent.parameter: module.get_parameter(latent.parameter) for latent in self.latents}

    def log_evidence(self, values: Values, seed: int) -> Tensor:
        """Return log p(y | values), a number, estimated with `seed` if it is an estimate.

        Raises:
            NotFiniteError: naming the values, if it is not finite or the models refuse the values.
        """
        replaced = {
            f"module.{latent.parameter}": latent.to_parameter(values[latent.name]).to(self._like[latent.parameter])
            for latent in self.latents
        }
        try:
            total: Tensor = functional_call(self._evidence, replaced, (seed,)).sum()
        except ShapeError:
            raise
        except InputError as error:
            raise NotFiniteError(f"log_evidence failed at {described(values)}: {error}") from None
        if not total.isfinite():
            raise NotFiniteError(f"log_evidence must be finite, got {total.item()} at {described(values)}")
        return total

    def log_density(self, place: Tensor, seed: int) -> Tensor:
        """Return log pi at `place` (K,) in unconstrained coordinates, with the Jacobian of the map to the values.

        Where the models refuse the values or the evidence is not finite it is -inf: a sampler does not go there,
        and goes on.
        """
        values = self.values(place)
        level = place.new_zeros(())
        for latent, z in zip(self.latents, self._parts(place), strict=True):
            value = values[latent.name]
            level = level + latent.prior.log_prob(value) + latent.support.log_abs_det_jacobian(z, value).sum()
        try:
            return (level + self.log_evidence(values, seed)).to(place) if level.isfinite() else _nowhere(place)
        except NotFiniteError:
            return _nowhere(place)

    def place(self, values: Values) -> Tensor:
        """Return where `values` are in unconstrained coordinates (K,)."""
        return torch.cat([latent.support.inv(values[latent.name]).flatten() for latent in self.latents])

    def values(self, places: Tensor) -> dict[str, Tensor]:
        """Return the physical values (..., *shape) at `places` (..., K)."""
        parts = zip(self.latents, self._parts(places), strict=True)
        return {latent.name: latent.support(z) for latent, z in parts}

    def _parts(self, places: Tensor) -> list[Tensor]:
        """Return the coordinates of each latent, in the shape that its support maps from."""
        shapes = [latent.support.inverse_shape(latent.prior.shape()) for latent in self.latents]
        parts = places.split([torch.Size(shape).numel() for shape in shapes], -1)
        return [part.reshape((*places.shape[:-1], *shape)) for part, shape in zip(parts, shapes, strict=True)]

    def from_prior(self) -> dict[str, Tensor]:
        """Return a draw of the prior."""
        return {latent.name: latent.prior.sample() for latent in self.latents}

    def sampled(self) -> dict[str, Tensor]:
        """Return the values at pyro's sample sites, one a latent."""
        return {latent.name: pyro.sample(latent.name, latent.prior) for latent in self.latents}


class Method(abc.ABC):
    """A way to draw from a posterior."""

    @abc.abstractmethod
    def __call__(self, target: Target) -> Draws:
        """Return draws of `target`, by the random numbers of torch's generator."""


class _Evidence(nn.Module):
    """The evidence as the forward of a module, so that parameters can be replaced for a call."""

    def __init__(self, module: nn.Module, log_evidence: LogEvidence) -> None:
        super().__init__()
        self.module, self.log_evidence = module, log_evidence

    def forward(self, seed: int) -> Tensor:
        return self.log_evidence(self.module, seed)


def _nowhere(place: Tensor) -> Tensor:
    """Return -inf, with a gradient of zero."""
    return (0 * place).sum() - torch.inf


def described(values: Values) -> str:
    """Return values in a line of text."""
    numbers = {name: [float(f"{x:.4g}") for x in value.detach().flatten().tolist()] for name, value in values.items()}
    return ", ".join(f"{name} = {x[0] if len(x) == 1 else x}" for name, x in numbers.items())


def new_seed() -> int:
    """Return a seed drawn from torch's generator."""
    return int(torch.randint(2**31, ()))
