"""Noise from one place in the room."""

from dataclasses import dataclass

import torch
from torch import Tensor

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray
from probtrack.simulation.motion import Motion
from probtrack.simulation.noise.base import Noise, unit_power
from probtrack.simulation.noise.files import load_noise, stretch
from probtrack.simulation.noise.spectra import coloured, spectral_gain
from probtrack.simulation.rooms.base import Room
from probtrack.simulation.rooms.cache import ResponseCache

_BUILD_UP = 1.0  # s
_BLADES = 130.0  # Hz, at which the blades of the fan pass
_HARMONICS = 4
_HUM = 0.25  # power of the harmonics together, relative to that of the hiss


@dataclass(frozen=True)
class Interferer(Noise):
    """A source that stands in the room, such as a fan, a loudspeaker or another voice, and sounds to all sides alike.

    It is heard through the room as a talker is, from a second before the recording starts: the room is full of it.

    Args:
        position: Where it stands [m].
        file: Recording that it plays from a random start, the channels averaged; None for Gaussian noise.
        spectrum: white, pink, speech or fan: see `spectral_gain`; a fan hums at 130 Hz and three multiples too.
            Not heeded with `file`.
        level_db: Power at the microphones relative to the other noises of a scene [dB].
    """

    position: tuple[float, float, float]
    file: str | None = None
    spectrum: str = "fan"
    level_db: float = 0.0

    def __post_init__(self) -> None:
        if len(self.position) != 3 or not torch.tensor(self.position, dtype=torch.float64).isfinite().all():
            raise InputError(f"interferer: position must be three finite coordinates [m], got {self.position}")
        spectral_gain(self.spectrum, torch.zeros(1))

    def draw(
        self,
        room: Room,
        array: MicrophoneArray,
        size: int,
        fs: int,
        generator: torch.Generator,
        cache: ResponseCache | None = None,
    ) -> Tensor:
        if not room.region.contains(torch.tensor(self.position)):
            raise InputError(f"interferer at {self.position} m is outside the room, {room.region}")
        early = round(_BUILD_UP * fs)
        signal = self._signal(early + size, fs, generator).to(torch.get_default_dtype())
        heard = room.render(signal, _standing(self.position, len(signal)), array, fs, cache=cache)
        return unit_power(heard[:, early:], f"interferer at {self.position} m")

    def _signal(self, size: int, fs: int, generator: torch.Generator) -> Tensor:
        """Return (size,) of unit power, float64."""
        if self.file is not None:
            signal = stretch(load_noise(self.file, fs), size, fs, generator).mean(0)
            return unit_power(signal, f"{self.file}: stretch of noise")
        hiss = coloured(torch.randn(size, generator=generator, dtype=torch.float64), self.spectrum, fs)
        signal = unit_power(hiss, "interferer")
        if self.spectrum == "fan":
            signal = signal + _hum(size, fs, generator)
        return unit_power(signal, "interferer")


def _standing(position: tuple[float, float, float], size: int) -> Motion:
    place, nothing = torch.tensor(position), torch.zeros(size)
    return Motion(place.expand(size, 3), nothing[:, None].expand(size, 3), nothing, nothing)


def _hum(size: int, fs: int, generator: torch.Generator) -> Tensor:
    """Return the harmonics of the blades, each half as strong as the one before, at a pitch that drifts by 1 %."""
    time = torch.arange(size, dtype=torch.float64) / fs
    rate, *phases = torch.rand(2 + _HARMONICS, generator=generator, dtype=torch.float64).tolist()
    drift = torch.cos(2 * torch.pi * ((0.2 + 0.3 * rate) * time + phases.pop()))
    turns = torch.cumsum(_BLADES * (1 + 0.01 * drift), 0) / fs
    waves = [2**-k * torch.sin(2 * torch.pi * ((k + 1) * turns + p)) for k, p in enumerate(phases)]
    hum: Tensor = unit_power(torch.stack(waves).sum(0), "hum") * _HUM**0.5
    return hum
