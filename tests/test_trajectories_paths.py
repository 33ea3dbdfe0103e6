"""Given ways: where they run, how fast, and which way the talker faces."""

import math

import pytest
import torch

from probtrack.errors import InputError
from probtrack.geometry import Region, wrap_angle
from probtrack.simulation.trajectories.paths import GivenPaths, SmoothPaths
from probtrack.simulation.trajectories.turning import FacingPoint, InTurn, Turning, TurningTo, Waiting
from probtrack.simulation.trajectories.ways import Arc, Standing, Through

POINTS = ((0.9, 2.3, 1.5), (1.3, 1.1, 1.4), (2.4, 1.3, 1.6))
LINE = Through(((1.0, 1.0, 1.5), (4.0, 5.0, 1.5)))
ROOM = Region((0.0, 0.0, 0.0), (6.0, 6.0, 3.0))


def times(duration, rate=1000):
    return torch.arange(round(duration * rate) + 1) / rate


def speed_of(motion):
    return torch.linalg.vector_norm(motion.velocity, dim=-1)


def test_way_passes_through_its_points():
    motion = Through(POINTS).at(times(5.0), 5.0)
    assert torch.cdist(torch.tensor(POINTS), motion.position).amin(-1).max() < 1e-3
    torch.testing.assert_close(motion.position[[0, -1]], torch.tensor(POINTS)[[0, -1]])


def test_line_is_straight_and_takes_its_time():
    motion = LINE.at(times(6.0), 6.0)
    direction = torch.tensor([0.6, 0.8, 0.0])
    along = (motion.position - motion.position[0]) @ direction
    torch.testing.assert_close(motion.position, motion.position[0] + along[:, None] * direction)
    torch.testing.assert_close(motion.body, torch.full_like(motion.body, math.atan2(0.8, 0.6)))
    assert speed_of(motion)[3000] == pytest.approx(5.0 / (6.0 - 0.8))  # each ramp loses half its time
    assert along[-1] == pytest.approx(5.0)


@pytest.mark.parametrize("way", [Through(POINTS), Arc((3.0, 3.0, 1.5), 1.5, 1.0, -3.0)])
def test_one_speed_between_soft_ends(way):
    speed = speed_of(way.at(times(5.0), 5.0))
    torch.testing.assert_close(speed[800:4200], speed[2500].expand(3400), rtol=1e-9, atol=0)
    assert speed[0] == 0
    assert speed[-1] < 1e-9
    assert speed.diff().abs().max() < 1.1 * math.pi / 2 * speed.max() / 800  # the steepest of half a cosine
    assert speed[400] == pytest.approx(float(speed[2500]) / 2, rel=1e-6)


@pytest.mark.parametrize(("start", "end"), [(1.0, -3.0), (-1.0, 4.5)])
def test_arc_runs_on_its_circle_the_right_way(start, end):
    motion = Arc((3.0, 2.0, 1.5), 1.2, start, end).at(times(7.0), 7.0)
    offset = motion.position - torch.tensor([3.0, 2.0, 1.5])
    torch.testing.assert_close(torch.linalg.vector_norm(offset, dim=-1), torch.full((7001,), 1.2))
    turned = wrap_angle(torch.atan2(offset[:, 1], offset[:, 0]).diff()).sum()
    assert float(turned) == pytest.approx(end - start)
    assert float(wrap_angle(torch.atan2(offset[0, 1], offset[0, 0]) - start)) == pytest.approx(0, abs=1e-9)
    moving = slice(10, -10)
    direction = torch.atan2(motion.velocity[moving, 1], motion.velocity[moving, 0])
    torch.testing.assert_close(wrap_angle(motion.body[moving] - direction), torch.zeros(6981), rtol=0, atol=1e-9)
    torch.testing.assert_close(motion.mouth, motion.body)


@pytest.mark.parametrize("way", [Through(POINTS), Arc((3.0, 2.0, 1.5), 1.2, 0.0, 2.0), Waiting(LINE, 0.2, 0.3)])
def test_velocity_is_the_change_of_position(way):
    motion = way.at(times(5.0), 5.0)
    change = (motion.position[2:] - motion.position[:-2]) * 500
    torch.testing.assert_close(change, motion.velocity[1:-1], rtol=0, atol=2e-3)


def test_constant_and_turning_mouths():
    still = Standing((1.0, 2.0, 1.5), 0.4)
    assert (still.at(times(2.0), 2.0).mouth == 0.4).all()
    motion = Turning(still, 1.0, -0.5).at(times(4.0), 4.0)
    assert motion.mouth[[0, -1]].tolist() == pytest.approx([1.0, -1.0])
    assert torch.equal(motion.body, motion.mouth)
    assert (motion.velocity == 0).all()
    assert (Turning(LINE, 2.0).at(times(4.0), 4.0).mouth == 2.0).all()


def test_turn_from_one_angle_to_another():
    motion = TurningTo(Standing((1.0, 2.0, 1.5)), 0.5, 7.5).at(times(4.0), 4.0)
    rate = motion.mouth.diff() * 1000
    assert motion.mouth[[0, -1]].tolist() == pytest.approx([0.5, 7.5])
    assert float(rate[2000]) == pytest.approx(7.0 / (4.0 - 0.3))
    assert rate[0] < 1e-2
    assert rate.min() >= -1e-9


