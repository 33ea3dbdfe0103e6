"""Colours of noise: how its power is spread over frequency."""

from collections.abc import Callable

import torch
from torch import Tensor

from probtrack.errors import InputError

_AUDIBLE = 20.0  # Hz; pink noise would be infinite at 0


def spectral_gain(spectrum: str, frequency: Tensor) -> Tensor:
    """Return the amplitude gain at each `frequency` (F,) [Hz] that gives white noise a colour.

    - `white`: equal power in bands of equal width.
    - `pink`: power density 1 / f, as in bands of equal ratio; constant below 20 Hz.
    - `speech`: the long-term average of speech, by its trend: power density constant from 100 to 500 Hz, from
      there falling by 9 dB an octave, and by 12 dB an octave below 100 Hz; corners rounded by 3 dB. (A shape of
      our own: measured averages lie about it by some dB.)
    - `fan`: the hiss of moving air, power density constant up to 250 Hz and falling by 6 dB an octave above.

    >>> spectral_gain("pink", torch.tensor([64.0, 256.0])).tolist()
    [0.125, 0.0625]
    """
    if spectrum not in _GAINS:
        raise InputError(f"spectrum must be one of {', '.join(_GAINS)}, got {spectrum!r}")
    return _GAINS[spectrum](frequency)


def coloured(noise: Tensor, spectrum: str, fs: float) -> Tensor:
    """Return white `noise` (..., S) in a colour of `spectral_gain`, by filtering around the circle of S samples."""
    size = noise.shape[-1]
    gain = spectral_gain(spectrum, torch.fft.rfftfreq(size, 1 / fs, dtype=noise.dtype))
    filtered: Tensor = torch.fft.irfft(torch.fft.rfft(noise) * gain, size)
    return filtered


def _white(frequency: Tensor) -> Tensor:
    return torch.ones_like(frequency)


def _pink(frequency: Tensor) -> Tensor:
    return frequency.clamp(min=_AUDIBLE).rsqrt()


def _speech(frequency: Tensor) -> Tensor:
    low, high = (frequency / 100).square(), (frequency / 500).square()
    return low / (1 + low.square()).sqrt() / (1 + high) ** 0.75


def _fan(frequency: Tensor) -> Tensor:
    return (1 + (frequency / 250).square()).rsqrt()


_GAINS: dict[str, Callable[[Tensor], Tensor]] = {"white": _white, "pink": _pink, "speech": _speech, "fan": _fan}
