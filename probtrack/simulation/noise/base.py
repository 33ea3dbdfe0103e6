"""The one interface of everything that disturbs a recording."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from probtrack.errors import InputError, NotFiniteError
from probtrack.geometry import MicrophoneArray
from probtrack.simulation.rooms.base import Room
from probtrack.simulation.rooms.cache import ResponseCache


class Noise(ABC):
    """What microphones hear besides the talkers.

    A subclass is a frozen dataclass of plain values, so that a scene file can say it; among them is `level_db`.
    """

    level_db: float = 0.0

    @abstractmethod
    def draw(
        self,
        room: Room,
        array: MicrophoneArray,
        size: int,
        fs: int,
        generator: torch.Generator,
        cache: ResponseCache | None = None,
    ) -> Tensor:
        """Return (M, size), noise whose power is 1 in the mean over the microphones and samples.

        Args:
            room: Where the microphones are.
            array: Microphones at their true places.
            size: Number of samples.
            fs: Sampling rate [Hz].
            generator: Draws the noise; the same seed gives the same.
            cache: Where the room keeps responses that take long to compute; None to keep none.

        Raises:
            InputError: for a file that cannot be used, or a source that cannot be there.
        """


def unit_power(noise: Tensor, name: str) -> Tensor:
    """Return `noise` (...) scaled to a mean power of 1; `name` is said where it is silent or not finite."""
    power = noise.double().square().mean()
    if not power.isfinite():
        raise NotFiniteError(f"{name} must be finite, got NaN or infinite samples")
    if not power > 0:
        raise InputError(f"{name} must not be silent: it has no level")
    return noise * power.rsqrt().to(noise)
