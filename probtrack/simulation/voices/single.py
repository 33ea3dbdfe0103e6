"""One talker in one call."""

import math
from pathlib import Path

import torch

from probtrack.simulation.voices.activity import speech_activity
from probtrack.simulation.voices.base import Speech, at_level
from probtrack.simulation.voices.material import read_mono
from probtrack.simulation.voices.synthetic import SyntheticVoice, SyntheticVoices
from probtrack.simulation.voices.turns import TurnTaking


def synthesise_speech(duration: float, fs: int = 16000, *, generator: torch.Generator, pitch: float = 115.0) -> Speech:
    """Return babble of a man's voice in `TurnTaking` of one talker: see `SyntheticVoices`.

    Args:
        duration: Length [s].
        fs: Sampling rate [Hz], at least 8000.
        generator: Draws what is said; the same seed says the same.
        pitch: Mean fundamental frequency [Hz].
    """
    turns = TurnTaking().draw(1, duration, generator)
    seed = int(torch.randint(2**62, (), generator=generator))
    return SyntheticVoices((SyntheticVoice(pitch=pitch),)).speak(turns, duration=duration, fs=fs, seed=seed)[0]


def load_speech(path: str | Path, fs: int, duration: float) -> Speech:
    """Return `duration` [s] of a recording at `fs` [Hz], from its start, and over again where it is shorter.

    Channels are averaged, what is below 60 Hz is removed, and the level is that of `synthesise_speech`.
    When it speaks is judged by its energy over its own noise floor: see `speech_activity`.

    Raises:
        InputError: for a file that cannot be read or holds no sound.
    """
    mono = read_mono(path, fs)
    size = round(duration * fs)
    samples = mono.repeat(math.ceil(size / len(mono)))[:size]
    active = speech_activity(samples, fs)
    return Speech(at_level(samples, active), active)
