"""What every way of moving talkers promises, whatever it is."""

import functools
import math

import jsonargparse
import pytest
import torch

from probtrack.errors import InputError
from probtrack.geometry import Region
from probtrack.simulation.trajectories.base import Trajectories
from probtrack.simulation.trajectories.papers import klaassen2005_ways
from probtrack.simulation.trajectories.paths import GivenPaths, SmoothPaths
from probtrack.simulation.trajectories.sampled import ModelWalk
from probtrack.simulation.trajectories.social_force import SocialForceWalk
from probtrack.simulation.trajectories.turning import FacingPoint, InTurn, Turning, TurningTo, Waiting
from probtrack.simulation.trajectories.ways import Arc, Standing, Through

ROOM = Region((0.0, -1.0, 0.0), (4.0, 3.5, 2.5))
MICROPHONES = torch.tensor([[2.0, 1.0, 1.2], [2.2, 1.0, 1.2]])
LINE, ARC = Through(((1.0, 0.5, 1.5), (3.0, 0.5, 1.6))), Arc((2.0, 1.0, 1.4), 1.2, 3.0, -1.0)
TRAJECTORIES = {
    "social force": SocialForceWalk(),
    "smooth": SmoothPaths((((1.0, 0.0, 1.5), (2.0, 1.0, 1.5), (3.0, 0.5, 1.7)), ((0.5, 3.0, 1.5), (3.0, 3.0, 1.5)))),
    "given": GivenPaths((Waiting(ARC, 0.2, 0.3), FacingPoint(LINE, (2.0, 1.0)))),
    "turned": GivenPaths((TurningTo(Standing((1.0, 1.0, 1.5)), 0.0, 7.0), Turning(LINE, 3.0, -0.5))),
    "in turn": GivenPaths((InTurn((LINE, Standing((3.0, 0.5, 1.6))), (0.7, 0.3)), Standing((1.0, 1.0, 1.5), 1.0))),
    "Langevin": ModelWalk(),
    "acceleration": ModelWalk("CU-TCAC", margin=0.0),
    "curvilinear": ModelWalk("CL-TCVE-TCTU"),
    "switching": ModelWalk("moving-stopped"),
}
every = pytest.mark.parametrize("trajectories", TRAJECTORIES.values(), ids=TRAJECTORIES)
drawn_by_law = pytest.mark.parametrize("name", ["social force", "Langevin", "acceleration", "curvilinear", "switching"])


def drawn(trajectories, seeds=(3, 4, 5), **changes):
    arguments = {"num_talkers": 2, "duration": 4.0, "rate": 300.0, "region": ROOM, "microphones": MICROPHONES}
    return trajectories.draw(seeds, **(arguments | changes))


@functools.cache
def usual(trajectories):
    return drawn(trajectories)


@every
def test_shapes_and_finite_numbers(trajectories):
    motion = drawn(trajectories, duration=4.026, rate=100.0)
    assert motion.position.shape == motion.velocity.shape == (403, 3, 2, 3)
    assert motion.body.shape == motion.mouth.shape == (403, 3, 2)
    assert all(column.isfinite().all() for column in motion)
    assert all(column.dtype == torch.get_default_dtype() for column in motion)
    for angle in (motion.body, motion.mouth):
        assert angle.min() >= -math.pi
        assert angle.max() < math.pi


@every
def test_every_mouth_stays_inside(trajectories):
    motion = drawn(trajectories, range(20))
    assert ROOM.contains(motion.position).all()


@every
def test_same_way_at_any_rate(trajectories):
    fine, coarse = usual(trajectories), drawn(trajectories, rate=60.0)
    for many, few in zip(fine, coarse, strict=True):
        torch.testing.assert_close(many[::5], few, rtol=0, atol=1e-9)


