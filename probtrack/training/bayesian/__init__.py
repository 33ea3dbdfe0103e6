"""Posterior laws of a module's parameters, from priors on their physical values and an evidence.

Needs pyro's inference, which is loaded when this room is first named.
"""

from probtrack.training.bayesian.fit import fit_posterior as fit_posterior
from probtrack.training.bayesian.metropolis import ParticleMetropolis as ParticleMetropolis
from probtrack.training.bayesian.nuts import NUTS as NUTS
from probtrack.training.bayesian.posterior import Posterior as Posterior
from probtrack.training.bayesian.svi import SVI as SVI
from probtrack.training.bayesian.target import Draws as Draws
from probtrack.training.bayesian.target import LogEvidence as LogEvidence
from probtrack.training.bayesian.target import Method as Method
from probtrack.training.bayesian.target import Target as Target
