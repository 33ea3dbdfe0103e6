"""Draws of a posterior and what to do with them."""

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from pyro.ops.stats import effective_sample_size, split_gelman_rubin
from torch import Tensor, nn

from probtrack._checks import check_int
from probtrack.errors import InputError
from probtrack.training.bayesian.latents import Latent

M = TypeVar("M", bound=nn.Module)


@dataclass(frozen=True)
class Posterior(Generic[M]):
    """Draws of the posterior of a module's parameters.

    Attributes:
        module: The module that was fitted, as it was.
        latents: Its uncertain parameters.
        values: Physical values, name -> (C, S, *shape), C chains of S draws.
        notes: What the method says of its run, see there.
    """

    module: M
    latents: tuple[Latent, ...]
    values: dict[str, Tensor]
    notes: dict[str, Tensor]

    @property
    def parameters(self) -> dict[str, Tensor]:
        """The same draws as unconstrained parameters, under the module's names for these, (C, S, *shape)."""
        return {latent.parameter: latent.to_parameter(self.values[latent.name]) for latent in self.latents}

    def mean(self) -> dict[str, Tensor]:
        """Return the posterior mean of each physical value (*shape)."""
        return {name: value.mean((0, 1)) for name, value in self.values.items()}

    def std(self) -> dict[str, Tensor]:
        """Return the posterior standard deviation of each physical value (*shape)."""
        return {name: value.flatten(0, 1).std(0) for name, value in self.values.items()}

    def interval(self, probability: float = 0.9) -> dict[str, Tensor]:
        """Return the ends of the central interval of that probability, (2, *shape)."""
        if not 0 < probability < 1:
            raise InputError(f"probability must be in (0, 1), got {probability}")
        ends = torch.tensor([0.5 - probability / 2, 0.5 + probability / 2])
        return {name: value.flatten(0, 1).quantile(ends.to(value), 0) for name, value in self.values.items()}

    def r_hat(self) -> dict[str, Tensor]:
        """Return the split-chain scale reduction of each physical value (*shape): 1 where chains agree.

        References:
            A. Gelman et al., "Bayesian Data Analysis", 3rd edition, 2013, eq. 11.4.
        """
        return {name: split_gelman_rubin(value) for name, value in self.values.items()}

    def effective_sample_size(self) -> dict[str, Tensor]:
        """Return how many independent draws tell a mean as well as these (*shape).

        References:
            A. Gelman et al., "Bayesian Data Analysis", 3rd edition, 2013, eq. 11.8.
        """
        return {name: effective_sample_size(value) for name, value in self.values.items()}

    def mean_module(self) -> M:
        """Return a copy of the module with the posterior mean of the physical values."""
        return self._with(self.mean())

    def modules(self, count: int) -> Iterator[M]:
        """Yield copies of the module, each with one of `count` draws that are spread evenly over all.

        What a talker will do, whatever the parameters, is the mixture of what these say.
        """
        check_int(count, "count", low=1)
        flat = {name: value.flatten(0, 1) for name, value in self.values.items()}
        total = len(next(iter(flat.values())))
        for i in range(count):
            yield self._with({name: value[(2 * i + 1) * total // (2 * count)] for name, value in flat.items()})

    def table(self, probability: float = 0.9) -> str:
        """Return one line a number: mean, standard deviation, interval, r-hat and effective sample size."""
        columns = (
            self.mean(), self.std(), self.interval(probability), self.r_hat(), self.effective_sample_size()
        )  # fmt: skip
        heads = ["", "mean", "std", *(f"{50 * (1 + sign * probability):g} %" for sign in (-1, 1)), "r-hat", "ESS"]
        rows = [heads]
        for name in self.values:
            numbers = torch.cat([column[name].reshape(-1, columns[0][name].numel()) for column in columns]).T
            labels = _labels(name, columns[0][name].shape)
            rows += [[label, *(f"{x:.4g}" for x in row)] for label, row in zip(labels, numbers.tolist(), strict=True)]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        return "\n".join(
            "  ".join([row[0].ljust(widths[0]), *(x.rjust(w) for x, w in zip(row[1:], widths[1:], strict=True))])
            for row in rows
        )

    def _with(self, values: dict[str, Tensor]) -> M:
        module = copy.deepcopy(self.module)
        with torch.no_grad():
            for latent in self.latents:
                module.get_parameter(latent.parameter).copy_(latent.to_parameter(values[latent.name]))
        return module


def _labels(name: str, shape: torch.Size) -> list[str]:
    """Return the name of each number of a value of that shape."""
    places = torch.cartesian_prod(*map(torch.arange, shape)).view(-1, len(shape)).tolist() if shape else [[]]
    return [name + "".join(f"[{i}]" for i in place) for place in places]
