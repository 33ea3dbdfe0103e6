"""Bootstrap filter: against the Kalman filter, then the laws of cutting, batching, permuting and losing."""

import math
from typing import NamedTuple

import pytest
import torch
from torch import nn
from torch.distributions import Independent, Normal

from probtrack.dynamics import Dynamics, Kinematics, lehmann2007
from probtrack.errors import InputError, NotFiniteError, ShapeError
from probtrack.filters import Adaptive, Belief, Gaussian, ParticleFilter, kalman_filter, position_system, resampling
from probtrack.geometry import Region
from probtrack.likelihoods import GaussianPosition, Likelihood

DT, STD, POINT = 0.1, 0.25, (1.3, -0.7)
SPREAD, SPEED = 0.35, 0.5
SCHEMES = ["systematic", "stratified", "multinomial", "residual"]


def scheme(name, threshold=0.75):
    return Adaptive(getattr(resampling, name), threshold)


def langevin_filter(num_particles=60, *, axes=2, likelihood=None, resample=None, origin=None):
    likelihood = GaussianPosition(STD) if likelihood is None else likelihood
    model = lehmann2007("CU-LAN", axes)
    return ParticleFilter(model, likelihood, num_particles=num_particles, resample=resample, origin=origin)


def walk(frames, *batch, axes=2):
    """Positions (frames, *batch, axes) of a noisy walk that starts near POINT."""
    way = torch.arange(1, frames + 1)[:, None] * DT * torch.tensor([0.5, -0.3, 0.2][:axes])
    start = torch.tensor([*POINT, 1.6][:axes])
    return (start + way).reshape(frames, *[1] * len(batch), axes) + STD * torch.randn(frames, *batch, axes)


def started(particle_filter, seeds=0, axes=2):
    noise = particle_filter.noise(seeds)
    point = torch.tensor([*POINT, 1.6][:axes]).expand(*noise.batch, axes)
    return particle_filter.spread_around(point, noise, std=SPREAD, speed=SPEED), noise


def run(particle_filter, y, seeds=0):
    axes = y.shape[-1]
    belief, noise = started(particle_filter, seeds, axes)
    return particle_filter(y, belief, DT, noise)


def exact(y):
    """Kalman filter of CU-LAN from the law that `started` draws."""
    axes = y.shape[-1]
    model = lehmann2007("CU-LAN", axes)
    mean = torch.tensor([*POINT, 1.6][:axes] + [0.0] * axes)
    variance = torch.tensor([SPREAD**2] * axes + [SPEED**2] * axes)
    with torch.no_grad():
        return kalman_filter(y, position_system(model, DT, STD), Gaussian(mean, variance.diag()))


def assert_mean(samples, wanted, z=5.0, rel_bias=0.0):
    """The mean over the runs, axis 1 of `samples`, is `wanted` within z standard errors."""
    error, std_error = samples.mean(1) - wanted, samples.std(1) / samples.shape[1] ** 0.5
    assert (error.abs() <= z * std_error + rel_bias * wanted.abs() + 1e-12).all(), error / std_error


def assert_same_track(one, other, **tolerance):
    for name, a, b in zip(one._fields, one, other, strict=True):
        if a is not None:
            torch.testing.assert_close(a, b, **tolerance, msg=lambda m, name=name: f"{name}: {m}")


# the exact answer


@pytest.mark.parametrize("name", SCHEMES)
@pytest.mark.parametrize("axes", [2, 3])
@torch.no_grad()
def test_mean_and_spread_are_those_of_the_kalman_filter(name, axes):
    y, runs, size = walk(9, axes=axes), 50, 800
    track = run(langevin_filter(size, axes=axes, resample=scheme(name)), y[:, None], torch.arange(runs))
    law = exact(y).filtered
    assert_mean(track.position, law.mean[:, :axes])
    variance = law.covariance.diagonal(dim1=-2, dim2=-1)[:, :axes]
    # the variance about the cloud's own mean is short by that of the mean, up to a few times 1 / N
    assert_mean(track.std.square(), variance, rel_bias=8 / size)


@pytest.mark.parametrize("name", SCHEMES)
@torch.no_grad()
def test_evidence_is_unbiased(name):
    y, runs = walk(8), 600
    track = run(langevin_filter(400, resample=scheme(name)), y[:, None], torch.arange(runs))
    ratio = (track.log_evidence.sum(0) - exact(y).log_evidence).exp()
    assert_mean(ratio[None], torch.ones(1))
    assert ratio.std() < 0.8  # or the standard error above would say nothing