@every
def test_run_depends_on_its_seed_alone(trajectories):
    together, alone = usual(trajectories), drawn(trajectories, (4,))
    for many, one in zip(together, alone, strict=True):
        torch.testing.assert_close(many[:, 1:2], one, rtol=0, atol=1e-9)  # products round by the size of a batch


@drawn_by_law
def test_seeds_and_talkers_differ(name):
    place = usual(TRAJECTORIES[name]).position[:, :, :, :2]
    assert (place[:, 0] - place[:, 1]).abs().amax(0).min() > 0.1
    assert (place[:, :, 0] - place[:, :, 1]).abs().amax(0).min() > 0.1


@drawn_by_law
def test_longer_walk_begins_like_a_shorter_one(name):
    """Given ways do not: they take all of the duration."""
    trajectories = TRAJECTORIES[name]
    for long, short in zip(usual(trajectories), drawn(trajectories, duration=1.4), strict=True):
        torch.testing.assert_close(long[:420], short, rtol=0, atol=1e-9)


@every
def test_velocity_is_the_change_of_position(trajectories):
    motion = usual(trajectories)
    speed = torch.linalg.vector_norm(motion.velocity, dim=-1).max()
    middle = (motion.velocity[1:] + motion.velocity[:-1]) / 2
    error = (motion.position.diff(dim=0) * 300 - middle).abs()
    assert torch.quantile(error.flatten()[::7], 0.99) < 5e-3 * (1 + speed)


def test_single_precision_keeps_the_limits():
    torch.set_default_dtype(torch.float32)
    for trajectories in TRAJECTORIES.values():
        motion = drawn(trajectories, rate=16000.0, duration=3.5, seeds=(3,), microphones=MICROPHONES.float())
        assert motion.position.dtype == torch.float32
        assert ROOM.contains(motion.position).all()
        assert motion.mouth.abs().max() <= torch.tensor(math.pi)
        assert motion.mouth.max() < torch.tensor(math.pi)


@pytest.mark.parametrize("name", ["social force", "given", "turned"])
def test_same_way_in_any_precision(name):
    double = usual(TRAJECTORIES[name]).position
    torch.set_default_dtype(torch.float32)
    single = drawn(TRAJECTORIES[name], microphones=MICROPHONES).position  # given in the precision they had
    torch.testing.assert_close(single.double(), double, rtol=0, atol=1e-5)


@every
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": ()}, "seeds must have"),
        ({"seeds": (1.5,)}, "seeds must be an integer"),
        ({"seeds": (2**64,)}, "seeds must be integers below"),
        ({"num_talkers": 0}, "num_talkers must be"),
        ({"duration": math.nan}, "duration must be finite"),
        ({"duration": 0.001}, "duration must be at least one sample"),
        ({"rate": 0.0}, "rate must be finite and positive"),
        ({"region": ROOM.plane()}, "region must have 3 axes"),
        ({"microphones": torch.zeros(3, 2)}, "microphones must have shape"),
        ({"microphones": torch.full((1, 3), math.nan)}, "microphones must be"),
    ],
)
def test_rejects_arguments(trajectories, changes, message):
    with pytest.raises(InputError, match=message):
        drawn(trajectories, **changes)


@pytest.mark.parametrize("name", [*TRAJECTORIES, "paper"])
def test_a_scene_file_can_say_it(name):
    trajectories = klaassen2005_ways("crossing") if name == "paper" else TRAJECTORIES[name]
    parser = jsonargparse.ArgumentParser(exit_on_error=False)
    parser.add_argument("--trajectories", type=Trajectories)
    assert parser.instantiate(parser.parse_object({"trajectories": said(trajectories)})).trajectories == trajectories


def said(value):
    """Return `value` as what a YAML file can hold."""
    if isinstance(value, tuple):
        return [said(part) for part in value]
    if hasattr(value, "__dataclass_fields__"):
        fields = {name: said(getattr(value, name)) for name in value.__dataclass_fields__}
        return {"class_path": f"{type(value).__module__}.{type(value).__name__}", "init_args": fields}
    return value
