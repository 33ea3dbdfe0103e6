"""A switching model in the particle filter: cutting, batching, losing, learning on and off."""

import copy
import math

import pytest
import torch
from switching_parts import Heard, Measured

from probtrack.dynamics import CoordinateUncoupled, DrivenAcceleration, TimeCorrelated, WithHeading, lehmann2007
from probtrack.errors import InputError, ShapeError
from probtrack.filters import Adaptive, Belief, ParticleFilter, resampling
from probtrack.filters.noise import FrameNoise
from probtrack.likelihoods import GaussianPosition
from probtrack.switching import MarkovChain, SwitchingDynamics

DT, STD, POINT = 0.1, 0.25, (1.3, -0.7)
SPEECH, SILENCE = [[0.8, 0.2], [0.3, 0.7]], [[0.1, 0.9], [0.25, 0.75]]


class Gated(Measured):
    """Position within a gate: a frame that is far away is impossible."""

    def forward(self, observation, kinematics):
        away = observation.position.abs().amax(-1) > 50
        return super().forward(observation, kinematics).masked_fill(away, -math.inf)


def models():
    manoeuvre = CoordinateUncoupled(DrivenAcceleration(TimeCorrelated(2.0, 1.5)))
    return [WithHeading(lehmann2007("CL-RWVE-RAAC")), manoeuvre]


def switching_filter(size=60, *, explore=0.0, resample=None):
    chain = MarkovChain([0.6, 0.4], SPEECH, silence=SILENCE, dt=DT)
    model = SwitchingDynamics(models(), chain, explore=explore)
    return ParticleFilter(model, Gated(STD), num_particles=size, resample=resample)


def heard(frames, *batch):
    """Positions and speech of a noisy walk that starts near POINT."""
    way = torch.arange(1, frames + 1)[:, None] * DT * torch.tensor([0.5, -0.3]) + torch.tensor(POINT)
    walk = way.reshape(frames, *[1] * len(batch), 2) + STD * torch.randn(frames, *batch, 2)
    return Heard(walk, torch.rand(frames, *batch))


def started(particle_filter, seeds=0):
    noise = particle_filter.noise(seeds)
    return particle_filter.spread_around(torch.tensor(POINT).expand(*noise.batch, 2), noise, std=0.3), noise


def run(particle_filter, observations, seeds=0):
    belief, noise = started(particle_filter, seeds)
    return particle_filter(observations, belief, DT, noise)


def part(observations, index):
    return Heard(*(x[index] for x in observations))


def assert_same(one, other, tol=1e-10):
    for name in ("position", "std", "heading", "ess", "log_evidence", "mode"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=tol, atol=tol)


# cutting and batching


@pytest.mark.parametrize("explore", [0.0, 0.3])
@torch.no_grad()
def test_numbers_do_not_depend_on_how_a_sequence_is_cut(explore):
    particle_filter, seen = switching_filter(explore=explore), heard(50)
    belief, noise = started(particle_filter)
    whole, track = particle_filter.advance(belief, seen, DT, noise)
    belief, noise = started(particle_filter)
    modes = []
    for block in zip(*(x.split([7, 1, 30, 2, 10]) for x in seen), strict=True):
        belief, piece = particle_filter.advance(belief, Heard(*block), DT, noise)
        modes.append(piece.mode)
    assert torch.equal(belief.state, whole.state)
    assert torch.equal(belief.log_weight, whole.log_weight)
    torch.testing.assert_close(torch.cat(modes), track.mode)


@torch.no_grad()
def test_numbers_are_the_same_frame_by_frame():
    particle_filter, seen = switching_filter(), heard(20)
    belief, noise = started(particle_filter)
    whole = particle_filter.advance(belief, seen, DT, noise)[0]
    belief, noise = started(particle_filter)
    for frame in zip(*seen, strict=True):
        belief, _ = particle_filter.step(belief, Heard(*frame), DT, noise)
    assert torch.equal(belief.state, whole.state)


@torch.no_grad()
def test_numbers_do_not_depend_on_how_many_frames_are_summed_at_once(monkeypatch):
    particle_filter, seen, seeds = switching_filter(), heard(30, 2), torch.tensor([3, 8])
    whole = run(particle_filter, seen, seeds)
    monkeypatch.setattr("probtrack.filters.particle._CHUNK", 7 * 120)
    assert_same(run(particle_filter, seen, seeds), whole)


