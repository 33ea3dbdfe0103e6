"""Filters and smoothers: from observations to beliefs."""

from probtrack.filters.cloud import Cloud as Cloud
from probtrack.filters.kalman import Gaussian as Gaussian
from probtrack.filters.kalman import KalmanResult as KalmanResult
from probtrack.filters.kalman import LinearDynamics as LinearDynamics
from probtrack.filters.kalman import LinearSystem as LinearSystem
from probtrack.filters.kalman import kalman_filter as kalman_filter
from probtrack.filters.kalman import kalman_smoother as kalman_smoother
from probtrack.filters.kalman import position_system as position_system
from probtrack.filters.noise import FrameNoise as FrameNoise
from probtrack.filters.noise import NoiseStream as NoiseStream
from probtrack.filters.particle import Belief as Belief
from probtrack.filters.particle import ParticleFilter as ParticleFilter
from probtrack.filters.relocation import Relocation as Relocation
from probtrack.filters.resampling import Adaptive as Adaptive
from probtrack.filters.resampling import Resampler as Resampler
from probtrack.filters.resampling import StopGradient as StopGradient
