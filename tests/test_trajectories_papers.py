"""The ways of the three papers are what their text says."""

import math

import pytest
import torch

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray, Region, shipped_arrays, wrap_angle
from probtrack.simulation.trajectories.papers import fallon2006_way, klaassen2005_ways, lehmann2007_way

S1, S2, S3 = (Region((0.0, 0.0, 0.0), size) for size in ((3.5, 3.1, 2.2), (5.5, 6.1, 2.8), (2.8, 4.5, 2.6)))
TWO = ("crossing", "approach", "turn-back")


def walked(given, region, duration, rate=50.0):
    motion = given.draw([1], num_talkers=len(given.ways), duration=duration, rate=rate, region=region)
    return motion.every(torch.arange(len(motion.body)))._replace(position=motion.position[:, 0])


def speed_of(motion):
    return torch.linalg.vector_norm(motion.velocity[:, 0], dim=-1)


def length_of(motion):
    return torch.linalg.vector_norm(motion.position.diff(dim=0), dim=-1).sum(0)


@pytest.mark.parametrize("number", range(1, 6))
def test_s1_ways_cross_the_square_in_8_s(number):
    motion = walked(lehmann2007_way(number), S1, 8.0)
    array = MicrophoneArray.from_yaml(shipped_arrays()["lehmann2007"])
    assert Region((0.49, 0.29, 1.5), (3.01, 2.81, 1.52)).contains(motion.position).all()
    assert torch.cdist(motion.position[:, 0, :2], array.positions[:, :2]).min() > 0.3
    assert 2.0 < float(length_of(motion)) < 4.5
    assert speed_of(motion).max() < 0.8


def test_s1_ways_differ_and_the_first_is_that_of_the_demo():
    ways = torch.stack([walked(lehmann2007_way(number), S1, 8.0).position[:, 0] for number in range(1, 6)])
    assert torch.linalg.vector_norm(ways[:, None] - ways, dim=-1).mean(-1).add(torch.eye(5)).min() > 0.3
    torch.testing.assert_close(ways[0, 0], torch.tensor([0.85, 0.95, 1.51]))
    assert float(length_of(walked(lehmann2007_way(1), S1, 8.0))) == pytest.approx(2.2, abs=0.1)


@pytest.mark.parametrize("number", range(1, 5))
def test_s2_walks_have_one_speed_and_point_where_they_go(number):
    motion = walked(fallon2006_way(number), S2, 25.0)
    assert (motion.position[..., 2] == 1.2).all()
    assert 0.15 < float(speed_of(motion).max()) < 0.5
    torch.testing.assert_close(speed_of(motion)[50:-50], speed_of(motion)[600].expand(1150, 1))
    direction = torch.atan2(motion.velocity[5:-5, 0, 0, 1], motion.velocity[5:-5, 0, 0, 0])
    assert wrap_angle(direction - motion.mouth[5:-5, 0, 0]).abs().max() < 1e-6
    turned = float(wrap_angle(motion.mouth[:, 0, 0].diff()).abs().sum())
    assert turned < 1e-6 if number == 1 else turned > 1.0
    edge = torch.tensor([5.5, 6.1])
    assert torch.minimum(motion.position[:, 0, :2], edge - motion.position[:, 0, :2]).min() > 0.5


def test_s2_ways_are_numbered_from_left_to_right():
    middles = [walked(fallon2006_way(number), S2, 25.0).position[:, 0, 0].mean() for number in range(1, 5)]
    assert middles == sorted(middles)


def test_s2_stands_and_turns():
    motion = walked(fallon2006_way(5), S2, 30.0)
    assert (motion.position == torch.tensor([2.7, 3.9, 1.2])).all()
    rate = wrap_angle(motion.mouth[:, 0, 0].diff()) * 50
    assert float(rate.clamp(min=0).sum() / 50) == pytest.approx(1.5 * math.pi, rel=1e-3)
    assert float(rate.clamp(max=0).sum() / 50) == pytest.approx(-1.25 * math.pi, rel=1e-3)
    assert rate.abs().max() < 0.5


def broadside(motion):
    """Angle and distance from the pair, which looks along -x, its first microphone towards -y."""
    offset = motion.position - torch.tensor([2.6, 2.25, 1.6])
    return torch.atan2(-offset[..., 1], -offset[..., 0]), torch.linalg.vector_norm(offset, dim=-1)


