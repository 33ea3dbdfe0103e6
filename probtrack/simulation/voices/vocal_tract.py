"""How a voice sounds: glottal pulses and noise, shaped by formants that move."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

HOP = 0.005
"""Time between two settings of the vocal tract [s]."""

_OVERSAMPLING = 4
_BLOCK = 128  # settings that are worked out together
_RESPONSE = 0.064  # s, after which a resonance of 80 Hz bandwidth has fallen by 140 dB
_UPPER_FORMANTS = (
    (3500.0, 250.0),
    (4500.0, 350.0),
    (5500.0, 450.0),
    (6500.0, 550.0),
)  # Hz: centre, bandwidth


def glottal_pulses(pitch: Tensor, fs: int) -> Tensor:
    r"""Return the derivative of the flow through the glottis at the fundamental frequency `pitch` [Hz].

    One cycle of the flow, with phase :math:`u \in [0, 1)`, opening time p = 0.4 and closing time q = 0.16, is

    .. math:: g(u) = \tfrac12 (1 - \cos(\pi u / p)),\ u < p; \qquad \cos(\pi (u - p) / 2 q),\ u < p + q

    and 0 while the glottis is shut. It is made at four times `fs`, so that the sharp closure does not alias.

    Shape:
        pitch (S,), one value a sample. Returns (S,) of unit power.

    References:
        A. E. Rosenberg, "Effect of glottal pulse shape on the quality of natural vowels", J. Acoust. Soc. Am.
        49:583, 1971, pulse shape C.
    """
    opening, closing = 0.4, 0.16
    fine = pitch.repeat_interleave(_OVERSAMPLING)
    u = torch.remainder(torch.cumsum(fine.double() / (fs * _OVERSAMPLING), 0), 1.0)
    rise = torch.sin(math.pi * u / opening) / (2 * opening)
    fall = -torch.sin(math.pi * (u - opening) / (2 * closing)) / (2 * closing)
    slope = torch.where(u < opening, rise, torch.where(u < opening + closing, fall, torch.zeros(())))
    pulses = _decimate(slope)
    return pulses / pulses.square().mean().sqrt()


def _decimate(fine: Tensor) -> Tensor:
    """Return what is left below half the lower rate: an ideal low-pass, and every fourth sample."""
    count = len(fine) // _OVERSAMPLING
    size = (count // 512 + 2) * 512  # what rings beyond the ends wraps around into silence
    spectrum = torch.fft.rfft(fine, _OVERSAMPLING * size)[: size // 2 + 1]
    coarse: Tensor = torch.fft.irfft(spectrum, size)[:count]
    return coarse / _OVERSAMPLING


def resonances(centres: Tensor, bandwidths: Tensor, frequency: Tensor, fs: int) -> Tensor:
    """Return the frequency response of a cascade of resonators, of gain 1 at 0 Hz each.

    Shape:
        centres, bandwidths (..., R) [Hz], frequency (B,) [Hz]. Returns complex (..., B).

    References:
        D. H. Klatt, "Software for a cascade/parallel formant synthesizer", J. Acoust. Soc. Am. 67:971, 1980,
        Eq. 2.
    """
    delay = torch.exp(-2j * math.pi * frequency / fs)
    radius = torch.exp(-math.pi * bandwidths / fs)
    b = 2 * radius * torch.cos(2 * math.pi * centres / fs)
    c = -radius.square()
    denominator = torch.ones(())
    for r in range(centres.shape[-1]):  # one by one, for the sake of memory
        denominator = denominator * (1 - b[..., r, None] * delay - c[..., r, None] * delay**2)
    return (1 - b - c).prod(-1, keepdim=True) / denominator


def vocal_tract(formants: Tensor, bandwidths: Tensor, fs: int, scale: float = 1.0) -> Tensor:
    """Return responses (K, B) of the throat and mouth for F1 to F3; higher formants are those of a tube.

    Args:
        formants: F1 to F3, (K, 3) [Hz].
        bandwidths: Of F1 to F3, (K, 3) [Hz].
        fs: Sampling rate [Hz]. B is that of `filter_frames`.
        scale: Higher formants over those of a man [-].
    """
    tube = [(scale * centre, width) for centre, width in _UPPER_FORMANTS if scale * centre < 0.45 * fs]
    upper = torch.tensor(tube, dtype=formants.dtype).reshape(-1, 2)
    upper = upper.expand(len(formants), -1, 2)
    centres = torch.cat([formants, upper[..., 0]], -1)
    widths = torch.cat([bandwidths, upper[..., 1]], -1)
    return resonances(centres, widths, _bins(fs).to(formants), fs)


def friction(centre: Tensor, bandwidth: Tensor, fs: int) -> Tensor:
    """Return responses (K, B) of the mouth to noise made at a narrow place, one resonance each (K,) [Hz].

    A resonance that `fs` cannot hold moves down to 0.4 `fs`.
    """
    centre = centre.clamp(max=0.4 * fs)
    response = resonances(centre[:, None], bandwidth[:, None], _bins(fs).to(centre), fs)
    return response / response.abs().square().mean(-1, keepdim=True).sqrt()


def filter_frames(source: Tensor, count: int, respond: Callable[[slice], Tensor], fs: int) -> Tensor:
    """Filter `source` (S,) by `count` responses that follow each other every `HOP` seconds.

    Each is applied to the source under a window that fades over to the next one's; the windows add up to one.

    Args:
        source: (S,), S at most (count - 1) * hop.
        count: K.
        respond: Returns the responses (k, B) of a slice of the K: a few at a time, for the sake of memory.
        fs: Sampling rate [Hz].
    """
    hop, size = round(HOP * fs), _size(fs)
    window = torch.hann_window(2 * hop, dtype=source.dtype)
    padded = torch.nn.functional.pad(source, (hop, (count + 1) * hop - len(source)))
    frames = padded.unfold(0, 2 * hop, hop)
    summed = torch.zeros(count * hop + size, dtype=source.dtype)
    for first in range(0, count, _BLOCK):
        rows = slice(first, min(first + _BLOCK, count))
        filtered = torch.fft.irfft(torch.fft.rfft(frames[rows] * window, size) * respond(rows), size)
        length = (len(filtered) - 1) * hop + size
        added = torch.nn.functional.fold(filtered.T[None], (1, length), (1, size), stride=(1, hop)).flatten()
        summed[first * hop : first * hop + length] += added
    return summed[hop : hop + len(source)]


def _size(fs: int) -> int:
    return 1 << math.ceil(math.log2(_RESPONSE * fs))


def _bins(fs: int) -> Tensor:
    frequency: Tensor = torch.fft.rfftfreq(_size(fs), 1 / fs, dtype=torch.float64)
    return frequency
