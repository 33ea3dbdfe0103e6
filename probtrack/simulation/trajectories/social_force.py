"""People who walk from goal to goal, stop, turn and look about."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from probtrack.errors import InputError
from probtrack.geometry import Region
from probtrack.simulation.motion import Motion
from probtrack.simulation.trajectories.base import Trajectories
from probtrack.simulation.trajectories.habits import NUM_UNIFORMS, Chances, Habits, Pushes, Surroundings
from probtrack.simulation.trajectories.sampling import between, check_draw, finished, hermite, sample_times
from probtrack.simulation.trajectories.walkers import STEP, first, step

_CANDIDATES = 64  # places to begin at that are tried for each talker
_HEAD_ROOM = 0.05  # m between a mouth and the floor or ceiling at least


@dataclass(frozen=True)
class SocialForceWalk(Trajectories):
    r"""Purposeful walking between random goals, by the social force model.

    A talker intends to go to a goal at a desired speed of its own, and is pushed off walls, microphones and
    other talkers by exponential potentials:

    .. math:: u = v_0 e + \tau \Bigl(-\nabla \sum U\, e^{-d / R} - \nabla \sum A\, e^{-d / B}\Bigr) .

    The body turns to where the talker intends to go, no faster than its turn rate at the present speed, and the
    talker walks where the body faces: the speed relaxes to what of u lies ahead. So people turn on the spot before they
    set out, and slow down in curves. Within `arrival` of the goal the next one is drawn, and some talkers stand
    for a while first. The head turns within its limit, as two first-order lags: ahead into the curve, or to another
    talker or the addressed point, to which one who stands turns the body too.

    Walls, the circles around microphones and the distance between talkers are kept by hard limits on the velocity
    as well as by the potentials: no mouth ever comes nearer. A walk begins standing, and is the same at any rate.

    Args:
        speed: Mean of the desired speed [m/s].
        speed_std: Standard deviation of the desired speed over talkers [m/s]; the law is cut at half of
            `speed` and at `max_speed`.
        max_speed: Nobody walks faster [m/s].
        relaxation: Time in which a talker takes up the desired speed [s].
        arrival: How near a goal must be to be reached [m].
        margin: How near a mouth may come to a wall [m].
        keep_out: How near a mouth may come to a microphone in the horizontal plane [m]; 0 for no limit.
        apart: How near two mouths may come to each other in the horizontal plane [m].
        wall_range: R, range of the potential of walls and microphones [m].
        talker_potential: A, the potential between two talkers [m^2/s^2].
        talker_range: B, the range of the potential between two talkers [m].
        turn_rate: Largest turn rate of one who walks at 1 m/s [rad/s]; at other speeds it goes with speed^-0.8.
        stop_probability: Share of the goals at which a talker stands for a while.
        stop_duration: Mean of the exponential law of that time [s].
        glance_probability: Share of looks that go to another talker or the addressed point, not ahead.
        glance_duration: Mean of the exponential law of the time a look lasts [s].
        head_limit: Largest angle between head and body [rad].
        address: x and y of the place that talkers look at [m]; None for the middle of the microphones, or of the room.
        height: Mean height of the mouth [m].
        height_std: Standard deviation of that height over talkers [m]; 0 for one height. Cut at 5 cm from floor and
            ceiling.

    References:
        D. Helbing, P. Molnar, "Social force model for pedestrian dynamics", Physical Review E 51:4282, 1995: the
        driving force, the potentials, A and B, the range of walls, and the law of the desired speed. There the force
        itself moves the walker; the body that must turn first, the hard limits, pushes that are turned a little to the
        right, stops and heads are ours. A relaxation of 1 s, the cap, the arrival radius and the heights are those
        of a simulator of talkers (Kienegger and Gerkmann, 2026); the strength of walls and microphones,
        3 m/s^2 at the nearest a mouth may come, is ours.
    """

    speed: float = 1.34
    speed_std: float = 0.26
    max_speed: float = 1.72
    relaxation: float = 1.0
    arrival: float = 0.5
    margin: float = 0.3
    keep_out: float = 0.3
    apart: float = 0.5
    wall_range: float = 0.2
    talker_potential: float = 2.1
    talker_range: float = 0.3
    turn_rate: float = 1.2
    stop_probability: float = 0.4
    stop_duration: float = 3.0
    glance_probability: float = 0.4
    glance_duration: float = 2.0
    head_limit: float = 1.1
    address: tuple[float, float] | None = None
    height: float = 1.6
    height_std: float = 0.08

    def __post_init__(self) -> None:
        positive = (
            "speed", "relaxation", "arrival", "apart", "wall_range", "talker_range", "turn_rate", "stop_duration",
            "glance_duration", "height",
        )  # fmt: skip
        for name in positive:
            _check(name, getattr(self, name), low=0.0, open_low=True)
        for name in ("speed_std", "margin", "keep_out", "talker_potential", "height_std"):
            _check(name, getattr(self, name), low=0.0)
        for name in ("stop_probability", "glance_probability"):
            _check(name, getattr(self, name), low=0.0, high=1.0)
        _check("max_speed", self.max_speed, low=self.speed)
        _check("head_limit", self.head_limit, low=0.0, high=math.pi)
        if self.address is not None and not (len(self.address) == 2 and all(map(math.isfinite, self.address))):
            raise InputError(f"address must be x and y, finite [m], got {self.address}")

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
            InputError: for a room in which there is no place for the talkers beside walls and microphones.
        """
        check_draw(seeds, num_talkers, region, microphones)
        times = sample_times(duration, rate)
        surroundings = self._surroundings(region, microphones)
        num_nodes = int(times[-1] / STEP) + 2
        shapes = (num_talkers, 2 + 2 * _CANDIDATES), (num_nodes, num_talkers, NUM_UNIFORMS)
        traits, numbers = _uniforms(seeds, *shapes)
        habits = self._habits(traits[..., 0])
        pushes, chances = Pushes.of(num_talkers, habits, surroundings), Chances.of(numbers, habits, surroundings)
        nodes = [first(_begin(traits[..., 2:], surroundings, self.apart), chances[0], habits)]
        for happens in chances[1:]:
            nodes.append(step(nodes[-1], happens, habits, surroundings, pushes))
        velocity = torch.stack([node.velocity for node in nodes])
        # The walker's places are the control points of a quadratic B-spline: the curve stays within their hull,
        # and goes through their midpoints with the velocities at the nodes.
        place = torch.stack([node.place for node in nodes]) - velocity * (STEP / 2)
        position, velocity = hermite(times, STEP, place, velocity)
        body = between(times, STEP, torch.stack([node.body for node in nodes]))
        mouth = body + between(times, STEP, torch.stack([node.head for node in nodes]))
        height = self._heights(traits[..., 1], region).expand(len(times), -1, -1)[..., None]
        velocity = torch.nn.functional.pad(velocity, (0, 1))
        return finished(torch.cat([position, height], -1), velocity, body, mouth)

    def _surroundings(self, region: Region, microphones: Tensor | None) -> Surroundings:
        low = torch.tensor(region.low[:2], dtype=torch.float64) + self.margin
        high = torch.tensor(region.high[:2], dtype=torch.float64) - self.margin
        if not (high - low > 2 * STEP).all():
            raise InputError(f"margin must leave room to walk between the walls, got {self.margin} m")
        beside = torch.zeros(0, 2, dtype=torch.float64)
        address = (low + high) / 2
        if microphones is not None and len(microphones) > 0:
            address = microphones.double().mean(0)[:2]
            if self.keep_out > 0:
                beside = microphones.double()[:, :2]
        if self.address is not None:
            address = torch.tensor(self.address, dtype=torch.float64)
        return Surroundings(low, high, beside, self.keep_out, address)

    def _habits(self, unit: Tensor) -> Habits:
        return Habits(
            speed=_truncated_normal(unit, self.speed, self.speed_std, self.speed / 2, self.max_speed),
            max_speed=self.max_speed,
            relaxation=self.relaxation,
            arrival=self.arrival,
            apart=self.apart,
            wall_range=self.wall_range,
            talker_potential=self.talker_potential,
            talker_range=self.talker_range,
            turn_rate=self.turn_rate,
            stop_probability=self.stop_probability,
            stop_duration=self.stop_duration,
            glance_probability=self.glance_probability,
            glance_duration=self.glance_duration,
            head_limit=self.head_limit,
        )

    def _heights(self, unit: Tensor, region: Region) -> Tensor:
        low, high = region.low[2] + _HEAD_ROOM, region.high[2] - _HEAD_ROOM
        _check("height", self.height, low=low, high=high)
        return _truncated_normal(unit, self.height, self.height_std, low, high)


