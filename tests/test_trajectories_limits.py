"""People who walk keep their distance, always."""

import math

import pytest
import torch

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray, Region, shipped_arrays, wrap_angle
from probtrack.simulation.trajectories.obstacles import Obstacles, admissible, circles, joined, others, push, walls
from probtrack.simulation.trajectories.social_force import SocialForceWalk
from probtrack.simulation.trajectories.walkers import STEP

S1 = Region((0.0, 0.0, 0.0), (3.5, 3.1, 2.2))
SQUARE = MicrophoneArray.from_yaml(shipped_arrays()["lehmann2007"])
PAIR = torch.tensor([[2.6, 2.1, 1.5], [2.6, 2.4, 1.5]])
LAW = SocialForceWalk()
CROWD = SocialForceWalk(speed=1.6, stop_probability=0.1, apart=0.6)


@pytest.fixture
def square():
    return SQUARE.positions.double()


ROOMS = {
    "S1": (LAW, S1, "square", 2),
    "S1, fast and close": (CROWD, S1, "square", 3),
    "office": (LAW, Region((0.0, 0.0, 0.0), (2.8, 4.5, 2.6)), "pair", 2),
    "hall": (CROWD, Region((-5.0, -3.0, 0.0), (5.0, 3.0, 3.0)), None, 5),
    "closet": (SocialForceWalk(margin=0.2), Region((0.0, 0.0, 0.0), (1.2, 0.9, 2.2)), None, 1),
    "wide berth": (SocialForceWalk(margin=0.5, keep_out=0.6), Region((0.0, 0.0, 0.0), (5.0, 4.0, 2.2)), "pair", 2),
}


@pytest.fixture(params=ROOMS.values(), ids=ROOMS, scope="module")
def walk(request):
    law, region, microphones, num_talkers = request.param
    where = {"square": SQUARE.positions.double(), "pair": PAIR.double(), None: None}[microphones]
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)  # the fixture of every test comes after this one
    motion = law.draw(
        range(40), num_talkers=num_talkers, duration=8.0, rate=175.0, region=region, microphones=where
    )  # a rate that meets many phases of the step
    torch.set_default_dtype(before)
    return law, region, where, motion


def test_walks_stay_away_from_walls_microphones_and_each_other(walk):
    law, region, microphones, motion = walk
    plane = motion.position[..., :2]
    low, high = torch.tensor(region.low[:2]) + law.margin, torch.tensor(region.high[:2]) - law.margin
    assert (plane >= low - 1e-9).all()
    assert (plane <= high + 1e-9).all()
    if microphones is not None:
        assert torch.cdist(plane.reshape(-1, 2), microphones[:, :2]).min() >= law.keep_out
    for k in range(1, plane.shape[2]):
        distance = torch.linalg.vector_norm(plane - plane.roll(k, 2), dim=-1)
        assert distance.min() >= law.apart


def test_walks_are_fit_for_people(walk):
    law, _, _, motion = walk
    speed = torch.linalg.vector_norm(motion.velocity, dim=-1)
    assert speed.max() <= law.max_speed
    acceleration = torch.linalg.vector_norm(motion.velocity.diff(dim=0), dim=-1) * 175
    assert torch.quantile(acceleration.flatten()[::11], 0.95) < 3.0
    head = wrap_angle(motion.mouth - motion.body).abs()
    assert head.max() <= law.head_limit + 1e-9
    for angle, most in ((motion.body, 3.0), (motion.mouth, 7.0)):
        rate = wrap_angle(angle.diff(dim=0)) * 175
        assert rate.abs().max() <= most
        assert rate.diff(dim=0).abs().max() < 1.5  # no jumps of the turn rate [rad/s]


def test_nobody_stays_stuck(square):
    law = SocialForceWalk(stop_probability=0.0)
    motion = law.draw(range(30), num_talkers=2, duration=20.0, rate=5.0, region=S1, microphones=square)
    window = motion.position[..., :2].unfold(0, 50, 25)  # 10 s
    way = torch.linalg.vector_norm(window.amax(-1) - window.amin(-1), dim=-1)
    assert (way < 0.5).double().mean() < 0.01
    assert torch.linalg.vector_norm(motion.velocity, dim=-1).mean() > 0.4


