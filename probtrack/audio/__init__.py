"""Front end: recordings, frames, correlations of microphone pairs, steered power and voice activity."""

from probtrack.audio.frames import Frames as Frames
from probtrack.audio.frames import ShortTimeSpectrum as ShortTimeSpectrum
from probtrack.audio.front_end import FrontEnd as FrontEnd
from probtrack.audio.front_end import FrontEndState as FrontEndState
from probtrack.audio.front_end import Observations as Observations
from probtrack.audio.gcc import GeneralisedCrossCorrelation as GeneralisedCrossCorrelation
from probtrack.audio.io import ChannelSurvey as ChannelSurvey
from probtrack.audio.io import Recording as Recording
from probtrack.audio.srp import SteeredResponsePower as SteeredResponsePower
from probtrack.audio.vad import EnergyVoiceActivity as EnergyVoiceActivity
from probtrack.audio.vad import SileroVoiceActivity as SileroVoiceActivity
from probtrack.audio.vad import VoiceActivity as VoiceActivity
