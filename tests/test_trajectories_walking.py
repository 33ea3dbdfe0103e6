"""The numbers of people who walk, against what is known of them."""

import math

import pytest
import scipy.stats
import torch

from probtrack.geometry import Region, wrap_angle
from probtrack.simulation.trajectories import habits as parts
from probtrack.simulation.trajectories import walkers
from probtrack.simulation.trajectories.social_force import SocialForceWalk

HALL = Region((0.0, 0.0, 0.0), (60.0, 60.0, 3.0))
HEADWAY = SocialForceWalk(stop_probability=0.0, glance_probability=0.0)


def drawn(law, *, runs=40, talkers=1, duration=10.0, rate=50.0, region=HALL, **arguments):
    return law.draw(range(runs), num_talkers=talkers, duration=duration, rate=rate, region=region, **arguments)


@pytest.fixture(scope="module")
def headway():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)  # the fixture of every test comes after this one
    motion = drawn(HEADWAY, runs=100, duration=12.0, region=Region((0.0, 0.0, 0.0), (12.0, 12.0, 3.0)))
    torch.set_default_dtype(before)
    return motion


def speed_of(motion):
    return torch.linalg.vector_norm(motion.velocity, dim=-1)


def test_desired_speeds_follow_the_truncated_normal_law():
    motion = drawn(HEADWAY, runs=400, duration=8.0, rate=10.0)
    fastest = speed_of(motion).amax(0)[:, 0]
    cut = (1.34 / 2 - 1.34) / 0.26, (1.72 - 1.34) / 0.26
    law = scipy.stats.truncnorm(*cut, loc=1.34, scale=0.26)
    assert float(fastest.mean()) == pytest.approx(law.mean(), abs=0.03)
    assert float(fastest.std()) == pytest.approx(law.std(), abs=0.02)
    assert scipy.stats.kstest(fastest.numpy(), law.cdf).pvalue > 0.01
    together = torch.stack([fastest, motion.position[0, :, 0, 2]])
    assert abs(float(torch.corrcoef(together)[0, 1])) < 0.15  # the tall are no faster


@pytest.mark.parametrize("relaxation", [0.5, 1.0])
def test_standing_start_relaxes_exponentially(relaxation):
    law = SocialForceWalk(speed_std=0.0, stop_probability=0.0, relaxation=relaxation)
    motion = drawn(law, duration=2.0, rate=10.0)
    time = torch.arange(20)[:, None] / 10
    expected = 1.34 * (1 - torch.exp(-time / relaxation))
    far = (motion.position[-1, :, 0, :2] - 30).abs().amax(-1) < 29  # from the walls
    torch.testing.assert_close(speed_of(motion)[:, far, 0], expected.expand(20, int(far.sum())), rtol=1e-3, atol=0)


def test_goals_change_within_half_a_metre():
    law, region = SocialForceWalk(stop_probability=0.5), Region((0.0, 0.0, 0.0), (8.0, 7.0, 2.5))
    surroundings, generator = law._surroundings(region, None), torch.Generator().manual_seed(0)
    habits = law._habits(torch.rand(100, 1, generator=generator))
    numbers = torch.rand(600, 100, 1, parts.NUM_UNIFORMS, generator=generator)
    chances = parts.Chances.of(numbers, habits, surroundings)
    place = surroundings.low + (surroundings.high - surroundings.low) * torch.rand(100, 1, 2, generator=generator)
    state, pushes = walkers.first(place, chances[0], habits), parts.Pushes.of(1, habits, surroundings)
    left, stood = [], []
    for happens in chances[1:]:
        before, state = state, walkers.step(state, happens, habits, surroundings, pushes)
        new = (state.goal != before.goal).any(-1) & (before.patience > 0)
        left.append(torch.linalg.vector_norm(before.goal - before.place, dim=-1)[new])
        stood.append(state.standing[new])
    left, stood = torch.cat(left), torch.cat(stood)
    assert len(left) > 150
    assert left.max() < 0.5
    assert left.median() > 0.5 - 1.72 * walkers.STEP
    assert float((stood > 0).double().mean()) == pytest.approx(0.5, abs=0.1)
    assert float(stood[stood > 0].median()) == pytest.approx(3 * math.log(2), rel=0.5)


