"""Ways drawn from the motion models that trackers use."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from probtrack._checks import check_int
from probtrack.dynamics import Dynamics, Kinematics, lehmann2007
from probtrack.errors import InputError
from probtrack.geometry import Region
from probtrack.simulation.motion import Motion
from probtrack.simulation.trajectories.base import Trajectories
from probtrack.simulation.trajectories.sampling import between, check_draw, finished, hermite, sample_times
from probtrack.switching import PRESETS, SwitchingDynamics


@torch.no_grad()
def sample_paths(
    dynamics: Dynamics, seeds: Sequence[int], *, start: Kinematics, num_steps: int, dt: float, region: Region
) -> Kinematics:
    """Return ways (num_steps + 1, runs, K, A) drawn from a motion model, reflected at the sides of a region.

    A step that ends outside is folded back at the side it crossed, and the velocity across that side changes its
    sign. The state is then made anew by `from_kinematics`: what a model remembers beyond position and velocity is
    lost there, an acceleration is 0 again, and a chain of modes draws its mode as in the first frame. A heading that
    is modelled beside the motion stays. Away from the sides the law is the model's own.

    Args:
        dynamics: The model, with A axes.
        seeds: One a run; a run's numbers depend on its seed alone.
        start: Position and velocity (runs, K, A) of K talkers, inside the region.
        num_steps: How often the model moves them.
        dt: Time of a step [s].
        region: Where they stay, A axes [m].

    Raises:
        InputError: for a region of other axes, a start outside it, or a model that listens to speech.
    """
    check_int(num_steps, "num_steps", low=1)
    if region.axes != dynamics.axes:
        raise InputError(f"region must have {dynamics.axes} axes, those of the motion model, got {region.axes}")
    if start.position.ndim != 3 or len(start.position) != len(seeds):
        raise InputError(f"start must be (runs, K, A) with {len(seeds)} runs, got {tuple(start.position.shape)}")
    if not region.contains(start.position).all():
        raise InputError("start must be inside the region")
    transition = dynamics.transition(dt)
    state = dynamics.from_kinematics(start)
    # rounded up: torch draws normal numbers in sixteens, and the last few otherwise, so that a longer way would differ
    shape = (math.ceil(num_steps / 16) * 16, start.position.shape[1], dynamics.noise_dim)
    generators = [torch.Generator().manual_seed(seed) for seed in seeds]
    noise = torch.stack([torch.randn(shape, generator=g, dtype=torch.float64) for g in generators], 1).to(state)
    known = [dynamics.kinematics(state)]
    for numbers in noise[:num_steps].unbind(0):
        state = _reflected(dynamics, transition(state, numbers), region)
        known.append(dynamics.kinematics(state))
    return Kinematics(
        torch.stack([k.position for k in known]),
        torch.stack([k.velocity for k in known]),
        torch.stack([k.heading for k in known]),
    )


@dataclass(frozen=True)
class ModelWalk(Trajectories):
    """Ways drawn from one of the motion models that trackers use, reflected near the walls.

    The model takes steps of `step` and moves in the plane; between two steps the way is a curve that stays between
    their coordinates, so that velocity is the derivative of position. Body and mouth point along the model's own
    velocity. Nobody keeps away from microphones: choose a margin that does. See `sample_paths` for what a
    reflection does to a model with memory.

    Args:
        model: A name of S1's Table 1 such as CU-LAN, or odas or moving-stopped for a talker who changes between
            models.
        speed: At the start, in a random direction [m/s].
        height: Of the mouth, all the time [m].
        margin: How near a mouth comes to a wall [m].
        step: Time step of the model [s].
    """

    model: str = "CU-LAN"
    speed: float = 0.5
    height: float = 1.6
    margin: float = 0.3
    step: float = 0.032

    def __post_init__(self) -> None:
        for name, low in (("speed", 0.0), ("height", 0.0), ("margin", 0.0), ("step", 1e-3)):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= low):
                raise InputError(f"{name} must be finite and at least {low:g}, got {value}")
        self._dynamics()

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
            InputError: for a height outside the room, or a margin that leaves no place.
        """
        check_draw(seeds, num_talkers, region, microphones)
        times = sample_times(duration, rate)
        area = self._area(region)
        num_steps = int(times[-1] / self.step) + 2
        start = self._start(seeds, num_talkers, area)
        known = sample_paths(self._dynamics(), seeds, start=start, num_steps=num_steps, dt=self.step, region=area)
        place = known.position.double()
        position, velocity = hermite(times, self.step, place, _slopes(place, self.step))
        heading = between(times, self.step, _unwrapped(known.heading.double()))
        height = torch.full_like(position[..., :1], self.height)
        velocity = torch.nn.functional.pad(velocity, (0, 1))
        return finished(torch.cat([position, height], -1), velocity, heading, heading)

    def _dynamics(self) -> Dynamics:
        if self.model not in PRESETS:
            return lehmann2007(self.model, dt=self.step)
        switching: SwitchingDynamics = PRESETS[self.model](2, dt=self.step)
        if switching.chain.listens:
            raise InputError(f"model must not listen to speech, which a way has none of, got {self.model!r}")
        return switching

    def _area(self, region: Region) -> Region:
        if not region.low[2] <= self.height <= region.high[2]:
            raise InputError(f"height must be from {region.low[2]:g} to {region.high[2]:g} m, got {self.height}")
        low, high = ([x + sign * self.margin for x in side[:2]] for side, sign in ((region.low, 1), (region.high, -1)))
        if not all(a < b for a, b in zip(low, high, strict=True)):
            raise InputError(f"margin must leave a place between the walls, got {self.margin} m")
        return Region(tuple(low), tuple(high))

    def _start(self, seeds: Sequence[int], num_talkers: int, area: Region) -> Kinematics:
        """Return talkers anywhere in the area who go any way; numbers apart from those of the steps."""
        # another stream than that of the steps: the numbers of the first must not repeat in the second
        generators = [torch.Generator().manual_seed(seed ^ 0x5EED0000) for seed in seeds]
        drawn = [torch.rand(num_talkers, 3, generator=g, dtype=torch.float64) for g in generators]
        unit = torch.stack(drawn).to(torch.get_default_dtype())
        angle = 2 * math.pi * unit[..., 2]
        velocity = self.speed * torch.stack([angle.cos(), angle.sin()], -1)
        return Kinematics(area.from_unit(unit[..., :2]), velocity)


