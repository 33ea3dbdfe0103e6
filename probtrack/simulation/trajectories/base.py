"""The one interface of everything that moves talkers."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

from torch import Tensor

from probtrack.geometry import Region
from probtrack.simulation.motion import Motion


class Trajectories(ABC):
    """How talkers move: a law that draws their ways, or ways that are given.

    A subclass is a frozen dataclass of plain values, so that a scene file can say it.
    """

    @abstractmethod
    def draw(
        self,
        seeds: Sequence[int],
        *,
        num_talkers: int,
        duration: float,
        rate: float,
        region: Region,
        microphones: Tensor | None = None,
    ) -> Motion:
        """Return the motion of `num_talkers` talkers in each of `len(seeds)` runs.

        Args:
            seeds: One a run. A run's numbers depend on its seed alone, not on the runs beside it.
            num_talkers: K.
            duration: [s].
            rate: Samples a second [Hz]; the same walk at any rate.
            region: The room, three axes [m]. Every mouth stays inside.
            microphones: (M, 3) [m], which talkers keep away from.

        Returns:
            Motion with T = round(duration * rate) and batch (runs, K).
        """