@pytest.mark.parametrize("speed", [0.5, 1.7])
def test_no_velocity_crosses_a_limit_however_meant(speed):
    generator = torch.Generator().manual_seed(1)
    place = torch.rand(50, 3, 2, generator=generator) * 0.05 + torch.tensor([[-0.2, 0.0], [1.0, 0.0], [0.0, 1.1]])
    centre = torch.tensor([[0.45, 0.5]])
    low, high = torch.tensor([-0.5, -0.5]), torch.tensor([1.3, 1.2])
    for _ in range(300):
        around = joined(walls(place, low, high), circles(place, centre, 0.3), others(place, 0.4))
        x, y = (centre - place).unbind(-1)
        angle = torch.atan2(y, x) + torch.rand(50, 3, generator=generator) - 0.5  # into the middle
        meant = speed * torch.stack([angle.cos(), angle.sin()], -1)
        place = place + STEP * admissible(meant, around, STEP)
        assert (place >= low - 1e-12).all()
        assert (place <= high + 1e-12).all()
        assert torch.linalg.vector_norm(place - centre, dim=-1).min() > 0.3 - 1e-12
        assert torch.linalg.vector_norm(place - place.roll(1, 1), dim=-1).min() > 0.4 - 1e-12
    assert torch.linalg.vector_norm(place - centre, dim=-1).amin(0).max() < 0.35  # and they came near


def test_free_velocities_pass_unchanged():
    around = walls(torch.zeros(2), torch.tensor([-5.0, -5.0]), torch.tensor([5.0, 5.0]))
    meant = torch.tensor([1.2, -0.7])
    assert torch.equal(admissible(meant, around, STEP), meant)


def test_velocity_along_a_wall_stays():
    around = walls(torch.tensor([1.0, 0.0]), torch.tensor([0.0, 0.0]), torch.tensor([5.0, 5.0]))
    torch.testing.assert_close(admissible(torch.tensor([0.5, -1.0]), around, STEP), torch.tensor([0.5, 0.0]))


def test_push_is_the_gradient_of_the_potential():
    """U R exp(-d / R) of four walls and a circle, by automatic differentiation."""
    low, high, centre = torch.zeros(2), torch.tensor([2.0, 3.0]), torch.tensor([[1.0, 1.5]])
    place = (torch.rand(20, 2) * 0.6 + 0.1).requires_grad_()
    distance = torch.cat([place, high - place, torch.linalg.vector_norm(place - centre, dim=-1)[:, None] - 0.2], -1)
    strength, reach = torch.tensor([3.0] * 4 + [2.0]), torch.tensor([0.2] * 4 + [0.5])
    potential = (strength * reach * torch.exp(-distance / reach)).sum()
    around = joined(walls(place.detach(), low, high), circles(place.detach(), centre, 0.2))
    acceleration = push(around, strength, reach, torch.zeros(5))
    torch.testing.assert_close(acceleration, -torch.autograd.grad(potential, place)[0])


def test_push_aside_goes_to_the_right():
    ahead = Obstacles(torch.tensor([[1.0, 0.0]]), torch.tensor([0.0]))
    acceleration = push(ahead, torch.ones(1), torch.ones(1), torch.full((1,), 0.5))
    torch.testing.assert_close(acceleration, torch.tensor([-math.cos(0.5), -math.sin(0.5)]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"speed": 0.0}, "speed must be finite, more than 0"),
        ({"max_speed": 1.0}, "max_speed must be finite, at least 1.34"),
        ({"stop_probability": 1.5}, "stop_probability must be finite, at least 0 and at most 1"),
        ({"relaxation": math.nan}, "relaxation must be"),
        ({"head_limit": 4.0}, "head_limit must be"),
        ({"address": (1.0, math.inf)}, "address must be x and y"),
    ],
)
def test_rejects_what_it_is_made_of(changes, message):
    with pytest.raises(InputError, match=message):
        SocialForceWalk(**changes)


@pytest.mark.parametrize(
    ("law", "num_talkers", "message"),
    [
        (SocialForceWalk(margin=1.6), 1, "margin must leave room"),
        (SocialForceWalk(height=2.3), 1, "height must be"),
        (SocialForceWalk(apart=2.0), 4, "num_talkers must fit"),
    ],
)
def test_rejects_rooms_without_place(law, num_talkers, message):
    with pytest.raises(InputError, match=message):
        law.draw([1], num_talkers=num_talkers, duration=1.0, rate=10.0, region=S1)
