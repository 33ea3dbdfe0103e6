"""Noise of the microphones' own electronics."""

from dataclasses import dataclass

import torch
from torch import Tensor

from probtrack.geometry import MicrophoneArray
from probtrack.simulation.noise.base import Noise, unit_power
from probtrack.simulation.rooms.base import Room
from probtrack.simulation.rooms.cache import ResponseCache


@dataclass(frozen=True)
class WhiteNoise(Noise):
    """White Gaussian noise, independent at each microphone.

    Args:
        level_db: Power relative to the other noises of a scene [dB].
    """

    level_db: float = 0.0

    def draw(
        self,
        room: Room,  # noqa: ARG002
        array: MicrophoneArray,
        size: int,
        fs: int,  # noqa: ARG002
        generator: torch.Generator,
        cache: ResponseCache | None = None,  # noqa: ARG002
    ) -> Tensor:
        noise = torch.randn(array.num_microphones, size, generator=generator, dtype=torch.float64)
        return unit_power(noise, "white noise").to(torch.get_default_dtype())
