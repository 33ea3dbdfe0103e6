"""Who speaks when, and what it sounds like: synthetic voices whose truth is known, and recorded ones."""

from probtrack.simulation.voices.activity import speech_activity as speech_activity
from probtrack.simulation.voices.base import LEVEL as LEVEL
from probtrack.simulation.voices.base import Speech as Speech
from probtrack.simulation.voices.base import Voices as Voices
from probtrack.simulation.voices.base import VoiceScore as VoiceScore
from probtrack.simulation.voices.phonemes import VOWELS as VOWELS
from probtrack.simulation.voices.recorded import RecordedVoices as RecordedVoices
from probtrack.simulation.voices.synthetic import SyntheticVoice as SyntheticVoice
from probtrack.simulation.voices.synthetic import SyntheticVoices as SyntheticVoices
from probtrack.simulation.voices.synthetic import sustained_vowel as sustained_vowel
from probtrack.simulation.voices.turns import GivenTurns as GivenTurns
from probtrack.simulation.voices.turns import Schedule as Schedule
from probtrack.simulation.voices.turns import Turns as Turns
from probtrack.simulation.voices.turns import TurnTaking as TurnTaking