def test_s3_arc():
    angle, distance = broadside(walked(klaassen2005_ways("arc"), S3, 20.0))
    assert float(angle[0]) == pytest.approx(0.0, abs=1e-6)
    assert float(distance[0]) == pytest.approx(0.5)
    assert (distance[:150] == distance[0]).all()  # "after a few seconds"
    assert (distance[500:] == distance[-1]).all()  # "halfway of the recording"
    assert float(distance[-1]) == pytest.approx(3.0, abs=0.15)
    assert float(angle[-1]) == pytest.approx(-0.78, abs=0.03)
    assert angle.diff(dim=0).max() < 1e-9


def test_s3_corner():
    angle, distance = broadside(walked(klaassen2005_ways("corner"), S3, 10.0))
    assert torch.allclose(angle, torch.tensor(-0.9))
    assert (distance > 2.5).all()


def test_s3_across():
    angle, _ = broadside(walked(klaassen2005_ways("across"), S3, 20.0))
    assert [float(angle[0]), float(angle[-1])] == pytest.approx([0.78, -0.78])
    assert angle.diff(dim=0).max() < 1e-9


def test_s3_crossing():
    motion = walked(klaassen2005_ways("crossing"), S3, 45.0)
    angle, distance = broadside(motion)
    assert angle[[0, -1]].flatten().tolist() == pytest.approx([0.9, -0.9, -0.9, 0.9])
    stays = (speed_of(motion) < 1e-6) & (angle.abs() < 0.05)
    assert stays.all(-1).sum() > 100  # both, for two seconds at least
    assert float(distance[stays].mean()) == pytest.approx(1.1, abs=0.15)
    first, last = motion.velocity[: 45 * 29], motion.velocity[45 * 35 :]
    assert last.norm(dim=-1).max() > 1.5 * first.norm(dim=-1).max()


def test_s3_approach():
    motion = walked(klaassen2005_ways("approach"), S3, 45.0)
    angle, distance = broadside(motion)
    assert angle[:, 0].abs().max() < 1e-6
    assert (motion.velocity[:, 0, 0] == 0).all()
    assert float(angle[0, 1]) == pytest.approx(-0.9)
    assert float(torch.dist(motion.position[-1, 0], motion.position[-1, 1])) < 0.7
    assert distance[:, 1].diff().max() < 1e-6


def test_s3_turn_back():
    angle, _ = broadside(walked(klaassen2005_ways("turn-back"), S3, 45.0))
    assert angle[[0, -1]].flatten().tolist() == pytest.approx([0.9, -0.9, 0.9, -0.9])
    assert (angle[:, 0] > 0.25).all()
    assert (angle[:, 1] < -0.25).all()
    assert angle.abs().amin(0).max() < 0.3


@pytest.mark.parametrize("name", ["arc", "corner", "across", *TWO])
@pytest.mark.parametrize("duration", [20.0, 45.0])
def test_s3_talkers_are_fit_for_people(name, duration):
    motion = walked(klaassen2005_ways(name), S3, duration)
    assert torch.minimum(motion.position, torch.tensor(S3.high) - motion.position)[..., :2].min() > 0.2
    assert speed_of(motion).max() < 1.5
    assert (wrap_angle(motion.body.diff(dim=0)).abs() * 50).max() < 4.0  # nobody jumps round
    x, y = (torch.tensor([2.6, 2.25]) - motion.position[..., :2]).unbind(-1)
    assert wrap_angle(motion.mouth[:, 0] - torch.atan2(y, x)).abs().max() < 1e-9
    if name in TWO:
        assert torch.linalg.vector_norm(motion.position[:, 0] - motion.position[:, 1], dim=-1).min() > 0.45


@pytest.mark.parametrize("make", [lambda: lehmann2007_way(6), lambda: fallon2006_way(0), lambda: lehmann2007_way(True)])
def test_rejects_numbers(make):
    with pytest.raises(InputError, match="number must be from 1 to 5"):
        make()


def test_rejects_names():
    with pytest.raises(InputError, match="name must be one of arc, corner"):
        klaassen2005_ways("dance")