def _reflected(dynamics: Dynamics, state: Tensor, region: Region) -> Tensor:
    """Return `state` (..., D), those outside the region folded back."""
    known = dynamics.kinematics(state)
    outside = ~region.contains(known.position)
    if not outside.any():
        return state
    low, high = known.position.new_tensor(region.low), known.position.new_tensor(region.high)
    size = high - low
    there = torch.remainder(known.position - low, 2 * size)  # there and back again
    back = there > size
    position = low + torch.where(back, 2 * size - there, there)
    position = torch.minimum(torch.maximum(position, low), high)  # rounding
    velocity = torch.where(back, -known.velocity, known.velocity)
    anew = dynamics.from_kinematics(Kinematics(position, velocity, known.modelled_heading))
    return torch.where(outside[..., None], anew, state)


def _slopes(place: Tensor, step: float) -> Tensor:
    """Return velocities (N, ...) at places (N, ...), with which a cubic curve stays between neighbours.

    Central differences, limited to three times the smaller of the two, and 0 where the way turns back: a cubic
    piece is then monotonic (F. N. Fritsch, R. E. Carlson, "Monotone piecewise cubic interpolation", SIAM J. Numer.
    Anal. 17:238, 1980).
    """
    secant = place.diff(dim=0) / step
    before, after = torch.cat([secant[:1], secant]), torch.cat([secant, secant[-1:]])
    bound = 3 * torch.minimum(before.abs(), after.abs())
    mean = torch.maximum(torch.minimum((before + after) / 2, bound), -bound)
    return torch.where(before * after > 0, mean, 0.0)


def _unwrapped(angle: Tensor) -> Tensor:
    """Return angles (N, ...) that go on from step to step without a jump of a turn."""
    turn = torch.remainder(angle.diff(dim=0) + math.pi, 2 * math.pi) - math.pi
    return torch.cat([angle[:1], angle[:1] + turn.cumsum(0)])