@pytest.mark.parametrize("explore", [0.0, 0.3])
@torch.no_grad()
def test_a_batch_of_recordings_is_each_recording_alone(explore):
    particle_filter, seen = switching_filter(explore=explore), heard(25, 3)
    together = run(particle_filter, seen, torch.tensor([5, 17, 2]))
    assert together.mode.shape == (25, 3, 2)
    for i, seed in enumerate([5, 17, 2]):
        alone = run(particle_filter, part(seen, (slice(None), i)), seed)
        assert_same(type(together)(*(x if x is None or x.ndim < 2 else x[:, i] for x in together)), alone)


@torch.no_grad()
def test_recordings_and_what_is_heard_in_them_are_shared_by_runs():
    particle_filter, seen = switching_filter(), heard(12, 3, 1)
    seeds = torch.arange(6).reshape(3, 2) + 40
    together = run(particle_filter, seen, seeds)
    assert together.mode.shape == (12, 3, 2, 2)
    for r in range(3):
        for k in range(2):
            alone = run(particle_filter, part(seen, (slice(None), r, 0)), int(seeds[r, k]))
            torch.testing.assert_close(together.mode[:, r, k], alone.mode, rtol=1e-10, atol=1e-10)
            torch.testing.assert_close(together.position[:, r, k], alone.position, rtol=1e-10, atol=1e-10)


@torch.no_grad()
def test_one_sequence_of_speech_serves_all_runs():
    particle_filter, seen = switching_filter(), heard(12, 1)
    seeds = torch.tensor([4, 9, 1])
    bare = run(particle_filter, Heard(seen.position, seen.speech[:, 0]), seeds)
    assert_same(bare, run(particle_filter, seen, seeds))


class Replayed:
    """Noise of another filter, with numbers for its modes beside it."""

    def __init__(self, noise, extra):
        self.noise, self.extra, self.batch = noise, extra, noise.batch

    def frame(self):
        frame = self.noise.frame()
        return FrameNoise(torch.cat([frame.normal, self.extra], -1), frame.uniform)


@pytest.mark.parametrize("name", ["CU-LAN", "CL-TCVE-TCAC"])
@torch.no_grad()
def test_one_mode_is_the_plain_filter(name):
    seen, model = heard(30, 2), lehmann2007(name)
    plain = ParticleFilter(model, Gated(STD), num_particles=50)
    one = ParticleFilter(SwitchingDynamics([model], MarkovChain([1.0], [[1.0]])), Gated(STD), num_particles=50)
    belief, noise = started(plain, torch.tensor([1, 2]))
    track = plain(seen, belief, DT, noise)
    belief, noise = started(plain, torch.tensor([1, 2]))
    start = torch.cat([belief.state, torch.ones(2, 50, 1)], -1)
    switched = one(seen, belief._replace(state=start), DT, Replayed(noise, torch.randn(2, 50, 1)))
    for field in ("position", "std", "heading", "ess", "log_evidence"):
        torch.testing.assert_close(getattr(switched, field), getattr(track, field), rtol=1e-12, atol=1e-12)
    assert track.mode is None
    torch.testing.assert_close(switched.mode, torch.ones(30, 2, 1))


# the modes in the track


@torch.no_grad()
def test_modes_of_the_track_are_weighted_shares_of_the_cloud():
    never = Adaptive(resampling.systematic, 0)
    particle_filter, seen = switching_filter(resample=never), heard(4, 2)
    belief, noise = started(particle_filter, torch.tensor([1, 2]))
    last, track = particle_filter.advance(belief, seen, DT, noise)
    share = (last.log_weight.exp() * (last.state[..., -1] == 1)).sum(-1)
    torch.testing.assert_close(track.mode[-1, :, 1], share)
    torch.testing.assert_close(track.mode.sum(-1), torch.ones(4, 2))
    assert ((share > 0) & (share < 1)).all()


# lost frames


@pytest.mark.parametrize("seeds", [3, [3, 4]])
@pytest.mark.parametrize("explore", [0.0, 0.5])
@torch.no_grad()
def test_a_lost_frame_keeps_the_predicted_cloud(explore, seeds):
    never = Adaptive(resampling.systematic, 0)
    particle_filter = switching_filter(resample=never, explore=explore)
    belief, noise = started(particle_filter, torch.tensor(seeds))
    seen = heard(3, *noise.batch)
    seen.position[1] = 1e3
    first, _ = particle_filter.step(belief, part(seen, 0), DT, noise)
    kept, track = particle_filter.step(first, part(seen, 1), DT, noise)
    _, other = started(particle_filter, torch.tensor(seeds))
    other.frame()
    *_, move = particle_filter.dynamics.moves(part(seen, slice(2)), DT)
    state, correction = move(first.state, other.frame().normal)
    assert track.lost.all()
    assert (track.log_evidence == 0).all()
    assert torch.equal(kept.state, state)
    predicted = first.log_weight + (0 if correction is None else correction)
    torch.testing.assert_close(kept.log_weight, predicted.log_softmax(-1))
    assert not particle_filter.step(kept, part(seen, 2), DT, noise)[1].lost.any()


