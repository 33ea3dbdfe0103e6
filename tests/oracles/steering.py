"""Beamformer of Lehmann and Johansson (2007), eq. 2, frequency by frequency, and waves to point it at."""

import numpy as np


def phat_frames(samples, length, hop):
    """Spectra (T, M, F) of Hann-windowed frames of samples (M, n), each bin divided by its magnitude."""
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(length) / length)
    starts = range(0, samples.shape[1] - length + 1, hop)
    spectra = np.stack([np.fft.rfft(samples[:, s : s + length] * window) for s in starts])
    return spectra / np.abs(spectra)


def steered_power(spectra, positions, point, *, fs, length, band=(300.0, 3000.0), c=343.0):
    """Sum over the band of |sum over m of S_m / |S_m| exp(j omega |l - l_m| / c)|^2, one number a frame (T,)."""
    frequency = np.arange(spectra.shape[-1]) * fs / length
    delay = np.sqrt(((positions - point) ** 2).sum(1)) / c
    steered = spectra * np.exp(2j * np.pi * frequency * delay[:, None])
    inside = (frequency >= band[0]) & (frequency <= band[1])
    return (np.abs(steered.sum(1)) ** 2)[:, inside].sum(1)


def delayed(source, delays, fs):
    """Return source (n,) delayed by each of `delays` [s] (M, n), any fraction of a sample, round a circle."""
    frequency = np.fft.rfftfreq(len(source), 1 / fs)
    shift = np.exp(-2j * np.pi * frequency * np.asarray(delays)[:, None])
    return np.fft.irfft(np.fft.rfft(source) * shift, len(source))


def spherical_wave(source, point, positions, fs, c=343.0):
    """Return what microphones at `positions` (M, A) hear of `source` (n,) at `point`, with 1 / distance."""
    distance = np.sqrt(((positions - point) ** 2).sum(1))
    return delayed(source, distance / c, fs) / distance[:, None]
