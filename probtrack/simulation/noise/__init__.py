"""What microphones hear besides the talkers, and how loud it is."""

from probtrack.simulation.noise.base import Noise as Noise
from probtrack.simulation.noise.diffuse import DiffuseNoise as DiffuseNoise
from probtrack.simulation.noise.interferer import Interferer as Interferer
from probtrack.simulation.noise.levels import add_noise as add_noise
from probtrack.simulation.noise.levels import at_snr as at_snr
from probtrack.simulation.noise.levels import mixed as mixed
from probtrack.simulation.noise.recorded import RecordedNoise as RecordedNoise
from probtrack.simulation.noise.spectra import spectral_gain as spectral_gain
from probtrack.simulation.noise.white import WhiteNoise as WhiteNoise
