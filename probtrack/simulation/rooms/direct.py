"""The sound that comes from a moving mouth straight to microphones."""

import math

import torch
from torch import Tensor

from probtrack.simulation.motion import Motion
from probtrack.simulation.rooms.directivity import Directivity

_UP = 8  # steps to a sample, between which is interpolated cubically
_MARGIN = 64  # samples of silence at both ends
_NEAREST = 0.05  # m; amplitudes grow no more when a mouth comes nearer to a microphone


def direct_sound(
    signal: Tensor,
    motion: Motion,
    microphones: Tensor,
    directivity: Directivity | None,
    fs: int,
    speed_of_sound: float,
) -> Tensor:
    """Return (M, S), what `microphones` (M, 3) hear of `signal` (S,) without any reflection.

    Delay, loss and the angle off the mouth's axis follow the talker from sample to sample: sound that arrives
    now was emitted where the mouth was then, so that the Doppler shift is right too. The filters of the directivity
    have no phase.
    """
    shaped = _shaped(signal, directivity, fs)
    ahead = torch.stack([motion.mouth.cos(), motion.mouth.sin()], -1).to(signal)
    heard = []
    for microphone in microphones.to(motion.position):
        offset = microphone - motion.position
        distance = offset.square().sum(-1).sqrt().clamp(min=_NEAREST)
        emitted = shaped[0]
        if directivity is not None:
            cosine = ((offset[:, :2] / distance[:, None]).to(signal) * ahead).sum(-1)
            emitted = emitted + cosine * (shaped[1] + cosine * shaped[2])
        at = _emission(distance.double() * fs / speed_of_sound)
        heard.append(_sampled_at(emitted / distance.to(signal), at))
    return torch.stack(heard)


def _shaped(signal: Tensor, directivity: Directivity | None, fs: int) -> Tensor:
    """Return `signal` (S,) through the filters that the powers of the cosine are multiplied by, (1 or 3, S)."""
    if directivity is None:
        return signal[None]
    size = 1 << math.ceil(math.log2(len(signal) + _MARGIN))
    frequency = torch.fft.rfftfreq(size, 1 / fs, dtype=torch.float64)
    coarse = torch.linspace(0, fs / 2, 1025, dtype=torch.float64)  # the polynomial is smooth; each costs a small fit
    place = frequency / (fs / 2) * 1024
    left = place.long().clamp(max=1023)
    polynomial = directivity.polynomial(coarse)
    gain = torch.lerp(polynomial[left], polynomial[left + 1], (place - left)[:, None]).T.to(signal)
    return torch.fft.irfft(torch.fft.rfft(signal, size) * gain, size)[:, : len(signal)]


def _emission(delay: Tensor) -> Tensor:
    """Return the samples (S,) at which what arrives now was emitted, for `delay` (S,) [samples] at emission."""
    now = torch.arange(len(delay), dtype=delay.dtype)
    emitted = now
    for _ in range(3):  # solves now = emitted + delay(emitted); each round gains speed / c, some 1e-3
        left = emitted.floor().clamp(0, len(delay) - 2)
        index = left.long()
        emitted = now - torch.lerp(delay[index], delay[index + 1], (emitted - left).clamp(0, 1))
    return emitted


def _sampled_at(signal: Tensor, at: Tensor) -> Tensor:
    """Return the band-limited `signal` (S,) at fractional samples `at` (T,), 0 before its start.

    Interpolated to eight times the rate over the Fourier transform, and cubically from there: the error is
    below -70 dB up to 0.44 of the sampling rate.
    """
    size = 1 << math.ceil(math.log2(len(signal) + 2 * _MARGIN))
    padded = torch.nn.functional.pad(signal, (_MARGIN, size - len(signal) - _MARGIN))
    fine = torch.fft.irfft(torch.fft.rfft(padded), _UP * size) * _UP
    place = (at + _MARGIN) * _UP
    whole = place.floor().clamp(1, _UP * size - 3)
    w, i = (place - whole).clamp(0, 1).to(signal), whole.long()
    weights = (
        -w * (w - 1) * (w - 2) / 6,
        (w + 1) * (w - 1) * (w - 2) / 2,
        -(w + 1) * w * (w - 2) / 2,
        (w + 1) * w * (w - 1) / 6,
    )  # Lagrange's, at -1, 0, 1 and 2
    value = sum((weight * fine[i + k] for k, weight in enumerate(weights, -1)), torch.zeros_like(w))
    return torch.where(at > 1 - _MARGIN, value, torch.zeros((), dtype=value.dtype))