@torch.no_grad()
def test_evidence_of_every_frame_is_the_kalman_filters():
    y, runs, size = walk(9), 50, 2000
    track = run(langevin_filter(size), y[:, None], torch.arange(runs))
    # the logarithm of a mean of N draws is short by half its relative variance, measured over the runs
    short = track.log_evidence.var(1) / 2
    error = track.log_evidence.mean(1) + short - exact(y).increments
    assert (error.abs() < 5 * track.log_evidence.std(1) / runs**0.5 + 1 / size).all()


@torch.no_grad()
def test_error_of_the_mean_falls_with_the_root_of_the_particles():
    y, runs = walk(6), 200
    spread = [run(langevin_filter(n), y[:, None], torch.arange(runs)).position[-1].std(0).mean() for n in (50, 800)]
    assert spread[0] / spread[1] == pytest.approx(4, rel=0.25)  # 200 runs know each to 5 %, and 50 is not infinity


@torch.no_grad()
def test_heading_is_the_direction_of_the_mean_velocity():
    particle_filter, y = langevin_filter(3000), walk(30)
    track = run(particle_filter, y)
    velocity = exact(y).filtered.mean[:, 2:]
    angle = torch.atan2(velocity[:, 1], velocity[:, 0])
    assert (track.heading - angle)[10:].abs().max() < 0.15  # speed 0.6 m/s known to 0.3 / sqrt(3000 / 8)


# cutting and batching


