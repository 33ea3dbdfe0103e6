"""The one interface of everything that sound goes through on its way to microphones."""

from abc import ABC, abstractmethod

from torch import Tensor

from probtrack.geometry import MicrophoneArray, Region
from probtrack.simulation.motion import Motion
from probtrack.simulation.rooms.cache import ResponseCache
from probtrack.simulation.rooms.directivity import Directivity


class Room(ABC):
    """Where sources are heard: a simulated room, or measured impulse responses.

    A subclass is a frozen dataclass of plain values, so that a scene file can say it.
    """

    @property
    @abstractmethod
    def region(self) -> Region:
        """Where a source can be, three axes [m]."""

    @abstractmethod
    def check_array(self, array: MicrophoneArray) -> None:
        """Raise `InputError` unless these microphones can be in the room."""

    @abstractmethod
    def render(
        self,
        signal: Tensor,
        motion: Motion,
        array: MicrophoneArray,
        fs: int,
        *,
        directivity: Directivity | None = None,
        cache: ResponseCache | None = None,
    ) -> Tensor:
        """Return (M, S), what the microphones hear of `signal` (S,) while its source makes `motion`.

        Args:
            signal: (S,), sampled at `fs`; its level is that at 1 m, in front of the mouth.
            motion: T = S, no batch.
            array: Microphones at their true places.
            fs: Sampling rate [Hz].
            directivity: Of the source; None for the same in all directions.
            cache: Where responses that take long to compute are kept; None to keep none.

        Raises:
            InputError: for a source or microphone that cannot be there.
        """
