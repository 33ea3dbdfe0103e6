"""Sound for the benchmarks: a synthetic talker who stands in a room without echo, and noise."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import soundfile
import torch
from torch import Tensor

from probtrack.geometry import SPEED_OF_SOUND, MicrophoneArray, shipped_arrays
from probtrack.simulation.voices import SyntheticVoice, SyntheticVoices, TurnTaking

FS = 16_000
ARRAY = shipped_arrays()["lehmann2007"]
PLACE = (1.2, 1.9, 1.51)  # m, where the talker stands


def array() -> MicrophoneArray:
    """Return the array of S1: eight microphones around a room of 3.5 x 3.1 m."""
    return MicrophoneArray.from_yaml(ARRAY)


def talker(seconds: float, seed: int = 0) -> Tensor:
    """Return (8, seconds * FS) samples: speech with each microphone's delay in whole samples, and noise."""
    generator = torch.Generator().manual_seed(seed)
    turns = TurnTaking().draw(1, seconds, generator)
    voices = SyntheticVoices((SyntheticVoice(),))
    speech = voices.speak(turns, duration=seconds, fs=FS, seed=seed)[0].samples
    distances = (array().positions - torch.tensor(PLACE)).norm(dim=-1)
    delays = (distances / SPEED_OF_SOUND * FS).round().long().tolist()
    heard = torch.stack([speech.roll(delay) for delay in delays])
    return heard + 0.003 * torch.randn(heard.shape, generator=generator)


def write(path: Path, seconds: float) -> Path:
    """Write a recording of `seconds` as 16-bit sound to `path`, ten seconds of talk over and over."""
    with soundfile.SoundFile(str(path), "w", samplerate=FS, channels=8, subtype="PCM_16") as file:
        for block in _blocks(seconds):
            file.write(block)
    return path


def _blocks(seconds: float) -> Iterator[np.ndarray]:
    block = talker(10.0).t().contiguous().numpy()
    left = round(seconds * FS)
    while left > 0:
        yield block[:left]
        left -= len(block)
