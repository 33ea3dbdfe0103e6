"""Recordings with truth: voices, walks, rooms and scenes on disk."""

from probtrack.simulation.paths import Walk as Walk
from probtrack.simulation.paths import smooth_path as smooth_path
from probtrack.simulation.rooms import LEAD as LEAD
from probtrack.simulation.rooms import ShoeboxRoom as ShoeboxRoom
from probtrack.simulation.rooms import reverberation_time as reverberation_time
from probtrack.simulation.scenes import Recording as Recording
from probtrack.simulation.scenes import Scene as Scene
from probtrack.simulation.scenes import Truth as Truth
from probtrack.simulation.scenes import add_noise as add_noise
from probtrack.simulation.scenes import demo_scene as demo_scene
from probtrack.simulation.voices import VOWELS as VOWELS
from probtrack.simulation.voices import Speech as Speech
from probtrack.simulation.voices import load_speech as load_speech
from probtrack.simulation.voices import speech_activity as speech_activity
from probtrack.simulation.voices import sustained_vowel as sustained_vowel
from probtrack.simulation.voices import synthesise_speech as synthesise_speech