@torch.no_grad()
def test_frames_without_possible_particles_leave_the_modes_to_the_chain():
    """Exploring draws modes evenly: without its weights a lost frame would believe in that."""
    chain = MarkovChain([0.9, 0.1], [[0.95, 0.05], [0.6, 0.4]], dt=DT)
    model = SwitchingDynamics(models(), chain, explore=0.8)
    particle_filter = ParticleFilter(model, Gated(STD), num_particles=20_000)
    track = run(particle_filter, Heard(torch.full((3, 2), 1e3), torch.ones(3)))
    assert track.lost.all()
    law = torch.tensor([0.9, 0.1])
    for mode, ess in zip(track.mode, track.ess, strict=True):
        assert abs(mode[1] - law[1]) < 5 * (law[0] * law[1] / ess) ** 0.5
        law = law @ torch.tensor([[0.95, 0.05], [0.6, 0.4]])


def test_gradients_survive_a_lost_frame():
    never = Adaptive(resampling.systematic, 0)
    particle_filter, seen = switching_filter(resample=never, explore=0.2), heard(8)
    seen.position[3] = 1e3
    track = run(particle_filter, seen)
    (track.log_evidence.sum() + track.position.sum()).backward()
    assert track.lost.sum() == 1
    for parameter in particle_filter.parameters():
        assert parameter.grad.isfinite().all()
    for parameter in particle_filter.dynamics.chain.parameters():
        assert (parameter.grad != 0).all()


# learning on and off, types, mistakes


@pytest.mark.parametrize("name", ["systematic", "multinomial"])
def test_gradients_reach_chain_and_models_through_resampling(name):
    always = Adaptive(getattr(resampling, name), 1)
    particle_filter = switching_filter(200, resample=always)
    run(particle_filter, heard(10)).log_evidence.sum().backward()
    for key, parameter in particle_filter.named_parameters():
        assert parameter.grad.isfinite().all(), key
        # the heading plays no part in the evidence
        assert "turning.process" in key or (parameter.grad != 0).any(), key


@pytest.mark.parametrize("explore", [0.0, 0.3])
def test_inference_mode_gives_the_same_numbers(explore):
    particle_filter, seen = switching_filter(explore=explore), heard(10)
    with torch.inference_mode():
        plain = run(particle_filter, seen)
    assert_same(plain, run(particle_filter, seen), tol=1e-12)


def test_a_copy_and_a_reloaded_filter_give_the_same_numbers():
    particle_filter, seen = switching_filter(), heard(10)
    with torch.no_grad():
        for parameter in particle_filter.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    track, reloaded = run(particle_filter, seen), switching_filter()
    reloaded.load_state_dict(particle_filter.state_dict())
    for other in (copy.deepcopy(particle_filter), reloaded):
        assert torch.equal(run(other, seen).log_evidence, track.log_evidence)


def test_float32():
    torch.set_default_dtype(torch.float32)
    track = run(switching_filter(explore=0.2), heard(10))
    assert all(x.dtype == torch.float32 for x in track if x is not None and x.dtype != torch.bool)
    assert all(x.isfinite().all() for x in track if x is not None)
    torch.testing.assert_close(track.mode.sum(-1), torch.ones(10))


def test_rejects_observations_without_speech():
    model = switching_filter().dynamics
    with pytest.raises(InputError, match="observations must have `speech` for a chain that listens to it"):
        run(ParticleFilter(model, GaussianPosition(STD), num_particles=20), torch.zeros(3, 2))


def test_rejects_less_speech_than_frames():
    seen = heard(5)
    with pytest.raises(ShapeError, match="must have as many frames as the observations"):
        run(switching_filter(), Heard(seen.position, seen.speech[:3]))


def test_rejects_a_belief_of_another_size():
    particle_filter = switching_filter()
    belief, noise = started(particle_filter)
    short = Belief(belief.state[..., :-1], *belief[1:])
    with pytest.raises(ShapeError, match=r"state must have shape \(\.\.\., 60, 8\), got \(60, 7\)"):
        particle_filter(heard(3), short, DT, noise)
