"""The sound that comes from a moving mouth straight to microphones."""

import math

import torch
from torch import Tensor

from probtrack.simulation.motion import Motion
from probtrack.simulation.rooms.directivity import Directivity

LEAD = 40
"""Samples of an impulse response before time 0, where the interpolation of an early sound rings."""

NEAREST = 0.05
"""Distance below which sound grows no louder and arrives no earlier [m]."""

_UP = 8  # steps to a sample, between which is interpolated cubically
_MARGIN = 64  # samples of silence at both ends
_TAPER = 0.45  # of the sampling rate, from where a response falls to 0 at half of it


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
        distance = offset.square().sum(-1).sqrt().clamp(min=NEAREST)
        emitted = shaped[0]
        if directivity is not None:
            cosine = ((offset[:, :2] / distance[:, None]).to(signal) * ahead).sum(-1)
            emitted = emitted + cosine * (shaped[1] + cosine * shaped[2])
        at = _emission(distance.double() * fs / speed_of_sound)
        heard.append(_sampled_at(emitted / distance.to(signal), at))
    return torch.stack(heard)


def direct_responses(
    points: Tensor,
    microphones: Tensor,
    directivity: Directivity | None,
    mouth: Tensor,
    *,
    length: int,
    fs: int,
    speed_of_sound: float,
) -> Tensor:
    """Return (K, M, length), the response from each of `points` (K, 3) to `microphones` (M, 3) without reflections.

    A delay of any fraction of a sample, flat up to 0.45 of the sampling rate; `LEAD` samples lie before time 0.
    `mouth` (K,) [rad] is where each source points, heeded with a directivity only.
    """
    size = 1 << math.ceil(math.log2(length + round(0.05 * fs)))  # room for what the filters ring
    frequency = torch.fft.rfftfreq(size, 1 / fs, dtype=torch.float64)
    offset = microphones.double() - points.double()[:, None]
    distance = offset.square().sum(-1).sqrt().clamp(min=NEAREST)
    delay = distance / speed_of_sound + LEAD / fs
    gain = taper(frequency, fs) / distance[..., None]
    if directivity is not None:
        ahead = torch.stack([mouth.double().cos(), mouth.double().sin()], -1)[:, None]
        cosine = ((offset[..., :2] * ahead).sum(-1) / distance)[..., None]
        d0, d1, d2 = directivity.polynomial(frequency).T
        gain = gain * (d0 + cosine * (d1 + cosine * d2))
    spectrum = torch.polar(gain, -2 * math.pi * delay[..., None] * frequency)
    responses: Tensor = torch.fft.irfft(spectrum, size)[..., :length].to(torch.get_default_dtype())
    return responses


def taper(frequency: Tensor, fs: int) -> Tensor:
    """Return the gain of responses at `frequency` [Hz]: 1 up to 0.45 of the sampling rate, 0 at half of it.

    A steep end there would ring on both sides of every arrival.
    """
    over = ((frequency / fs - _TAPER) / (0.5 - _TAPER)).clamp(0, 1)
    return (1 + torch.cos(math.pi * over)) / 2


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
    shaped: Tensor = torch.fft.irfft(torch.fft.rfft(signal, size) * gain, size)[:, : len(signal)]
    return shaped


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
