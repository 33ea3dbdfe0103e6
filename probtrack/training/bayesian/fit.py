"""From priors and an evidence to a posterior."""

from collections.abc import Mapping

import torch
from pyro.distributions.torch_distribution import TorchDistributionMixin

from probtrack._checks import check_int
from probtrack.training.bayesian.posterior import M, Posterior
from probtrack.training.bayesian.target import LogEvidence, Method, Target


def fit_posterior(
    module: M,
    priors: Mapping[str, TorchDistributionMixin],
    log_evidence: LogEvidence,
    method: Method,
    *,
    seed: int = 0,
) -> Posterior[M]:
    r"""Return the posterior :math:`p(x \mid y) \propto p(x)\, p(y \mid x)` of physical values x of a module.

    Neither the module, pyro's parameter store nor torch's generator is changed.

    Args:
        module: The models; parameters that no prior names keep their values.
        priors: Name of a physical value -> pyro distribution of it, in its unit. The name is that of the parameter
            without its map: `axis_model.process.rate` [1/s] for the parameter `axis_model.process.log_rate`. The
            rows of a Markov chain take `Dirichlet` laws.
        log_evidence: `(module, seed) -> log p(y | parameters of the module)`, of any shape, which is summed. The
            Kalman filter's ignores the seed; the particle filter's draws its random numbers by it.
        method: `NUTS` for an exact evidence, `ParticleMetropolis` for an estimated one, `SVI` for a quick look at
            either.
        seed: Of all random numbers.

    Raises:
        InputError: for priors that do not go with the module (see `latents_of`) or a method that does not go with
            the evidence.
        NotFiniteError: for an evidence that is not finite where a chain starts, naming the values.

    >>> import pyro.distributions as dist
    >>> from probtrack.likelihoods import GaussianPosition
    >>> from probtrack.training.bayesian import SVI, fit_posterior
    >>> heard = torch.linspace(-0.3, 0.3, 40)
    >>> def log_evidence(model, seed):
    ...     return dist.Normal(0.0, model.log_std.exp()).log_prob(heard)
    >>> posterior = fit_posterior(
    ...     GaussianPosition(1.0), {"std": dist.LogNormal(-1.0, 1.0)}, log_evidence, SVI(steps=300)
    ... )
    >>> round(posterior.mean()["std"].item(), 1)
    0.2
    """
    check_int(seed, "seed", low=0)
    target = Target(module, priors, log_evidence)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        draws = method(target)
    return Posterior(module, target.latents, draws.values, draws.notes)
