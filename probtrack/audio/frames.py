"""Overlapping frames of a multichannel signal and their spectra."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from probtrack._checks import check_int
from probtrack.errors import InputError


class Frames(NamedTuple):
    """Frames in time order, as samples and as spectra.

    Attributes:
        samples: (T, *batch, M, L), as recorded.
        spectrum: (T, *batch, M, L // 2 + 1), complex, of the windowed samples.
    """

    samples: Tensor
    spectrum: Tensor


class ShortTimeSpectrum(nn.Module):
    r"""Short-time Fourier transform with a Hann window, frames that start at sample 0.

    .. math:: S_m(t, f) = \sum_{n=0}^{L-1} w_n\, s_m(tH + n)\, e^{-2\pi j f n / L}

    Only whole frames are made: what is left over at the end waits for more samples.

    Args:
        frame_length: Samples L in a frame.
        hop: Samples H between the starts of neighbouring frames, at most L.

    Shape:
        samples (*batch, M, n). Returns `Frames` with T = (n - L) // H + 1, or 0 if n < L.
    """

    window: Tensor

    def __init__(self, frame_length: int = 512, hop: int = 256) -> None:
        super().__init__()
        self.frame_length = check_int(frame_length, "frame_length", low=16)
        self.hop = check_int(hop, "hop", low=1)
        if hop > frame_length:
            raise InputError(f"hop must be at most frame_length = {frame_length}, got {hop}")
        self.register_buffer("window", torch.hann_window(frame_length), persistent=False)

    def num_frames(self, num_samples: int) -> int:
        """Return how many whole frames `num_samples` hold."""
        return max(0, (num_samples - self.frame_length) // self.hop + 1)

    def forward(self, samples: Tensor) -> Frames:
        if samples.shape[-1] < self.frame_length:
            frames = samples.new_zeros((0, *samples.shape[:-1], self.frame_length))
        else:
            frames = samples.unfold(-1, self.frame_length, self.hop).movedim(-2, 0)
        windowed = frames * self.window
        if windowed.numel() == 0:  # which some FFT libraries refuse
            bins = self.frame_length // 2 + 1
            return Frames(frames, windowed.new_zeros((*frames.shape[:-1], bins), dtype=windowed.dtype.to_complex()))
        return Frames(frames, torch.fft.rfft(windowed))


def band_bins(band: tuple[float, float], fs: int, frame_length: int) -> tuple[int, int]:
    """Return the first and last frequency bin inside `band` [Hz]."""
    low, high = band
    if not 0 <= low < high <= fs / 2:
        raise InputError(f"band must satisfy 0 <= low < high <= fs / 2 = {fs / 2:g} Hz, got {low:g} to {high:g}")
    first, last = math.ceil(low * frame_length / fs), math.floor(high * frame_length / fs)
    if last < first:
        raise InputError(f"band from {low:g} to {high:g} Hz holds no bin of {fs / frame_length:g} Hz spacing")
    return first, last
