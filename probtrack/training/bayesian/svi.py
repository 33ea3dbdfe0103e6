"""A Gaussian posterior fitted by its evidence lower bound, by pyro."""

from dataclasses import dataclass

import pyro
import torch
from pyro.infer import SVI as PyroSVI
from pyro.infer import Trace_ELBO
from pyro.infer.autoguide import AutoMultivariateNormal
from pyro.infer.autoguide.initialization import init_to_value
from pyro.optim import ClippedAdam

from probtrack._checks import as_positive, check_int
from probtrack.training.bayesian.target import Draws, Method, Target, new_seed

_FALL = 0.02  # of the learning rate over all steps: the noise of the last gradients averages out


@dataclass(frozen=True)
class SVI(Method):
    r"""Stochastic variational inference with a Gaussian of full covariance in unconstrained coordinates.

    .. math:: \max_q \; \mathrm E_q[\log \hat p(y \mid \theta(x)) + \log p(x) - \log q(x)]

    by reparameterised gradients, one draw of q and one seed of the evidence a step. An estimate of the evidence
    must carry the gradient of its weights (`StopGradient` resampling), and its logarithm is too low on average: by
    about half its variance, so that the posterior that is approximated is that of E[log p-hat]. Where that variance
    is large or changes with the parameters, `ParticleMetropolis` is right and this is not.

    Draws are independent. The notes have the lower bound after each step, `elbo` (steps,).

    Args:
        steps: Gradient steps.
        lr: Learning rate of the first step, which falls to a fiftieth.
        num_samples: S, draws of the fitted law, of one chain.

    References:
        A. Kucukelbir et al., "Automatic differentiation variational inference", JMLR 18, 2017, eq. 4 and 6, here
        with the full covariance (section 2.4).
    """

    steps: int = 1000
    lr: float = 0.05
    num_samples: int = 1000

    def __post_init__(self) -> None:
        check_int(self.steps, "steps", low=1)
        check_int(self.num_samples, "num_samples", low=4)
        as_positive(self.lr, "lr")

    def __call__(self, target: Target) -> Draws:
        start = target.from_prior()
        with torch.no_grad():
            target.log_evidence(start, 0)

        def model() -> None:
            pyro.factor("log_evidence", target.log_evidence(target.sampled(), new_seed()))

        with pyro.get_param_store().scope():
            guide = AutoMultivariateNormal(model, init_loc_fn=init_to_value(values=start))
            optimiser = ClippedAdam({"lr": self.lr, "lrd": _FALL ** (1 / self.steps)})
            svi = PyroSVI(model, guide, optimiser, Trace_ELBO())
            elbo = torch.tensor([-svi.step() for _ in range(self.steps)])
            with torch.no_grad():
                drawn = [guide() for _ in range(self.num_samples)]
        values = {latent.name: torch.stack([draw[latent.name] for draw in drawn])[None] for latent in target.latents}
        return Draws(values, {"elbo": elbo})
