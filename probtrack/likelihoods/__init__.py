"""Observation models: log p(y_t | x_t)."""

from probtrack.likelihoods.base import EvidenceMap as EvidenceMap
from probtrack.likelihoods.base import Likelihood as Likelihood
from probtrack.likelihoods.gaussian import GaussianPosition as GaussianPosition
from probtrack.likelihoods.gaussian import Positions as Positions
from probtrack.likelihoods.steered_power import PreparedPower as PreparedPower
from probtrack.likelihoods.steered_power import SteeredPowerLikelihood as SteeredPowerLikelihood
