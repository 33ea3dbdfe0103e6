"""Frames and their spectra, and the bins of a band."""

import numpy as np
import pytest
import torch

from probtrack.audio import ShortTimeSpectrum
from probtrack.audio.frames import band_bins
from probtrack.errors import InputError


@pytest.mark.parametrize(("length", "hop"), [(512, 256), (64, 64), (50, 17)])
def test_frames_are_the_samples_from_t_times_hop(length, hop):
    samples = torch.randn(2, 3, 1000)
    frames = ShortTimeSpectrum(length, hop)(samples)
    assert frames.samples.shape == ((1000 - length) // hop + 1, 2, 3, length)
    for t in (0, 1, len(frames.samples) - 1):
        assert torch.equal(frames.samples[t], samples[..., t * hop : t * hop + length])


def test_spectrum_is_the_sum_of_its_formula():
    samples, stft = torch.randn(3, 200), ShortTimeSpectrum(50, 17)
    n, f = np.arange(50), np.arange(26)[:, None]
    window = 0.5 - 0.5 * np.cos(2 * np.pi * n / 50)
    waves = np.exp(-2j * np.pi * f * n / 50)
    exact = (window * samples[1, 68:118].numpy() * waves).sum(1)
    torch.testing.assert_close(stft(samples).spectrum[4, 1], torch.tensor(exact))


@pytest.mark.parametrize(("samples", "frames"), [(0, 0), (49, 0), (50, 1), (66, 1), (67, 2), (1000, 56)])
def test_only_whole_frames_are_made(samples, frames):
    stft = ShortTimeSpectrum(50, 17)
    made = stft(torch.randn(2, 3, samples))
    assert stft.num_frames(samples) == frames
    assert made.samples.shape == (frames, 2, 3, 50)
    assert made.spectrum.shape == (frames, 2, 3, 26)
    assert made.spectrum.dtype == torch.complex128


def test_shifting_by_a_hop_shifts_the_frames():
    samples, stft = torch.randn(2, 500), ShortTimeSpectrum(64, 24)
    assert torch.equal(stft(samples).spectrum[1:], stft(samples[:, 24:]).spectrum)


def test_float32_stays_float32():
    assert ShortTimeSpectrum(64, 32).float()(torch.randn(2, 100).float()).spectrum.dtype == torch.complex64


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ((512, 513), "hop must be at most frame_length = 512, got 513"),
        ((512, 0), "hop must be an integer of at least 1, got 0"),
        ((15, 1), "frame_length must be an integer of at least 16, got 15"),
        ((512.0, 256), "frame_length must be an integer"),
    ],
)
def test_rejects_frame_sizes(arguments, match):
    with pytest.raises(InputError, match=match):
        ShortTimeSpectrum(*arguments)


def test_bins_of_a_band_lie_inside_it():
    assert band_bins((300.0, 3000.0), 16000, 512) == (10, 96)  # 312.5 Hz to 3000 Hz
    assert band_bins((312.5, 3030.0), 16000, 512) == (10, 96)
    assert band_bins((0.0, 8000.0), 16000, 512) == (0, 256)


@pytest.mark.parametrize("band", [(3000.0, 300.0), (-1.0, 300.0), (300.0, 8001.0), (300.0, float("nan"))])
def test_rejects_bands_that_cannot_be(band):
    with pytest.raises(InputError, match=r"band must satisfy 0 <= low < high <= fs / 2 = 8000 Hz"):
        band_bins(band, 16000, 512)


def test_rejects_a_band_between_bins():
    with pytest.raises(InputError, match=r"band from 315 to 330 Hz holds no bin of 31.25 Hz spacing"):
        band_bins((315.0, 330.0), 16000, 512)