def test_chances_follow_their_laws():
    law = SocialForceWalk()
    surroundings = law._surroundings(Region((1.0, 2.0, 0.0), (5.0, 4.0, 3.0)), None)
    habits, numbers = law._habits(torch.full((100, 3), 0.5)), torch.rand(200, 100, 3, parts.NUM_UNIFORMS)
    columns = zip(*parts.Chances.of(numbers, habits, surroundings), strict=True)
    goal, stops, standing, look, looking = (torch.stack(column) for column in columns)
    for axis, low, high in ((0, 1.3, 4.7), (1, 2.3, 3.7)):
        uniform = scipy.stats.uniform(low, high - low)
        assert scipy.stats.kstest(goal[..., axis].flatten()[::10].numpy(), uniform.cdf).pvalue > 0.01
    assert float(stops.double().mean()) == pytest.approx(0.4, abs=0.01)
    for time, mean in ((standing, 3.0), (looking, 2.0)):
        assert scipy.stats.kstest(time.flatten()[::10].numpy(), scipy.stats.expon(0, mean).cdf).pvalue > 0.01
    columns = [goal[..., 0, 0], goal[..., 1, 0], goal[..., 0, 1], goal[..., 1, 1], stops, standing, look, looking]
    together = torch.corrcoef(torch.stack([column.double().flatten() for column in columns]))
    assert (together - torch.eye(8)).abs().max() < 0.02
    shares = torch.bincount(look.flatten(), minlength=4) / look.numel()  # ahead, the point, two others
    torch.testing.assert_close(shares, torch.tensor([0.6, 0.4 / 3, 0.4 / 3, 0.4 / 3]), rtol=0, atol=0.01)


def test_talker_is_pushed_by_another_as_the_potential_says():
    """One who stands 0.8 m before another: A / B exp(-d / B), most of it straight back."""
    law = SocialForceWalk(stop_probability=0.0, speed_std=0.0)
    surroundings = law._surroundings(HALL, None)
    habits = law._habits(torch.full((1, 2), 0.5))
    place = torch.tensor([[[30.0, 30.0], [30.8, 30.0]]])
    chances = parts.Chances.of(torch.full((1, 1, 2, parts.NUM_UNIFORMS), 0.5), habits, surroundings)[0]
    state = walkers.first(place, chances, habits)
    state = state._replace(goal=torch.tensor([[[50.0, 30.0], [50.0, 30.0]]]), body=torch.zeros(1, 2))
    push = 2.1 / 0.3 * math.exp(-0.8 / 0.3) * math.cos(0.5)
    taken_up = -math.expm1(-walkers.STEP)
    speed = walkers.step(state, chances, habits, surroundings, parts.Pushes.of(2, habits, surroundings)).velocity[
        0, :, 0
    ]
    # `apart` has a slack of 2 x 9 mm, which moves the potential by as much
    assert float(speed[0]) == pytest.approx((1.34 - push) * taken_up, rel=0.03)
    assert float(speed[1]) == pytest.approx(min(1.34 + push, 1.72) * taken_up, rel=0.03)


def test_turn_rate_falls_with_speed(headway):
    """In turns the rate goes with about speed^-0.8, and is never above it."""
    motion = headway
    direction = torch.atan2(motion.velocity[..., 1], motion.velocity[..., 0])
    rate = wrap_angle(direction.diff(dim=0)).abs() * 50
    speed = (speed_of(motion)[1:] + speed_of(motion)[:-1]) / 2
    assert (rate < 1.06 * 1.2 * speed**-0.8)[speed > 0.35].all()
    turns = (rate > 0.5) & (speed > 0.35)
    slope = scipy.stats.linregress(speed[turns].log().numpy(), rate[turns].log().numpy()).slope
    assert slope == pytest.approx(-0.8, abs=0.2)


def test_body_faces_the_way_of_those_who_walk(headway):
    motion = headway
    walking = speed_of(motion) > 0.3
    direction = torch.atan2(motion.velocity[..., 1], motion.velocity[..., 0])
    assert torch.quantile(wrap_angle(direction - motion.body).abs()[walking], 0.99) < 0.05


