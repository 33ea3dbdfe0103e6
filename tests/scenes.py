"""Small recordings for the tests of commands and trackers."""

import pytest
import soundfile
import torch

from probtrack.geometry import MicrophoneArray, Region

ROOM = Region((0.0, 0.0, 0.0), (3.6, 3.1, 2.2))


def write_recording(path, samples, fs=16_000, subtype="FLOAT"):
    """Write samples (C, n) to `path` and return it as text."""
    soundfile.write(path, samples.t().numpy(), fs, subtype=subtype)
    return str(path)


def noise_from(point, array, seconds=1.5, quiet=0.5, fs=16_000):
    """Return (M, n): white sensor noise, and after `quiet` seconds loud noise from a fixed `point`."""
    generator = torch.Generator().manual_seed(3)
    length = round(seconds * fs)
    source = torch.randn(length, generator=generator)
    frequencies = torch.fft.rfftfreq(length, 1 / fs)
    delays = array.delays(torch.tensor(point))
    shift = torch.exp(-2j * torch.pi * frequencies * delays[:, None])
    heard = torch.fft.irfft(torch.fft.rfft(source) * shift, length)
    heard[:, : round(quiet * fs)] = 0
    return 0.1 * heard + 0.002 * torch.randn(heard.shape, generator=generator)


@pytest.fixture
def scene(tmp_path):
    """A folder with audio.wav and array.yaml of a loud point at (2.4, 1.1) heard by five microphones."""
    positions = [[0.6, 0.4, 1.3], [1.4, 0.4, 1.3], [3.0, 1.2, 1.3], [2.1, 2.7, 1.3], [0.5, 1.9, 1.3]]
    array = MicrophoneArray(positions, "five")
    array.to_yaml(tmp_path / "array.yaml", ROOM)
    write_recording(tmp_path / "audio.wav", noise_from((2.4, 1.1, 1.3), array))
    return tmp_path
