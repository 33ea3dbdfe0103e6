"""Densities that `torch.distributions` lacks."""

from probtrack.distributions.linear_gaussian import LinearGaussian as LinearGaussian
