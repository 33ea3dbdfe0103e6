"""Ways drawn from a motion model keep its law, and stay inside."""

import math

import numpy as np
import pytest
import torch
from oracles import lehmann_matrices as oracle

from probtrack.dynamics import CoordinateUncoupled, DrivenVelocity, Kinematics, RandomWalk, WithHeading, lehmann2007
from probtrack.errors import InputError
from probtrack.geometry import Region, wrap_angle
from probtrack.simulation.trajectories.sampled import ModelWalk, sample_paths
from probtrack.switching import speech_and_silence

FAR = Region((-1e3, -1e3), (1e3, 1e3))
BOX = Region((1.0, -2.0), (3.5, 1.0))


def straight():
    return CoordinateUncoupled(DrivenVelocity(RandomWalk(1e-12)), 2)


def begun(runs, talkers, position, velocity):
    shape = runs, talkers, len(position)
    return Kinematics(torch.tensor(position).expand(shape), torch.tensor(velocity).expand(shape))


@pytest.mark.parametrize(
    ("name", "matrices"),
    [
        ("CU-LAN", oracle.langevin(0.032, 0.2, 0.7)),
        ("CU-LAN-ORIG", oracle.langevin(0.032, 10.0, 0.8)),
        ("CU-TCAC", oracle.time_correlated_acceleration(0.032, 30.0, 2.0)),
        ("CU-RWVE", oracle.random_walk_velocity(0.032, 0.05)),
    ],
)
def test_law_is_the_models_away_from_walls(name, matrices):
    """Mean and covariance of place and velocity after 20 steps, against matrices written out by hand."""
    matrix, gain = matrices
    start = begun(20, 1000, (1.0, 2.0), (0.6, -0.3))
    known = sample_paths(lehmann2007(name), range(20), start=start, num_steps=20, dt=0.032, region=FAR)
    last = torch.cat([known.position[-1], known.velocity[-1]], -1).reshape(-1, 4).numpy()
    mean = np.array([1.0, 2.0, 0.6, -0.3, 0.0, 0.0][: len(matrix)])
    covariance = np.zeros_like(matrix)
    for _ in range(20):
        mean, covariance = matrix @ mean, matrix @ covariance @ matrix.T + gain @ gain.T
    std = np.sqrt(np.diag(covariance))[:4]
    np.testing.assert_allclose(last.mean(0) / std, mean[:4] / std, atol=4 / math.sqrt(len(last)))
    found, expected = np.cov(last.T) / np.outer(std, std), covariance[:4, :4] / np.outer(std, std)
    np.testing.assert_allclose(found, expected, atol=0.04)


def test_steps_are_independent_of_each_other_and_of_other_talkers():
    start = begun(5, 4, (0.0, 0.0), (0.0, 0.0))
    known = sample_paths(lehmann2007("CU-RWVE"), range(5), start=start, num_steps=400, dt=0.032, region=FAR)
    driven = known.velocity.diff(dim=0).reshape(400, -1)  # (steps, runs x talkers x axes)
    columns = torch.cat([driven[1:], driven[:-1]], -1)
    correlation = torch.corrcoef(columns.T) - torch.eye(columns.shape[1])
    assert correlation.abs().max() < 5 / math.sqrt(400)


def test_straight_ways_are_folded_at_the_walls():
    """A ball that goes straight: the triangle wave of the distance it has gone."""
    speed = (0.9, -1.7)
    known = sample_paths(straight(), [0], start=begun(1, 1, (1.2345, 0.5432), speed), num_steps=300, dt=0.1, region=BOX)
    time = np.arange(301) * 0.1
    for axis, (place, low, high) in enumerate(((1.2345, 1.0, 3.5), (0.5432, -2.0, 1.0))):
        phase = (place + speed[axis] * time - low) / (high - low)
        expected = low + (high - low) * np.abs(phase - 2 * np.round(phase / 2))
        np.testing.assert_allclose(known.position[:, 0, 0, axis].numpy(), expected, atol=1e-8)
        sign = np.where(np.floor(phase) % 2 == 0, 1, -1)
        np.testing.assert_allclose(known.velocity[:, 0, 0, axis].numpy(), sign * speed[axis], atol=1e-8)


@pytest.mark.parametrize("name", ["CU-TCAC", "CL-RWVE-RWAC", "CL-TCVE-TCAC", "CU-LAN-ORIG"])
def test_wild_ways_stay_inside(name):
    start = begun(10, 20, (1.01, 0.99), (-9.0, 9.0))
    known = sample_paths(lehmann2007(name), range(10), start=start, num_steps=400, dt=0.032, region=BOX)
    assert BOX.contains(known.position).all()
    assert known.velocity.isfinite().all()


def test_heading_beside_the_motion_stays_at_a_wall():
    model = WithHeading(straight(), DrivenVelocity(RandomWalk(1e-12)))
    start = begun(1, 1, (3.4, 0.0), (1.0, 0.0))._replace(modelled_heading=torch.full((1, 1), 0.7))
    known = sample_paths(model, [0], start=start, num_steps=5, dt=0.1, region=BOX)
    assert known.velocity[-1, 0, 0, 0] < 0
    torch.testing.assert_close(known.modelled_heading, torch.full((6, 1, 1), 0.7))


def test_three_axes_too():
    region = Region((0.0, 0.0, 0.0), (3.0, 3.0, 2.0))
    start = begun(2, 3, (1.0, 1.0, 1.9), (0.5, 0.5, 0.5))
    known = sample_paths(lehmann2007("CU-LAN", 3), [1, 2], start=start, num_steps=50, dt=0.032, region=region)
    assert known.position.shape == (51, 2, 3, 3)
    assert region.contains(known.position).all()


