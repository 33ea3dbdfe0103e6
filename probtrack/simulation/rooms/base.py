"""The one interface of everything that sound goes through on its way to microphones."""

from abc import ABC, abstractmethod

from torch import Tensor

from probtrack.geometry import MicrophoneArray, Region
from probtrack.simulation.motion import Motion


class Room(ABC):
    """Where talkers are heard: a simulated room, or measured impulse responses.

    A subclass is a frozen dataclass of plain values, so that a scene file can say it.
    """

    @property
    @abstractmethod
    def region(self) -> Region:
        """Where a mouth can be, three axes [m]."""

    @abstractmethod
    def render(self, signal: Tensor, motion: Motion, array: MicrophoneArray, fs: int) -> Tensor:
        """Return (M, S), what the microphones hear of `signal` (S,) while its source makes `motion`.

        Args:
            signal: (S,), sampled at `fs`; its level is that at 1 m, in front of the mouth.
            motion: T = S, no batch.
            array: Microphones at their true places.
            fs: Sampling rate [Hz].

        Raises:
            InputError: for a source or microphone that cannot be there.
        """
