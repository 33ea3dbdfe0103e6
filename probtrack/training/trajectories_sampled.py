"""Trajectories drawn by a motion model, or walked by simulated talkers: data whose origin is known."""

import abc
from dataclasses import dataclass

import torch

from probtrack._checks import as_non_negative, as_positive, check_int
from probtrack.dynamics import Dynamics, Kinematics
from probtrack.geometry import Region
from probtrack.simulation.trajectories import Trajectories
from probtrack.training.seeds import seed_of
from probtrack.training.trajectories import Trajectory


class TrajectorySource(abc.ABC):
    """What gives trajectories."""

    @abc.abstractmethod
    def trajectories(self) -> list[Trajectory]:
        """Return the trajectories, the same ones each time."""


@dataclass(frozen=True)
class SampledTrajectories(TrajectorySource):
    """Trajectories drawn by a motion model itself, as `TrajectoryFit` takes talkers to begin.

    A talker begins at the origin with a velocity of `speed` r.m.s. on each axis and is measured then and after each of
    `frames` steps. To find out whether data of that kind tell the model's parameters.

    Args:
        dynamics: The model, with its true parameters.
        count: Number of trajectories.
        frames: Steps of each.
        dt: Time of a step [s].
        error: Standard deviation of the error of a measured position on each axis [m].
        speed: Of the talkers at the start, r.m.s. on each axis [m/s].
        seed: Of the random numbers.
    """

    dynamics: Dynamics
    count: int = 100
    frames: int = 100
    dt: float = 0.032
    error: float = 0.01
    speed: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        check_int(self.count, "count", low=1)
        check_int(self.frames, "frames", low=1)
        as_positive(self.dt, "dt")
        as_non_negative(self.error, "error")
        as_non_negative(self.speed, "speed")

    @torch.no_grad()
    def trajectories(self) -> list[Trajectory]:
        model, generator = self.dynamics, torch.Generator().manual_seed(seed_of(self.seed))
        like = next((p for p in model.parameters() if p.is_floating_point()), torch.empty(()))

        def normal(*shape: int) -> torch.Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64).to(like)

        velocity = self.speed * normal(self.count, model.axes)
        state = model.from_kinematics(Kinematics(torch.zeros_like(velocity), velocity))
        step, position = model.transition(self.dt), [model.kinematics(state).position]
        for _ in range(self.frames):
            state = step(state, normal(self.count, model.noise_dim))
            position.append(model.kinematics(state).position)
        measured = (
            torch.stack(position, 1).double() + self.error * normal(self.count, len(position), model.axes).double()
        )
        time = self.dt * torch.arange(len(position), dtype=torch.float64)
        return [Trajectory(f"walk {n}", f"walk {n}", time, one) for n, one in enumerate(measured, 1)]


@dataclass(frozen=True)
class WalkedTrajectories(TrajectorySource):
    """Trajectories of simulated talkers in an empty room, one talker a room, measured with error.

    Args:
        walk: How talkers move, such as `SocialForceWalk`.
        room: Size of the room [m].
        count: Number of trajectories.
        duration: Of each [s].
        rate: Measurements a second [Hz].
        error: Standard deviation of the error of a measured position on each axis [m].
        axes: Coordinates that are measured, 2 or 3.
        seed: Of the walks and the errors.
    """

    walk: Trajectories
    room: tuple[float, float, float] = (6.0, 5.0, 3.0)
    count: int = 20
    duration: float = 20.0
    rate: float = 31.25
    error: float = 0.01
    axes: int = 2
    seed: int = 0

    def __post_init__(self) -> None:
        check_int(self.count, "count", low=1)
        check_int(self.axes, "axes", low=2)
        as_non_negative(self.error, "error")

    def trajectories(self) -> list[Trajectory]:
        seeds = [seed_of(self.seed, n) for n in range(self.count)]
        region = Region((0.0, 0.0, 0.0), self.room)
        motion = self.walk.draw(seeds, num_talkers=1, duration=self.duration, rate=self.rate, region=region)
        position = motion.position[:, :, 0, : self.axes].double()
        generator = torch.Generator().manual_seed(seed_of(self.seed, self.count, 1))
        error = self.error * torch.randn(position.shape, generator=generator, dtype=torch.float64)
        time = torch.arange(len(position), dtype=torch.float64) / self.rate
        return [
            Trajectory(f"walk {n}", f"walk {n}", time, one) for n, one in enumerate((position + error).unbind(1), 1)
        ]
