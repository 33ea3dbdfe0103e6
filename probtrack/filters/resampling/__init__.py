"""Resampling schemes, one a file, and what wraps them."""

from probtrack.filters.resampling.adaptive import Adaptive as Adaptive
from probtrack.filters.resampling.adaptive import effective_sample_size as effective_sample_size
from probtrack.filters.resampling.base import Ancestral as Ancestral
from probtrack.filters.resampling.base import Copying as Copying
from probtrack.filters.resampling.base import Law as Law
from probtrack.filters.resampling.base import Resampler as Resampler
from probtrack.filters.resampling.kernel import KernelMixture as KernelMixture
from probtrack.filters.resampling.marginal import MarginalStopGradient as MarginalStopGradient
from probtrack.filters.resampling.multinomial import multinomial as multinomial
from probtrack.filters.resampling.multinomial import multinomial_ends as multinomial_ends
from probtrack.filters.resampling.residual import residual as residual
from probtrack.filters.resampling.residual import residual_ends as residual_ends
from probtrack.filters.resampling.soft import Soft as Soft
from probtrack.filters.resampling.stop_gradient import StopGradient as StopGradient
from probtrack.filters.resampling.stratified import stratified as stratified
from probtrack.filters.resampling.stratified import stratified_ends as stratified_ends
from probtrack.filters.resampling.systematic import systematic as systematic
from probtrack.filters.resampling.systematic import systematic_ends as systematic_ends
from probtrack.filters.resampling.transport import OptimalTransport as OptimalTransport
