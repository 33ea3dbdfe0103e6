"""Noise of the microphones' own electronics."""

from dataclasses import dataclass

import torch
from torch import Tensor

from probtrack.geometry import MicrophoneArray
from probtrack.simulation.noise.base import Noise, unit_power
from probtrack.simulation.rooms.base import Room


@dataclass(frozen=True)
class WhiteNoise(Noise):
    """White Gaussian noise, independent at each microphone.

    Args:
        level_db: Power relative to the other noises of a scene [dB].
    """

    level_db: float = 0.0

    def draw(self, room: Room, array: MicrophoneArray, size: int, fs: int, generator: torch.Generator) -> Tensor:  # noqa: ARG002
        noise = torch.randn(array.num_microphones, size, generator=generator, dtype=torch.float64)
        return unit_power(noise, "white noise").to(torch.get_default_dtype())