def test_walk_passes_through_the_places_of_the_model():
    """At the model's own steps it is the model's way, in between no other coordinate than between two of them."""
    walk = ModelWalk("CU-LAN", margin=0.4)
    arguments = {"num_talkers": 2, "duration": 6.4, "region": Region((0.0, 0.0, 0.0), (4.0, 3.0, 2.5))}
    steps = walk.draw([1, 2], rate=31.25, **arguments).position
    fine = walk.draw([1, 2], rate=312.5, **arguments).position[:-10].unflatten(0, (-1, 10))
    low, high = torch.minimum(steps[:-1], steps[1:]), torch.maximum(steps[:-1], steps[1:])
    assert ((fine >= low[:, None] - 1e-9) & (fine <= high[:, None] + 1e-9)).all()
    # Langevin motion: the velocity forgets itself at 0.2 /s
    velocity = (steps.diff(dim=0) / 0.032)[..., :2]
    change = velocity.diff(dim=0).flatten()
    assert float(change.abs().median()) == pytest.approx(
        0.6745 * 0.7 * math.sqrt(1 - math.exp(-2 * 0.2 * 0.032)), rel=0.1
    )


def test_angles_between_two_steps_take_the_shorter_way_round():
    walk = ModelWalk("CU-LAN-ORIG")
    arguments = {"num_talkers": 4, "duration": 6.4, "region": Region((0.0, 0.0, 0.0), (4.0, 3.0, 2.5))}
    steps = walk.draw([1, 2], rate=31.25, **arguments).body
    fine = walk.draw([1, 2], rate=312.5, **arguments).body[:-10].unflatten(0, (-1, 10))
    turn = wrap_angle(steps.diff(dim=0))
    assert (wrap_angle(fine - steps[:-1, None]).abs() <= turn.abs()[:, None] + 1e-9).all()


def test_start_tells_nothing_of_the_steps():
    arguments = {
        "num_talkers": 1,
        "duration": 0.15,
        "rate": 31.25,
        "region": Region((0.0, 0.0, 0.0), (60.0, 40.0, 2.5)),
    }
    motion = ModelWalk("CU-LAN").draw(range(400), **arguments)
    velocity = motion.position[:, :, 0, :2].diff(dim=0) / 0.032
    angle = motion.body[0, :, 0]
    before = 0.5 * math.exp(-0.2 * 0.032) * torch.stack([angle.cos(), angle.sin()], -1)
    driven = torch.cat([velocity[0] - before, velocity[1] - velocity[0]], -1)
    columns = torch.cat([motion.position[0, :, 0, :2], angle[:, None], driven, driven.abs()], -1)
    assert torch.corrcoef(columns.T)[:3, 3:].abs().max() < 0.2


def test_walk_begins_anywhere_at_its_speed():
    walk = ModelWalk("CU-RWVE", speed=0.8)
    motion = walk.draw(
        range(300), num_talkers=1, duration=0.2, rate=100.0, region=Region((0.0, 0.0, 0.0), (60.0, 40.0, 2.5))
    )
    speed = torch.linalg.vector_norm(motion.velocity[0], dim=-1)
    assert float(speed.median()) == pytest.approx(0.8, rel=0.05)
    share = motion.position[0, :, 0, :2] / torch.tensor([60.0, 40.0])
    torch.testing.assert_close(share.mean(0), torch.tensor([0.5, 0.5]), rtol=0, atol=0.06)
    angle = motion.body[0, :, 0]
    assert torch.stack([angle.cos(), angle.sin()]).mean(-1).abs().max() < 0.15
    direction = torch.atan2(motion.velocity[0, :, 0, 1], motion.velocity[0, :, 0, 0])
    assert torch.cos(direction - angle).median() > 0.99


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model": "CU-NONE"}, "name must be one of"),
        ({"model": "teleconference"}, "model must not listen to speech"),
        ({"step": 0.0}, "step must be finite"),
        ({"margin": -1.0}, "margin must be"),
        ({"margin": 2.0}, "margin must leave a place"),
        ({"height": 3.0}, "height must be from 0 to 2.5 m"),
    ],
)
def test_rejects_walks(changes, message):
    with pytest.raises(InputError, match=message):
        ModelWalk(**changes).draw(
            [1], num_talkers=1, duration=1.0, rate=10.0, region=Region((0.0, 0.0, 0.0), (3.0, 3.0, 2.5))
        )


def test_rejects_paths():
    start = begun(1, 1, (2.0, 0.0), (0.0, 0.0))
    good = {"start": start, "num_steps": 3, "dt": 0.1, "region": BOX}
    bad = [
        ({"region": Region((0.0, 0.0, 0.0), (3.0, 3.0, 2.5))}, "region must have 2 axes"),
        ({"start": begun(2, 1, (2.0, 0.0), (0.0, 0.0))}, "start must be"),
        ({"start": begun(1, 1, (5.0, 0.0), (0.0, 0.0))}, "start must be inside"),
        ({"num_steps": 0}, "num_steps must be"),
    ]
    for changes, message in bad:
        with pytest.raises(InputError, match=message):
            sample_paths(straight(), [0], **(good | changes))
    with pytest.raises(InputError, match="speech must be given"):
        sample_paths(speech_and_silence(), [0], **good)
