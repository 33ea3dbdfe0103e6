"""Noise as an array of microphones recorded it."""

from dataclasses import dataclass

import torch
from torch import Tensor

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray
from probtrack.simulation.noise.base import Noise, unit_power
from probtrack.simulation.noise.files import load_noise, stretch
from probtrack.simulation.rooms.base import Room
from probtrack.simulation.rooms.cache import ResponseCache


@dataclass(frozen=True)
class RecordedNoise(Noise):
    """Noise recorded with the very array of the scene, one channel a microphone.

    Used as it is, from a random start, resampled to the rate of the scene; one shorter than twice the scene goes
    round, with a cross-fade of 50 ms. Levels of and coherence between the channels stay.

    Args:
        file: Audio file with as many channels as there are microphones.
        level_db: Power relative to the other noises of a scene [dB].
    """

    file: str
    level_db: float = 0.0

    def draw(
        self,
        room: Room,  # noqa: ARG002
        array: MicrophoneArray,
        size: int,
        fs: int,
        generator: torch.Generator,
        cache: ResponseCache | None = None,  # noqa: ARG002
    ) -> Tensor:
        recording = load_noise(self.file, fs)
        if len(recording) == 1:
            raise InputError(
                f"{self.file}: a mono recording would be heard alike at all microphones, as no sound is: "
                "use it in a DiffuseNoise or an Interferer"
            )
        if len(recording) != array.num_microphones:
            raise InputError(
                f"{self.file}: noise must have a channel for each of {array.num_microphones} microphones, "
                f"got {len(recording)}"
            )
        noise = stretch(recording, size, fs, generator)
        return unit_power(noise, f"{self.file}: stretch of noise").to(torch.get_default_dtype())
