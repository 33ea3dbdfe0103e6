"""Which parameters of a module are uncertain: names of their physical values, priors, and the maps between."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from pyro.distributions.torch_distribution import TorchDistributionMixin
from torch import Tensor, nn
from torch.distributions import biject_to, constraints
from torch.distributions.transforms import Transform

from probtrack.errors import InputError, ShapeError

_FAR = 20.0  # in unconstrained coordinates: bounds of a support to 2e-9 of its width


class Latent(NamedTuple):
    """One uncertain parameter.

    Attributes:
        name: Of the physical value, `rate` of the parameter `log_rate`, with the path of its module.
        parameter: Name of the parameter.
        prior: Law of the physical value; its event is the whole of it.
        to_parameter: The map from the physical value to the parameter: log, logit or none.
        support: The map from unconstrained coordinates (..., K) to the support of the prior.
    """

    name: str
    parameter: str
    prior: TorchDistributionMixin
    to_parameter: Callable[[Tensor], Tensor]
    support: Transform


def latents_of(module: nn.Module, priors: Mapping[str, TorchDistributionMixin]) -> tuple[Latent, ...]:
    """Return the parameters that have a prior, in the order of the priors.

    Args:
        module: Any module.
        priors: Name of a physical value -> pyro distribution of that value, whose batch and event shapes make up
            the parameter's shape. The name is that of the parameter without `log_` or `logit_`.

    Raises:
        InputError: for a name that is not in the module, what is no pyro distribution, no prior at all, or a prior
            that gives probability to values that the parameter cannot take.
        ShapeError: for a prior of another shape than the parameter's.
    """
    known = {physical_name(name): (name, parameter) for name, parameter in module.named_parameters()}
    if not priors:
        raise InputError(f"priors must name at least one of {', '.join(known)}, got none")
    return tuple(_latent(name, prior, known) for name, prior in priors.items())


def physical_name(parameter: str) -> str:
    """Return the name of the physical value of a parameter.

    >>> physical_name("axis_model.process.log_rate"), physical_name("chain.logit_transition")
    ('axis_model.process.rate', 'chain.transition')
    """
    path, dot, own = parameter.rpartition(".")
    return path + dot + own.removeprefix("log_").removeprefix("logit_")


def _latent(name: str, prior: TorchDistributionMixin, known: Mapping[str, tuple[str, nn.Parameter]]) -> Latent:
    if name not in known:
        raise InputError(f"priors must be of {', '.join(known)}, got {name!r}")
    if not isinstance(prior, TorchDistributionMixin):
        raise InputError(f"the prior of {name} must be one of pyro.distributions, got {type(prior).__name__}")
    parameter, value = known[name]
    if prior.shape() != value.shape:
        raise ShapeError(f"the prior of {name} must have shape {tuple(value.shape)}, got {tuple(prior.shape())}")
    whole = prior.to_event(len(prior.batch_shape))
    support = biject_to(whole.support)
    to_parameter, domain, said = _map_of(parameter, value.ndim)
    far = torch.full(support.inverse_shape(value.shape), _FAR)
    if not all(domain.check(support(sign * far)).all() for sign in (-1, 0, 1)):
        raise InputError(f"the prior of {name} must have a support of {said}, got {whole.support}")
    return Latent(name, parameter, whole, to_parameter, support)


def _map_of(parameter: str, ndim: int) -> tuple[Callable[[Tensor], Tensor], constraints.Constraint, str]:
    """Return the map to a parameter, what it takes, and how that is called; the name of a parameter says its map."""
    own = parameter.rpartition(".")[2]
    if own.startswith("log_"):
        return torch.log, constraints.positive, "positive numbers"
    if own.startswith("logit_") and ndim > 0:  # probabilities of a choice, the softmax of their parameter
        return torch.log, constraints.simplex, "probabilities that sum to 1"
    if own.startswith("logit_"):
        return torch.logit, constraints.unit_interval, "probabilities"
    return (lambda value: value), constraints.real, "real numbers"
