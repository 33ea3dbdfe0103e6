"""Densities that `torch.distributions` lacks."""

from probtrack.distributions.concatenated import Concatenated as Concatenated
from probtrack.distributions.linear_gaussian import LinearGaussian as LinearGaussian
from probtrack.distributions.peaks_among_clutter import PeaksAmongClutter as PeaksAmongClutter
from probtrack.distributions.peaks_among_clutter import equal_priors as equal_priors
from probtrack.distributions.pushforward import Pushforward as Pushforward
from probtrack.distributions.switched import Switched as Switched
from probtrack.distributions.target_or_clutter import TargetOrClutter as TargetOrClutter
from probtrack.distributions.truncated_normal import TruncatedNormal as TruncatedNormal
from probtrack.distributions.wrapped_gaussian import WrappedGaussian as WrappedGaussian
from probtrack.distributions.wrapped_normal import WrappedNormal as WrappedNormal