def _check(name: str, value: float, *, low: float, high: float = math.inf, open_low: bool = False) -> None:
    """Raise `InputError` unless `value` is finite and from `low` to `high`."""
    if not (math.isfinite(value) and low <= value <= high and not (open_low and value == low)):
        sign = "more than" if open_low else "at least"
        upper = "" if high == math.inf else f" and at most {high:g}"
        raise InputError(f"{name} must be finite, {sign} {low:g}{upper}, got {value}")


def _uniforms(seeds: Sequence[int], *shapes: tuple[int, ...]) -> list[Tensor]:
    """Return numbers uniform in [0, 1) of each of `shapes`, the runs put before the talkers, the last axis but one."""
    generators = [torch.Generator().manual_seed(seed) for seed in seeds]
    drawn = [[torch.rand(shape, generator=g, dtype=torch.float64) for shape in shapes] for g in generators]
    return [torch.stack(runs, -3) for runs in zip(*drawn, strict=True)]


def _truncated_normal(unit: Tensor, mean: float, std: float, low: float, high: float) -> Tensor:
    """Return the quantiles `unit` of a normal law cut at `low` and `high`."""
    if std == 0:
        return torch.full_like(unit, mean)
    ends = torch.special.ndtr(torch.tensor([low - mean, high - mean], dtype=unit.dtype) / std)
    quantile: Tensor = mean + std * torch.special.ndtri(torch.lerp(ends[0], ends[1], unit))
    return quantile.clamp(low, high)


def _begin(unit: Tensor, surroundings: Surroundings, apart: float) -> Tensor:
    """Return where the talkers stand first, (runs, K, 2): for each the first of its candidates that is free."""
    s = surroundings
    runs, num_talkers = unit.shape[:2]
    places = s.low + (s.high - s.low) * unit.view(runs, num_talkers, _CANDIDATES, 2)
    begun: list[Tensor] = []
    for k in range(num_talkers):  # one after the other: each stands clear of those before
        candidates = places[:, k]  # (runs, candidates, 2)
        taken = s.microphones.expand(runs, -1, -1), *(place[:, None] for place in begun)
        radius = torch.tensor([s.keep_out] * len(s.microphones) + [apart] * k, dtype=unit.dtype)
        distance = torch.linalg.vector_norm(candidates[:, :, None] - torch.cat(taken, 1)[:, None], dim=-1)
        free = (distance > radius + 2 * STEP).all(-1)
        if not free.any(-1).all():
            raise InputError(
                f"num_talkers must fit into the area beside walls and microphones, got {num_talkers} talkers in "
                f"{' x '.join(f'{side:.2f}' for side in (s.high - s.low).tolist())} m"
            )
        begun.append(candidates[torch.arange(runs), free.int().argmax(-1)])
    return torch.stack(begun, 1)