def test_mouth_towards_a_point():
    motion = FacingPoint(LINE, (0.0, 3.0)).at(times(5.0), 5.0)
    reached = motion.position[:, :2] + 0.1 * torch.stack([motion.mouth.cos(), motion.mouth.sin()], -1)
    before, after = (
        torch.linalg.vector_norm(x - torch.tensor([0.0, 3.0]), dim=-1) for x in (motion.position[:, :2], reached)
    )
    torch.testing.assert_close(before - after, torch.full_like(before, 0.1))
    assert torch.equal(motion.body, LINE.at(times(5.0), 5.0).body)


def test_waiting_holds_both_ends():
    motion, whole = Waiting(LINE, 0.25, 0.25).at(times(8.0), 8.0), LINE.at(times(4.0), 4.0)
    torch.testing.assert_close(motion.position[2000:6001], whole.position)
    assert (motion.position[:2001] == motion.position[0]).all()
    assert (motion.position[6000:] == motion.position[-1]).all()
    assert (motion.velocity[:2000] == 0).all()
    assert (Waiting(Through(LINE.points, ramp=0.0), 0.25, 0.25).at(times(8.0), 8.0).velocity[:1999] == 0).all()


def test_ways_in_turn():
    back = Through(((4.0, 5.0, 1.5), (1.0, 4.0, 1.5)))
    motion = InTurn((LINE, back), (0.75, 0.25)).at(times(12.0), 12.0)
    torch.testing.assert_close(motion.position[:9000], LINE.at(times(9.0), 9.0).position[:9000])
    torch.testing.assert_close(motion.position[9000:], back.at(times(3.0), 3.0).position)


def test_given_paths_have_their_talkers_in_order_in_every_run():
    given = GivenPaths((LINE, Turning(Standing((1.0, 2.0, 1.5)), 3.0, 1.0)))
    motion = given.draw([5, 6, 7], num_talkers=2, duration=4.0, rate=100.0, region=ROOM)
    torch.testing.assert_close(motion.position[:, 1, 0], LINE.at(times(4.0, 100)[:-1], 4.0).position)
    assert torch.equal(motion.position[:, 0], motion.position[:, 2])
    expected = wrap_angle(3.0 + times(4.0, 100)[:-1])
    torch.testing.assert_close(motion.mouth[:, 1, 1], expected)


def test_smooth_paths_are_given_paths():
    arguments = {"num_talkers": 2, "duration": 4.0, "rate": 50.0, "region": ROOM}
    smooth = SmoothPaths((POINTS, LINE.points), ramp=0.5).draw([1], **arguments)
    given = GivenPaths((Through(POINTS, 0.5), Through(LINE.points, 0.5))).draw([1], **arguments)
    assert all(map(torch.equal, smooth, given))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Through(POINTS[:1]), "points must be x, y and z, finite .*, 2 of them or more"),
        (lambda: Through(((0.0, 1.0, 1.0), (0.0, math.nan, 1.0))), "points must be"),
        (lambda: Through(((0.0, 1.0), (1.0, 1.0))), "points must be"),
        (lambda: Through((POINTS[0], POINTS[0])), "must differ in x or y"),
        (lambda: Through(POINTS, ramp=-1.0), "ramp must be"),
        (lambda: SmoothPaths((POINTS, POINTS[:1])), "points must be"),
        (lambda: Arc((1.0, 1.0, 1.0), 0.0, 0.0, 1.0), "radius must be"),
        (lambda: Arc((1.0, 1.0, 1.0), 1.0, 1.0, 1.0), "start and end must be finite and differ"),
        (lambda: Standing((1.0, math.inf, 1.0)), "point must be"),
        (lambda: Standing((1.0, 1.0, 1.0), math.nan), "angle must be finite"),
        (lambda: Turning(LINE, 0.0, math.inf), "rate must be finite"),
        (lambda: TurningTo(LINE, 0.0, 1.0, -1.0), "ramp must not be negative"),
        (lambda: FacingPoint(LINE, (1.0, 2.0, 3.0)), "point must be x and y"),
        (lambda: InTurn((LINE, LINE), (0.5, 0.5)), r"number 2 must begin where number 1 ends, at \[4.0, 5.0, 1.5\]"),
        (lambda: InTurn((LINE,), (0.5,)), "shares must be positive and 1 together"),
        (lambda: InTurn((), ()), "shares must be as many"),
        (lambda: Waiting(LINE, 0.5, 0.5), "before and after must be"),
    ],
)
def test_rejects_ways(make, message):
    with pytest.raises(InputError, match=message):
        make()


@pytest.mark.parametrize(
    ("way", "changes", "message"),
    [
        (LINE, {"num_talkers": 2}, "num_talkers must be 1, one a way"),
        (LINE, {"duration": 1.5}, "duration of a way must be more than 1.6 s"),
        (LINE, {"region": Region((0.0, 0.0, 0.0), (3.0, 6.0, 3.0))}, r"talker 1 must stay inside the room, got \[3"),
        (FacingPoint(LINE, (1.0, 1.0)), {}, "point must be beside the way"),
    ],
)
def test_rejects_draws(way, changes, message):
    arguments = {"num_talkers": 1, "duration": 5.0, "rate": 50.0, "region": ROOM}
    with pytest.raises(InputError, match=message):
        GivenPaths((way,)).draw([1], **(arguments | changes))