@torch.no_grad()
def test_whole_sequence_is_the_same_frame_by_frame_and_in_blocks():
    particle_filter, y = langevin_filter(40, origin=torch.tensor([0.2, 0.3])), walk(150)
    whole = run(particle_filter, y)
    for sizes in [[1] * 150, [7, 1, 64, 2, 76], [149, 1]]:
        (belief, noise), pieces, evidence = started(particle_filter), [], 0.0
        for block in y.split(sizes):
            belief, track = particle_filter.advance(belief, block, DT, noise)
            pieces.append(track)
            evidence = evidence + track.log_evidence.sum(0)
        for name in ("position", "std", "heading", "ess", "log_evidence", "lost", "azimuth", "std_azimuth"):
            joined = torch.cat([getattr(piece, name) for piece in pieces])
            # the clouds are the same bit for bit; sums over particles are taken for several frames at once
            torch.testing.assert_close(joined, getattr(whole, name), rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(belief.log_evidence, whole.log_evidence.sum(0))
        assert torch.equal(pieces[0].time, DT * torch.arange(sizes[0], dtype=torch.float64))


@torch.no_grad()
def test_cloud_does_not_depend_on_how_a_sequence_is_cut():
    particle_filter, y = langevin_filter(40), walk(90)
    one, noise = started(particle_filter)
    other, other_noise = started(particle_filter)
    one, _ = particle_filter.advance(one, y, DT, noise)
    for frame in y:
        other, _ = particle_filter.step(other, frame, DT, other_noise)
    assert torch.equal(one.state, other.state)
    assert torch.equal(one.log_weight, other.log_weight)


@torch.no_grad()
def test_summaries_do_not_depend_on_how_many_frames_are_summed_at_once(monkeypatch):
    y = walk(40, 1)
    whole = run(langevin_filter(60), y, torch.tensor([1, 2, 3]))
    monkeypatch.setattr("probtrack.filters.particle._CHUNK", 7 * 180)
    assert_same_track(whole, run(langevin_filter(60), y, torch.tensor([1, 2, 3])), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", SCHEMES)
@torch.no_grad()
def test_a_batch_of_runs_is_each_run_alone(name):
    particle_filter, y = langevin_filter(50, resample=scheme(name)), walk(30)
    seeds = torch.tensor([5, 17, 2])
    together = run(particle_filter, y[:, None], seeds)
    for i, seed in enumerate(seeds.tolist()):
        alone = run(particle_filter, y, seed)
        torch.testing.assert_close(together.position[:, i], alone.position, rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(together.ess[:, i], alone.ess, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(together.log_evidence[:, i], alone.log_evidence, rtol=1e-9, atol=1e-9)


@torch.no_grad()
def test_recordings_times_runs_are_each_recording_and_run_alone():
    particle_filter, y = langevin_filter(50), walk(12, 3)
    seeds = torch.arange(6).reshape(3, 2) + 40
    together = run(particle_filter, y[:, :, None], seeds)
    assert together.position.shape == (12, 3, 2, 2)
    assert together.lost.shape == together.ess.shape == together.log_evidence.shape == (12, 3, 2)
    for r in range(3):
        for k in range(2):
            alone = run(particle_filter, y[:, r], int(seeds[r, k]))
            torch.testing.assert_close(together.position[:, r, k], alone.position, rtol=1e-10, atol=1e-10)
            torch.testing.assert_close(together.std[:, r, k], alone.std, rtol=1e-8, atol=1e-10)


@torch.no_grad()
def test_order_of_the_particles_plays_no_part():
    never = Adaptive(resampling.systematic, 0)
    particle_filter, y, order = langevin_filter(50, resample=never, origin=torch.tensor([0.2, 0.3])), walk(10), None
    belief, noise = started(particle_filter)
    order, drawn = torch.randperm(50), [noise.frame() for _ in range(10)]

    class Permuted:
        batch = ()

        def __init__(self, order):
            self.left = [frame._replace(normal=frame.normal[order]) for frame in drawn]

        def frame(self):
            return self.left.pop(0)

    one = particle_filter(y, belief, DT, Permuted(torch.arange(50)))
    shuffled = Belief(belief.state[order], belief.log_weight[order], belief.log_evidence)
    assert_same_track(one, particle_filter(y, shuffled, DT, Permuted(order)), rtol=1e-9, atol=1e-9)


# whole clouds


@pytest.mark.parametrize("batch", [(), (3,), (3, 2)])
def test_run_gives_the_clouds_whose_means_are_the_track(batch):
    particle_filter, y, count = langevin_filter(40), walk(25), math.prod(batch)
    seeds = torch.arange(count).reshape(batch) + 4
    y = y.reshape(25, *[1] * len(batch), 2)
    belief, noise = started(particle_filter, seeds)
    with torch.no_grad():
        last, track = particle_filter.advance(belief, y, DT, noise)
    belief, noise = started(particle_filter, seeds)
    after, cloud = particle_filter.run(belief, y, DT, noise)
    assert cloud.state.shape == (25, *batch, 40, 4)
    assert cloud.log_weight.shape == (25, *batch, 40)
    assert cloud.log_proposal is None
    torch.testing.assert_close(after.state, last.state)
    torch.testing.assert_close(after.log_weight, last.log_weight)
    torch.testing.assert_close(after.log_evidence, last.log_evidence)
    torch.testing.assert_close(cloud.log_evidence, track.log_evidence)
    torch.testing.assert_close(cloud.log_weight.exp().sum(-1), torch.ones(25, *batch))
    mean = (cloud.log_weight.exp()[..., None] * cloud.state[..., :2]).sum(-2)
    torch.testing.assert_close(mean, track.position)
    assert not cloud.lost.any()


def test_run_adds_to_the_evidence_of_the_belief_and_goes_on_from_it():
    particle_filter, y = langevin_filter(40), walk(12)
    belief, noise = started(particle_filter)
    whole = particle_filter.run(belief, y, DT, noise)
    belief, noise = started(particle_filter)
    first, one = particle_filter.run(belief, y[:5], DT, noise)
    last, other = particle_filter.run(first, y[5:], DT, noise)
    torch.testing.assert_close(torch.cat([one.state, other.state]), whole[1].state)
    torch.testing.assert_close(torch.cat([one.log_evidence, other.log_evidence]), whole[1].log_evidence)
    torch.testing.assert_close(last.log_evidence, whole[0].log_evidence)


def test_evidence_of_clouds_has_the_gradient_of_finite_differences():
    # resampling never, so that the evidence is a smooth function of the parameters
    particle_filter = langevin_filter(15, resample=Adaptive(resampling.systematic, 0))
    y, step = walk(6), 1e-6

    def evidence():
        belief, noise = started(particle_filter)
        return particle_filter.run(belief, y, DT, noise)[1].log_evidence

    weight = torch.randn(6)
    (evidence() * weight).sum().backward()
    for name, parameter in particle_filter.named_parameters():
        values = []
        for sign in (1, -1):
            with torch.no_grad():
                parameter.add_(sign * step)
                values.append((evidence() * weight).sum())
                parameter.add_(-sign * step)
        exact = (values[0] - values[1]) / (2 * step)
        torch.testing.assert_close(parameter.grad, exact, rtol=1e-6, atol=1e-8, msg=name)


# time steps


@pytest.mark.parametrize("shape", [(), (7,), (7, 3)])
def test_equal_time_steps_of_each_frame_are_one_number(shape):
    particle_filter, y, seeds = langevin_filter(30), walk(7, 1), torch.arange(3)
    exact = run(particle_filter, y, seeds)
    belief, noise = started(particle_filter, seeds)
    assert_same_track(particle_filter(y, belief, torch.full(shape, DT), noise), exact)


def test_each_run_has_its_own_time_steps():
    particle_filter, y = langevin_filter(30), walk(7)
    dt = 0.05 + 0.2 * torch.rand(7, 3)
    belief, noise = started(particle_filter, torch.arange(3))
    together = particle_filter(y[:, None], belief, dt, noise)
    for i in range(3):
        belief, noise = started(particle_filter, i)
        alone = particle_filter(y, belief, dt[:, i], noise)
        torch.testing.assert_close(together.position[:, i], alone.position, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(together.log_evidence[:, i], alone.log_evidence, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(alone.time, dt[:, i].cumsum(0) - dt[0, i])
    torch.testing.assert_close(together.time, dt[:, 0].cumsum(0) - dt[0, 0])


@torch.no_grad()
def test_time_steps_that_differ_are_those_of_the_kalman_filter():
    y, runs, dt = walk(5), 60, torch.tensor([0.05, 0.4, 0.1, 0.9, 0.2])
    particle_filter = langevin_filter(800)
    belief, noise = started(particle_filter, torch.arange(runs))
    track = particle_filter(y[:, None], belief, dt, noise)
    law = Gaussian(torch.tensor([*POINT, 0.0, 0.0]), torch.tensor([SPREAD**2] * 2 + [SPEED**2] * 2).diag())
    for t, step in enumerate(dt.tolist()):  # one frame at a time, each with a system of its own
        result = kalman_filter(y[t : t + 1], position_system(lehmann2007("CU-LAN"), step, STD), law)
        law = Gaussian(result.filtered.mean[0], result.filtered.covariance[0])
        assert_mean(track.position[t][None], law.mean[:2])


@pytest.mark.parametrize(
    ("dt", "error", "match"),
    [
        (torch.full((4,), 0.1), ShapeError, r"dt must be one number or have shape \(3, \*\(2,\)\), got \(4,\)"),
        (torch.full((3, 5), 0.1), ShapeError, "dt must be one number or have shape"),
        (torch.tensor([0.1, 0.0, 0.1]), InputError, "dt must be positive seconds, got 0.0 into frame 1"),
        (torch.tensor([0.1, 0.1, math.nan]), InputError, "dt must be positive seconds, got nan into frame 2"),
    ],
)
def test_rejects_time_steps_that_cannot_be(dt, error, match):
    particle_filter = langevin_filter(5)
    belief, noise = started(particle_filter, torch.arange(2))
    with pytest.raises(error, match=match):
        particle_filter(walk(3, 1), belief, dt, noise)


# frames that say nothing, or that cannot be


class Flat(Likelihood):
    """Says nothing of the state."""

    def forward(self, observation, kinematics):
        return observation * torch.ones_like(kinematics.position[..., 0])


class Boxed(Likelihood):
    """The talker is within an observed distance of the origin, all places alike."""

    def forward(self, observation, kinematics):
        near = kinematics.position.norm(dim=-1) < observation
        return torch.zeros_like(kinematics.position[..., 0]).masked_fill(~near, -math.inf)


@torch.no_grad()
def test_frames_that_say_nothing_leave_the_prediction():
    particle_filter = langevin_filter(30, likelihood=Flat())
    belief, noise = started(particle_filter)
    last, track = particle_filter.advance(belief, torch.full((7,), -1.7), DT, noise)
    again, other = started(particle_filter)
    state, step = again.state, particle_filter.dynamics.transition(DT)
    for _ in range(7):
        state = step(state, other.frame().normal)
    assert torch.equal(last.state, state)
    torch.testing.assert_close(last.log_weight, belief.log_weight)
    torch.testing.assert_close(track.log_evidence, torch.full((7,), -1.7))
    torch.testing.assert_close(track.ess, torch.full((7,), 30.0))
    torch.testing.assert_close(track.position[-1], state[:, :2].mean(0))
    torch.testing.assert_close(track.std[-1], state[:, :2].std(0, correction=0))


@pytest.mark.parametrize("seeds", [3, [3, 4]])
@torch.no_grad()
def test_impossible_frame_keeps_the_predicted_cloud_and_its_weights(seeds):
    particle_filter = langevin_filter(30, likelihood=Boxed(), resample=Adaptive(resampling.systematic, 0.2))
    belief, noise = started(particle_filter, torch.tensor(seeds))
    radii = torch.tensor([1.6, 0.0, 9.0]).reshape(3, *[1] * belief.log_evidence.ndim, 1)
    first, _ = particle_filter.step(belief, radii[0], DT, noise)
    first = first._replace(log_weight=torch.randn(first.log_weight.shape).log_softmax(-1))
    kept, track = particle_filter.step(first, radii[1], DT, noise)
    assert track.lost.all()
    assert (track.log_evidence == 0).all()
    assert torch.equal(kept.log_weight, first.log_weight)
    assert torch.equal(kept.log_evidence, first.log_evidence)
    again, other = started(particle_filter, torch.tensor(seeds))
    step = particle_filter.dynamics.transition(DT)
    other.frame()
    assert torch.equal(kept.state, step(first.state, other.frame().normal))
    weight = first.log_weight.exp()[..., None]
    torch.testing.assert_close(track.position[0], (weight * kept.state[..., :2]).sum(-2))
    assert not particle_filter.step(kept, radii[2], DT, noise)[1].lost.any()
    assert not again.log_weight.isnan().any()


@pytest.mark.parametrize("impossible", [0, 1, 2])
@torch.no_grad()
def test_impossible_frame_of_one_run_leaves_the_others_untouched(impossible):
    particle_filter = langevin_filter(30, likelihood=Boxed())
    radii = torch.full((6, 3, 1), 1.6)
    clean = run_boxed(particle_filter, radii)
    radii[2, impossible] = 0
    track = run_boxed(particle_filter, radii)
    others = [i for i in range(3) if i != impossible]
    assert track.lost.nonzero().tolist() == [[2, impossible]]
    assert torch.equal(track.position[:, others], clean.position[:, others])
    assert torch.equal(track.log_evidence[:, others], clean.log_evidence[:, others])
    assert track.position.isfinite().all()


def run_boxed(particle_filter, radii):
    belief, noise = started(particle_filter, torch.tensor([7, 8, 9]))
    return particle_filter(radii, belief, DT, noise)


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("particle", [0, 11, 29])
@pytest.mark.parametrize("batch", [(), (3,)])
def test_likelihood_that_is_no_number_is_an_error(value, particle, batch):
    particle_filter = langevin_filter(30, likelihood=Flat())
    y = torch.zeros(4, *batch, 30)
    y[(3, *[1] * len(batch), particle)] = value
    belief, noise = started(particle_filter, torch.zeros(batch, dtype=torch.long))
    with pytest.raises(NotFiniteError, match="likelihood is NaN or infinite"):
        particle_filter(y, belief, DT, noise)


def test_nan_beside_an_impossible_run_is_an_error():
    particle_filter = langevin_filter(30, likelihood=Flat())
    y = torch.zeros(1, 2, 30)
    y[0, 0], y[0, 1, 3] = -math.inf, math.nan
    belief, noise = started(particle_filter, torch.tensor([1, 2]))
    with pytest.raises(NotFiniteError):
        particle_filter(y, belief, DT, noise)


# directions


class Still(Dynamics):
    """State (x, y, heading): nothing moves, and where it looks is part of it."""

    state_dim, noise_dim = 3, 1

    def forward(self, state, dt):
        raise NotImplementedError

    def transition(self, dt):  # noqa: ARG002
        return lambda state, noise: state + 0 * noise

    def kinematics(self, state):
        return Kinematics(state[..., :2], torch.ones_like(state[..., :2]), state[..., 2])

    def from_kinematics(self, kinematics):
        return torch.cat([kinematics.position, kinematics.heading[..., None]], -1)


def still_track(state, log_weight=None, origin=None):
    """Track of one frame of a cloud (N, 3) that says nothing and stays where it is."""
    size = len(state)
    particle_filter = ParticleFilter(Still(), Flat(), num_particles=size, origin=origin)
    log_weight = torch.zeros(size) if log_weight is None else log_weight
    belief = Belief(state, log_weight.log_softmax(-1), torch.zeros(()))
    return particle_filter(torch.zeros(1), belief, DT, particle_filter.noise())


def around(origin, angle, radius=1.0):
    """Particles (N, 3) at `angle` (N,) seen from `origin`, that look the same way."""
    place = origin + radius * torch.stack([angle.cos(), angle.sin()], -1)
    return torch.cat([place, angle[:, None]], -1)


def test_azimuth_is_the_weighted_mean_direction_from_the_origin():
    origin, angle = torch.tensor([2.3, -1.1]), torch.tensor([0.3, 0.9, -0.4])
    weight, radius = torch.tensor([0.5, 0.2, 0.3]), torch.tensor([[1.0], [4.0], [0.3]])
    track = still_track(around(origin, angle, radius), weight.log(), origin)
    mean = (weight * torch.polar(torch.ones(3), angle)).sum()
    torch.testing.assert_close(track.azimuth[0], mean.angle())
    torch.testing.assert_close(track.std_azimuth[0], (-2 * mean.abs().log()).sqrt())
    torch.testing.assert_close(track.heading[0], mean.angle())


def test_height_of_the_origin_plays_no_part():
    flat, tall = torch.tensor([2.3, -1.1]), torch.tensor([2.3, -1.1, 7.0])
    state = around(flat, torch.randn(40))
    one, other = still_track(state, origin=flat), still_track(state, origin=tall)
    assert torch.equal(one.azimuth, other.azimuth)


@pytest.mark.parametrize("centre", [math.pi, -math.pi, 0.0, 2.5])
@pytest.mark.parametrize("spread", [0.02, 0.3, 1.0])
def test_circular_spread_is_that_of_wrapped_normal_angles_wherever_they_wrap(centre, spread):
    origin, quantiles = torch.tensor([2.3, -1.1]), (torch.arange(20_000) + 0.5) / 20_000
    angle = centre + spread * Normal(0.0, 1.0).icdf(quantiles)
    track = still_track(around(origin, angle), origin=origin)
    difference = track.azimuth[0] - centre
    assert torch.atan2(difference.sin(), difference.cos()).abs() < 1e-9
    torch.testing.assert_close(track.std_azimuth[0], torch.tensor(spread), rtol=1e-3, atol=0)


def test_circular_spread_of_a_full_circle_is_at_most_pi():
    angle = torch.arange(12) * math.pi / 6
    assert still_track(around(torch.zeros(2), angle), origin=torch.zeros(2)).std_azimuth[0] == math.pi


def test_circular_spread_of_one_direction_is_zero():
    state = around(torch.tensor([2.3, -1.1]), torch.full((9,), 2.1))
    assert still_track(state, origin=torch.tensor([2.3, -1.1])).std_azimuth[0] < 1e-7  # root of an epsilon


def test_particle_at_the_origin_has_no_direction_and_hurts_nobody():
    origin = torch.tensor([2.3, -1.1])
    state = around(origin, torch.tensor([0.4, 0.4, 0.4]))
    state[0, :2] = origin
    torch.testing.assert_close(still_track(state, origin=origin).azimuth[0], torch.tensor(0.4))


def test_modelled_heading_wraps_around():
    angle = torch.tensor([math.pi - 0.1, -math.pi + 0.3])
    assert still_track(around(torch.zeros(2), angle)).heading[0] == pytest.approx(-math.pi + 0.1)


def test_no_azimuth_without_an_origin():
    track = still_track(around(torch.zeros(2), torch.randn(5)))
    assert track.azimuth is None
    assert track.std_azimuth is None
    assert track.speech is None


# models of one's own


class RandomWalk(Dynamics):
    """The position alone, with a learnable step."""

    state_dim = noise_dim = 2

    def __init__(self, scale=0.7):
        super().__init__()
        self.log_scale = nn.Parameter(torch.tensor(scale).log())

    def forward(self, state, dt):
        return Independent(Normal(state, self.log_scale.exp() * dt**0.5), 1)

    def kinematics(self, state):
        return Kinematics(state, torch.zeros_like(state))

    def from_kinematics(self, kinematics):
        return kinematics.position


class RangeAndSide(NamedTuple):
    distance: torch.Tensor
    side: torch.Tensor


class RangeLikelihood(Likelihood):
    """Distance from a beacon, and whether the talker is right of it; observed as a NamedTuple."""

    def __init__(self):
        super().__init__()
        self.log_std = nn.Parameter(torch.tensor(-1.5))

    def forward(self, observation, kinematics):
        offset = kinematics.position - torch.tensor([-0.5, 0.2])
        distance = Normal(offset.norm(dim=-1), self.log_std.exp()).log_prob(observation.distance[..., None])
        return distance.masked_fill((offset[..., 0] > 0) != observation.side[..., None], -math.inf)


@torch.no_grad()
def test_a_random_walk_of_ones_own_is_the_kalman_filters():
    y, runs, model = walk(8), 60, RandomWalk()
    track = run(ParticleFilter(model, GaussianPosition(STD), num_particles=500), y[:, None], torch.arange(runs))
    variance, mean = torch.tensor(SPREAD**2), torch.tensor(POINT)
    for t, position in enumerate(track.position):
        variance = variance + 0.7**2 * DT
        gain = variance / (variance + STD**2)
        mean, variance = mean + gain * (y[t] - mean), (1 - gain) * variance
        assert_mean(position[None], mean)


@torch.no_grad()
def test_observations_of_a_tuple_weight_each_particle_frame_by_frame():
    never = Adaptive(resampling.systematic, 0)
    particle_filter = ParticleFilter(RandomWalk(), RangeLikelihood(), num_particles=40, resample=never)
    belief, noise = started(particle_filter)
    expected, seen = belief.log_weight, RangeAndSide(torch.tensor([1.9, 2.3, 1.7]), torch.tensor([True, True, True]))
    for distance in seen.distance:
        belief, _ = particle_filter.step(belief, RangeAndSide(distance, seen.side[0]), DT, noise)
        offset = belief.state - torch.tensor([-0.5, 0.2])
        density = (-0.5 * ((offset.norm(dim=-1) - distance) / math.exp(-1.5)).square()).exp() * (offset[:, 0] > 0)
        expected = (expected.exp() * density / (expected.exp() * density).sum()).log()
    torch.testing.assert_close(belief.log_weight, expected)
    start, noise = started(particle_filter)
    whole, track = particle_filter.advance(start, seen, DT, noise)
    torch.testing.assert_close(whole.log_weight, expected)
    torch.testing.assert_close(track.position[-1], (expected.exp()[:, None] * whole.state).sum(0))


@pytest.mark.parametrize("name", SCHEMES)
def test_gradients_reach_both_models_and_climb_the_evidence(name):
    particle_filter = ParticleFilter(RandomWalk(), GaussianPosition(0.8), num_particles=60, resample=scheme(name))
    track = run(particle_filter, walk(15))
    track.log_evidence.sum().backward()
    for parameter in particle_filter.parameters():
        assert parameter.grad.isfinite().all()
        assert (parameter.grad != 0).all()
    assert particle_filter.likelihood.log_std.grad < 0  # the error is really 0.25


def test_gradient_without_resampling_is_the_finite_difference_of_the_evidence():
    particle_filter = langevin_filter(20, resample=Adaptive(resampling.systematic, 0))
    y = walk(6)
    run(particle_filter, y).log_evidence.sum().backward()
    for parameter in particle_filter.parameters():
        values = []
        for step in (1e-5, -1e-5):
            with torch.no_grad():
                parameter += step
                values.append(run(particle_filter, y).log_evidence.sum())
                parameter -= step
        torch.testing.assert_close(parameter.grad, (values[0] - values[1]) / 2e-5, rtol=1e-5, atol=1e-7)


def test_gradients_survive_a_lost_frame():
    class Gated(GaussianPosition):
        def forward(self, observation, kinematics):
            away = observation.position.abs().amax(-1) > 50
            return super().forward(observation, kinematics).masked_fill(away, -math.inf)

    never = Adaptive(resampling.systematic, 0)  # so that the weights before the lost frame carry gradients on
    particle_filter, y = langevin_filter(30, likelihood=Gated(STD), resample=never), walk(8)
    y[3] = 1e2
    track = run(particle_filter, y)
    (track.log_evidence.sum() + track.position.sum()).backward()
    assert track.lost.sum() == 1
    for parameter in particle_filter.parameters():
        assert parameter.grad.isfinite().all()
        assert (parameter.grad != 0).all()


# initial clouds, types and mistakes


@pytest.mark.parametrize("axes", [2, 3])
def test_first_cloud_is_uniform_over_the_region(axes):
    region = Region((-0.5, 1.0, 0.3)[:axes], (3.0, 2.2, 2.5)[:axes])
    particle_filter = langevin_filter(4000, axes=axes)
    belief = particle_filter.spread_over(region, particle_filter.noise(3), speed=0.8)
    position, velocity = belief.state[:, :axes], belief.state[:, axes:]
    assert region.contains(position).all()
    low, high = torch.tensor(region.low), torch.tensor(region.high)
    cell = ((position - low) / (high - low) * 5).long()
    counts = torch.bincount((cell * 5 ** torch.arange(axes)).sum(-1), minlength=5**axes)
    freedom = 5**axes - 1
    chi2 = ((counts - 4000 / 5**axes) ** 2 / (4000 / 5**axes)).sum()
    assert abs(chi2 - freedom) < 5 * (2 * freedom) ** 0.5
    assert velocity.square().mean().sqrt() == pytest.approx(0.8, rel=5 / (2 * 4000 * axes) ** 0.5)
    torch.testing.assert_close(belief.log_weight.exp(), torch.full((4000,), 1 / 4000))
    assert belief.log_evidence == 0


def test_first_clouds_lie_around_their_points():
    particle_filter, points = langevin_filter(4000), torch.tensor([[1.0, -2.0], [0.3, 5.0], [2.0, 2.0]])
    belief = particle_filter.spread_around(points, particle_filter.noise(torch.tensor([1, 2, 3])), std=0.3, speed=0.9)
    assert belief.state.shape == (3, 4000, 4)
    assert belief.log_evidence.shape == (3,)
    error = belief.state[..., :2].mean(1) - points
    assert (error.abs() < 5 * 0.3 / 4000**0.5).all()
    torch.testing.assert_close(belief.state.std(1)[:, :2], torch.full((3, 2), 0.3), rtol=0.06, atol=0)  # 5 / sqrt(8000)
    torch.testing.assert_close(belief.state.std(1)[:, 2:], torch.full((3, 2), 0.9), rtol=0.06, atol=0)


@torch.no_grad()
def test_float32_follows_float64_models_and_dtype():
    torch.set_default_dtype(torch.float32)
    track = run(langevin_filter(50, origin=torch.tensor([0.2, 0.3])), walk(10))
    assert all(x.dtype == torch.float32 for x in track if x is not None and x.dtype != torch.bool)


@torch.no_grad()
def test_one_particle_is_a_cloud_too():
    track = run(langevin_filter(1), walk(5))
    assert (track.std == 0).all()
    torch.testing.assert_close(track.ess, torch.ones(5))


@pytest.mark.parametrize("dt", [0.0, -0.1, math.nan, math.inf, "0.1", None])
def test_rejects_a_time_step_that_is_none(dt):
    particle_filter = langevin_filter(5)
    belief, noise = started(particle_filter)
    with pytest.raises(InputError, match="dt must be a positive number of seconds"):
        particle_filter(walk(3), belief, dt, noise)


def test_rejects_a_sequence_without_frames():
    particle_filter = langevin_filter(5)
    belief, noise = started(particle_filter)
    with pytest.raises(InputError, match="observations hold no frame"):
        particle_filter(walk(3)[:0], belief, DT, noise)


@pytest.mark.parametrize("shape", [(5, 3), (4, 4), (4,)])
def test_rejects_a_state_of_another_shape(shape):
    particle_filter = langevin_filter(5)
    belief, noise = started(particle_filter)
    with pytest.raises(ShapeError, match=r"state must have shape \(\.\.\., 5, 4\), got"):
        particle_filter(walk(3), belief._replace(state=torch.zeros(shape)), DT, noise)


def test_rejects_noise_of_another_batch():
    particle_filter = langevin_filter(5)
    belief, _ = started(particle_filter)
    with pytest.raises(ShapeError, match=r"noise must have the belief's batch \(\), its seeds have \(3,\)"):
        particle_filter(walk(3), belief, DT, particle_filter.noise(torch.arange(3)))


def test_rejects_weights_of_another_shape():
    particle_filter = langevin_filter(5)
    belief, noise = started(particle_filter)
    with pytest.raises(ShapeError, match=r"log_weight must have shape \(5,\), got \(1, 5\)"):
        particle_filter(walk(3), belief._replace(log_weight=belief.log_weight[None]), DT, noise)


@pytest.mark.parametrize("bad", [0, -3, 7.0, True])
def test_rejects_a_number_of_particles_that_is_none(bad):
    with pytest.raises(InputError, match="num_particles must be an integer of at least 1"):
        langevin_filter(bad)
