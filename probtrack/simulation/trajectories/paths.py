"""Talkers on given ways."""

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from probtrack.errors import InputError
from probtrack.geometry import Region
from probtrack.simulation.motion import Motion
from probtrack.simulation.trajectories.base import Trajectories
from probtrack.simulation.trajectories.sampling import check_draw, finished, sample_times
from probtrack.simulation.trajectories.ways import Point, Through, Way


@dataclass(frozen=True)
class GivenPaths(Trajectories):
    """Each talker on a given way, the same in every run; nobody keeps away from microphones.

    Args:
        ways: One a talker.
    """

    ways: tuple[Way, ...]

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
        """Return the motion of the talkers, as `Trajectories.draw` has it.

        Raises:
            InputError: for another number of talkers than of ways, a way that leaves the room, or a duration that
                is too short for its ramps.
        """
        check_draw(seeds, num_talkers, region, microphones)
        if num_talkers != len(self.ways):
            raise InputError(f"num_talkers must be {len(self.ways)}, one a way, got {num_talkers}")
        times = sample_times(duration, rate)
        motion = Motion.stack([way.at(times, duration) for way in self.ways])
        inside = region.contains(motion.position)
        if not inside.all():
            sample, talker = (~inside).nonzero()[0].tolist()
            place = [round(x, 3) for x in motion.position[sample, talker].tolist()]
            raise InputError(
                f"ways: talker {talker + 1} must stay inside the room, got {place} at {times[sample]:.2f} s"
            )
        columns = finished(*motion)
        return Motion(*(column[:, None].expand(-1, len(seeds), *column.shape[1:]) for column in columns))


@dataclass(frozen=True)
class SmoothPaths(Trajectories):
    """Each talker on a smooth way through points, at one speed, facing the way it goes; `GivenPaths` of `Through`.

    Args:
        points: For each talker two or more points x, y and z [m].
        ramp: Time in which a talker starts, and stops; the speed is half a cosine [s].
    """

    points: tuple[tuple[Point, ...], ...]
    ramp: float = 0.8

    def __post_init__(self) -> None:
        self._given()

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
        return self._given().draw(
            seeds, num_talkers=num_talkers, duration=duration, rate=rate, region=region, microphones=microphones
        )

    def _given(self) -> GivenPaths:
        return GivenPaths(tuple(Through(points, self.ramp) for points in self.points))
