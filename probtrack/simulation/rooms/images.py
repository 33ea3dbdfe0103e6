"""Responses of a rectangular room between a place and microphones, split by how the mouth's direction acts on them."""

import math
from types import ModuleType
from typing import NamedTuple

import torch
from torch import Tensor

from probtrack.simulation.rooms.direct import LEAD, NEAREST, taper
from probtrack.simulation.rooms.directivity import Directivity

METHOD = 2
"""Of computing responses: another number makes the cache compute all anew. To change with every change of numbers."""

_AUDIBLE = 20.0  # Hz
_FINE = 8  # steps to a sample, between which arrivals are split
_FADE = 0.005  # s, over which the responses end


class Images(NamedTuple):
    """Image sources of microphones, without the microphones themselves.

    By reciprocity a talker hears the images of a microphone as that microphone hears the talker's, and the
    direction in which the talker sees an image is that in which the sound has left the mouth.

    Attributes:
        position: (M, I, 3) [m].
        amplitude: (M, I), the product of the walls' reflections; 0 for those that fill up the rows.
    """

    position: Tensor
    amplitude: Tensor


def image_sources(
    size: tuple[float, float, float], absorption: float, max_order: int, reach: float, microphones: Tensor
) -> Images:
    """Return the images of `microphones` (M, 3) of which some place in the room is within `reach` [m].

    Raises:
        ImportError: without pyroomacoustics.
    """
    pra = _pyroomacoustics()
    room = pra.ShoeBox(list(size), max_order=max_order, materials=pra.Material(absorption), air_absorption=False)
    extent = torch.tensor(size, dtype=torch.float32)
    for microphone in microphones.float():  # as pyroomacoustics keeps the size: one on the wall is inside then
        room.add_source(torch.minimum(microphone, extent).double().numpy())
    room.add_microphone([0.5 * s for s in size])  # a room without one computes nothing
    room.image_source_model()
    positions, amplitudes = [], []
    for source in room.sources:
        position = torch.from_numpy(source.images.T).float()
        gap = torch.maximum(position - extent, -position).clamp(min=0).square().sum(-1).sqrt()  # to the room
        kept = (torch.from_numpy(source.orders) > 0) & (gap < reach)
        positions.append(position[kept])
        amplitudes.append(torch.from_numpy(source.damping[0]).float()[kept])
    fill = torch.nn.utils.rnn.pad_sequence
    return Images(fill(positions, True, 1.0), fill(amplitudes, True, 0.0))


class DirectionalResponses:
    r"""Reflections from a place to microphones, for every direction of the mouth at once.

    With the amplitude of the mouth as a polynomial in the cosine of the angle (`Directivity.polynomial`) and the mouth
    level, the response for a mouth that points to azimuth :math:`\varphi` is

    .. math:: h(t; \varphi) = h_0(t) + h_1(t) \cos\varphi + h_2(t) \sin\varphi + h_3(t) \cos 2\varphi
        + h_4(t) \sin 2\varphi

    exactly, so that a mouth may turn at any moment. Omnidirectional sources have h_0 only.

    Args:
        images: Image sources of the microphones.
        directivity: Of the source; None for the same in all directions.
        length: Of the responses [samples], the first `LEAD` of which lie before the time of emission.
        fs: Sampling rate [Hz].
        speed_of_sound: [m/s].
    """

    def __init__(
        self, images: Images, directivity: Directivity | None, length: int, fs: int, speed_of_sound: float
    ) -> None:
        self.images, self.length, self.scale = images, length, fs / speed_of_sound
        self.size = 1 << math.ceil(math.log2(length + round(0.05 * fs)))  # room for what the filters ring
        frequency = torch.fft.rfftfreq(self.size, 1 / fs, dtype=torch.float64)
        spread = torch.sinc(frequency / (fs * _FINE)).square()  # of the split
        band = _high_pass(frequency, fs) * taper(frequency, fs) / spread
        self.directional = directivity is not None
        polynomial = band.new_ones(len(band), 1) if directivity is None else directivity.polynomial(frequency)
        self.filters = (polynomial.T * band).to(torch.complex64)  # (1 or 3, F)
        fade = torch.ones(length, dtype=torch.float32)
        end = min(round(_FADE * fs), length)
        fade[-end:] = (1 + torch.cos(math.pi * (torch.arange(end) + 1) / end)) / 2
        self.fade = fade

    def at(self, point: Tensor) -> Tensor:
        """Return (C, M, length), C = 5, or 1 without a directivity, from `point` (3,) [m]."""
        offset = self.images.position - point.float()
        distance = offset.square().sum(-1).sqrt().clamp(min=NEAREST)
        arrival = (distance * self.scale + LEAD) * _FINE
        first = arrival.floor()
        late = first >= (self.length - 1) * _FINE
        amplitude = torch.where(late, 0.0, self.images.amplitude / distance)
        channels = amplitude[..., None]
        if self.directional:
            x, y, _ = (offset / distance[..., None]).unbind(-1)
            channels = channels * torch.stack([torch.ones_like(x), x, y, x * x + y * y, x * x - y * y, 2 * x * y], -1)
        spectrum = self._spectrum(first.clamp(max=(self.length - 1) * _FINE), arrival - first, channels)
        responses: Tensor = torch.fft.irfft(self._filtered(spectrum), self.size)[..., : self.length] * self.fade
        return responses

    def _spectrum(self, first: Tensor, share: Tensor, channels: Tensor) -> Tensor:
        """Sum arrivals (M, I), each split between two fine steps; returns (channels, M, F)."""
        num_microphones, _, count = channels.shape
        fine = self.size * _FINE
        row = (first.long() + fine * torch.arange(num_microphones)[:, None]).flatten()
        summed = channels.new_zeros(num_microphones * fine, count)
        summed.index_add_(0, row, (channels * (1 - share)[..., None]).flatten(0, 1))
        summed.index_add_(0, row + 1, (channels * share[..., None]).flatten(0, 1))
        lines = summed.reshape(num_microphones, fine, count).permute(2, 0, 1)
        spectrum: Tensor = torch.fft.rfft(lines.contiguous())[..., : self.size // 2 + 1]
        return spectrum

    def _filtered(self, spectrum: Tensor) -> Tensor:
        if not self.directional:
            return spectrum * self.filters[0]
        still, x, y, level, cosine, sine = spectrum
        d0, d1, d2 = self.filters
        return torch.stack([d0 * still + d2 / 2 * level, d1 * x, d1 * y, d2 / 2 * cosine, d2 / 2 * sine])


def harmonics(mouth: Tensor) -> Tensor:
    """Return (S, 5), the factors of the five responses for a mouth that points to azimuth `mouth` (S,) [rad]."""
    turns = [torch.ones_like(mouth), mouth.cos(), mouth.sin(), (2 * mouth).cos(), (2 * mouth).sin()]
    return torch.stack(turns, -1)


def _high_pass(frequency: Tensor, fs: int) -> Tensor:
    """Return the response (F,) of a causal Butterworth filter of second order that removes what is below hearing.

    Reflections from equal walls add up to 30 dB more there than elsewhere.
    """
    s = 1j * torch.tan(torch.pi * frequency / fs) / math.tan(math.pi * _AUDIBLE / fs)  # bilinear transform
    return s**2 / (s**2 + math.sqrt(2) * s + 1)


def _pyroomacoustics() -> ModuleType:
    try:
        import pyroomacoustics
    except ImportError:
        raise ImportError(
            "rooms with reverberation need pyroomacoustics: pip install 'probtrack[simulation]'"
        ) from None
    return pyroomacoustics  # type: ignore[no-any-return]