def test_those_who_stand_turn_on_the_spot():
    motion = drawn(SocialForceWalk(stop_probability=1.0), runs=100, duration=9.0, region=Region((0, 0, 0), (6, 5, 3)))
    standing = (speed_of(motion) < 0.05)[1:]
    rate = wrap_angle(motion.body.diff(dim=0)).abs() * 50
    assert 0.2 < standing.double().mean() < 0.8
    assert 0.05 < (rate[standing] > 0.5).double().mean() < 0.6


def test_nobody_stops_who_never_stands(headway):
    assert (speed_of(headway)[100:] < 0.01).double().mean() < 0.001


def test_head_looks_ahead_unless_it_glances(headway):
    motion = headway
    direction, head = torch.atan2(motion.velocity[..., 1], motion.velocity[..., 0]), motion.mouth - motion.body
    straight = (wrap_angle(direction.diff(dim=0)).abs() * 50 < 0.01) & (speed_of(motion)[1:] > 1.0)
    assert torch.quantile(wrap_angle(head)[1:][straight].abs(), 0.95) < 0.02
    turning = wrap_angle(motion.body.diff(dim=0)) * 50
    sharp = turning.abs() > 0.5  # into the curve, before the body
    assert (turning.sign() == wrap_angle(head)[1:].sign())[sharp].double().mean() > 0.85


@pytest.mark.parametrize("given", ["address", "microphones", "neither"])
def test_head_turns_to_what_it_looks_at(given):
    region = Region((0.0, 0.0, 0.0), (9.0, 9.0, 3.0))
    place = torch.tensor([4.5, 4.5] if given == "neither" else [7.0, 2.0])
    microphones = torch.tensor([[6.9, 2.0, 1.0], [7.1, 2.0, 1.0]]) if given == "microphones" else None
    address = (7.0, 2.0) if given == "address" else None
    law = SocialForceWalk(glance_probability=1.0, glance_duration=0.5, address=address)  # soon looks there
    motion = drawn(law, runs=60, duration=7.0, region=region, microphones=microphones)
    offset = place - motion.position[..., :2]
    towards = torch.atan2(offset[..., 1], offset[..., 0])
    near = wrap_angle(towards - motion.body).abs() < 1.0
    near[1:] &= wrap_angle(motion.body.diff(dim=0)).abs() * 50 < 0.3
    settled = near.unfold(0, 50, 1).all(-1)  # a second long
    error = wrap_angle(motion.mouth - towards)[49:][150:][settled[150:]].abs()
    assert settled.double().mean() > 0.05
    assert torch.quantile(error[::5], 0.9) < 0.25


def test_heads_turn_to_each_other_too():
    law = SocialForceWalk(glance_probability=1.0, stop_probability=1.0, stop_duration=20.0, address=(1.0, 59.0))
    motion = drawn(law, talkers=2, duration=8.0, region=Region((0.0, 0.0, 0.0), (6.0, 6.0, 3.0)))
    offset = (motion.position - motion.position.flip(2)).neg()
    mutual = wrap_angle(torch.atan2(offset[..., 1], offset[..., 0]) - motion.mouth).abs() < 0.1
    assert 0.2 < mutual[300:].double().mean() < 0.7


def test_heights_are_drawn_once_a_talker():
    height = drawn(SocialForceWalk(), runs=400, duration=0.1).position[..., 2]
    assert torch.equal(height[0], height[-1])
    assert float(height.mean()) == pytest.approx(1.6, abs=0.015)
    assert float(height[0].std()) == pytest.approx(0.08, rel=0.12)
    assert (drawn(SocialForceWalk(height=1.2, height_std=0.0), duration=0.1).position[..., 2] == 1.2).all()


def test_first_places_are_anywhere():
    place = drawn(SocialForceWalk(), runs=400, duration=0.1, region=Region((0, 0, 0), (4.6, 3.6, 3))).position[0, :, 0]
    for axis, high in ((0, 4.3), (1, 3.3)):
        law = scipy.stats.uniform(0.3, high - 0.3)
        assert scipy.stats.kstest(place[:, axis].numpy(), law.cdf).pvalue > 0.01
