"""Resampling schemes, one a file, and what wraps them."""

from probtrack.filters.resampling.adaptive import Adaptive as Adaptive
from probtrack.filters.resampling.adaptive import effective_sample_size as effective_sample_size
from probtrack.filters.resampling.base import Ancestral as Ancestral
from probtrack.filters.resampling.base import Resampler as Resampler
from probtrack.filters.resampling.multinomial import multinomial as multinomial
from probtrack.filters.resampling.multinomial import multinomial_offspring as multinomial_offspring
from probtrack.filters.resampling.residual import residual as residual
from probtrack.filters.resampling.residual import residual_offspring as residual_offspring
from probtrack.filters.resampling.stratified import stratified as stratified
from probtrack.filters.resampling.stratified import stratified_offspring as stratified_offspring
from probtrack.filters.resampling.systematic import systematic as systematic
from probtrack.filters.resampling.systematic import systematic_offspring as systematic_offspring
