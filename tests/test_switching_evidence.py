"""Switching filter: evidence, modes and gradients against a sum over all paths of modes."""

import itertools
import math

import numpy as np
import pytest
import torch
from oracles.joint_gaussian import JointGaussian
from oracles.mode_paths import answers
from switching_parts import Heard, Measured

from probtrack.dynamics import CoordinateUncoupled, DrivenAcceleration, DrivenVelocity, Kinematics, TimeCorrelated
from probtrack.dynamics import single_noise as printed
from probtrack.filters import Adaptive, Belief, ParticleFilter, StopGradient, resampling
from probtrack.switching import MarkovChain, SwitchingDynamics

DT, STD = 0.3, 0.15
FIRST = [0.6, 0.4]
SPEECH, SILENCE = [[0.85, 0.15], [0.4, 0.6]], [[0.1, 0.9], [0.25, 0.75]]
ALPHA = [1.0, 0.2, 0.9, 0.1]
SEEN = [[0.5, 0.3], [0.6, 0.2], [0.7, 0.2], [1.3, 0.5]]  # two jumps: the modes can be told apart
VELOCITY, SPREAD, SPEED = [0.3, -0.2], 0.1, 0.5
NEVER = Adaptive(resampling.systematic, 0)
ALWAYS = Adaptive(resampling.systematic, 1)


def models():
    """A velocity by S1's single noise, and an acceleration: states of 4 and 6 numbers."""
    return [
        CoordinateUncoupled(DrivenVelocity(TimeCorrelated(1.0, 0.25), printed)),
        CoordinateUncoupled(DrivenAcceleration(TimeCorrelated(2.0, 8.0))),
    ]


def switching_filter(size, *, resample=NEVER, explore=0.0, chain=None):
    chain = MarkovChain(FIRST, SPEECH, silence=SILENCE, dt=DT) if chain is None else chain
    model = SwitchingDynamics(models(), chain, explore=explore)
    return ParticleFilter(model, Measured(STD), num_particles=size, resample=resample)


def observed(frames=4, *batch):
    place = [frames, *[1] * len(batch)]
    return Heard(torch.tensor(SEEN[:frames]).reshape(*place, 2), torch.tensor(ALPHA[:frames]).reshape(place))


def run(particle_filter, seeds, frames=4):
    noise, size = particle_filter.noise(seeds), particle_filter.num_particles
    position = SPREAD * noise.normal(size, 2)
    velocity = torch.tensor(VELOCITY) + SPEED * noise.normal(size, 2)
    state = particle_filter.dynamics.from_kinematics(Kinematics(position, velocity))
    log_weight = torch.full(state.shape[:-1], -math.log(size))
    belief = Belief(state, log_weight, torch.zeros(noise.batch))
    return particle_filter(observed(frames, *noise.batch), belief, DT, noise)


def kernels(chain):
    """Initial law and matrix into each frame, as numbers."""
    speech = chain.logit_transition.softmax(-1).numpy()
    silence = speech if chain.logit_silence is None else chain.logit_silence.softmax(-1).numpy()
    return chain.logit_initial.softmax(-1).numpy(), [a * speech + (1 - a) * silence for a in ALPHA]


@torch.no_grad()
def exact(particle_filter, frames=4):
    """Evidence, probabilities of the last mode and mean of the last position, by enumeration."""
    steps = [tuple(x.numpy() for x in model.matrices(DT)) for model in particle_filter.dynamics.models]
    up = np.eye(6, 4)  # position and velocity stay, acceleration is zero
    start = (np.array([0.0, 0.0, *VELOCITY]), np.diag([SPREAD**2] * 2 + [SPEED**2] * 2))
    R = math.exp(2 * particle_filter.likelihood.log_std.item()) * np.eye(2)
    initial, transitions = kernels(particle_filter.dynamics.chain)
    carry = [[np.eye(4), up], [up.T, np.eye(6)]]
    H = [np.eye(2, 4), np.eye(2, 6)]
    return answers(np.array(SEEN[:frames]), steps, carry, initial, transitions, start, H, R)


def exact_gradient(particle_filter, frames=4, step=1e-5):
    """Finite differences of the exact evidence by all parameters, one vector."""
    slopes = []
    for parameter in particle_filter.parameters():
        row = parameter.data.view(-1)
        for i in range(len(row)):
            before, ends = row[i].item(), []
            for side in (step, -step):
                row[i] = before + side
                ends.append(exact(particle_filter, frames)[0])
            row[i] = before
            slopes.append((ends[0] - ends[1]) / (2 * step))
    return torch.tensor(slopes)


def assert_mean(samples, wanted, z=5.0):
    """The mean over the runs, axis 0 of `samples`, is `wanted` within z standard errors."""
    error, std_error = samples.mean(0) - wanted, samples.std(0) / len(samples) ** 0.5
    assert (error.abs() <= z * std_error + 1e-9).all(), error / std_error


# the enumeration itself


def linear(*seed):
    """Matrices of a random linear system of two modes of one layout."""
    draw = np.random.default_rng(seed)
    steps = [(np.eye(3) + 0.3 * draw.normal(size=(3, 3)), draw.normal(size=(3, 2))) for _ in range(2)]
    H, start = draw.normal(size=(2, 3)), (draw.normal(size=3), np.diag([0.3, 1.2, 0.7]))
    return steps, H, start, draw.normal(size=(5, 2)), np.array([[0.4, 0.1], [0.1, 0.3]])


@pytest.mark.parametrize("path", [(0, 0, 0, 0, 0), (0, 1, 1, 0, 1), (1, 0, 0, 1, 1)])
def test_enumeration_of_one_possible_path_is_one_joint_gaussian(path):
    steps, H, start, y, R = linear(7)
    rows = [np.eye(2)[[s, s]] for s in path]
    evidence, modes, mean = answers(y, steps, [[np.eye(3)] * 2] * 2, np.eye(2)[path[0]], rows, start, [H, H], R)
    F, G = (np.stack([steps[s][i] for s in path]) for i in (0, 1))
    oracle = JointGaussian(F, G, H, R, *start)
    assert evidence == pytest.approx(oracle.log_evidence(y, [True] * 5), rel=1e-10)
    assert modes.tolist() == np.eye(2)[path[-1]].tolist()
    assert mean == pytest.approx(H @ oracle.given(y, range(5))[0][-1], rel=1e-9)


def test_enumeration_weighs_all_paths_by_their_probabilities():
    steps, H, start, y, R = linear(8)
    initial = np.array([0.3, 0.7])
    tables = [np.eye(2), np.array([[0.8, 0.2], [0.1, 0.9]]), np.array([[0.5, 0.5], [0.6, 0.4]])]  # no mode before
    total, last = 0.0, np.zeros(2)
    for path in itertools.product(range(2), repeat=3):
        prior = initial[path[0]] * tables[1][path[0], path[1]] * tables[2][path[1], path[2]]
        F, G = (np.stack([steps[s][i] for s in path]) for i in (0, 1))
        joint = prior * math.exp(JointGaussian(F, G, H, R, *start).log_evidence(y[:3], [True] * 3))
        total, last = total + joint, last + joint * np.eye(2)[path[2]]
    evidence, modes, _ = answers(y[:3], steps, [[np.eye(3)] * 2] * 2, initial, tables, start, [H, H], R)
    assert evidence == pytest.approx(math.log(total), rel=1e-10)
    assert modes == pytest.approx(last / total, rel=1e-9)


def test_enumeration_carries_states_between_layouts():
    """A mode whose third variable nobody can see, and that starts at zero, is the mode without it."""
    steps, H, start, y, R = linear(9)
    F, G = steps[0][0][:2, :2], steps[0][1][:2]
    hidden = np.block([[F, np.zeros((2, 1))], [np.ones((1, 3))]]), np.vstack([G, np.ones((1, 2))])
    up = np.eye(3, 2)
    rows, start = [np.array([[0.5, 0.5]] * 2)] * 5, (start[0][:2], start[1][:2, :2])
    see = [H[:, :2], np.hstack([H[:, :2], np.zeros((2, 1))])]
    evidence, modes, _ = answers(
        y, [(F, G), hidden], [[np.eye(2), up], [up.T, np.eye(3)]], rows[0][0], rows, start, see, R
    )
    alone = JointGaussian(np.stack([F] * 5), np.stack([G] * 5), H[:, :2], R, *start)
    assert evidence == pytest.approx(alone.log_evidence(y, [True] * 5), rel=1e-10)
    assert modes == pytest.approx([0.5, 0.5], rel=1e-9)


# evidence, modes and means


@pytest.mark.parametrize(
    ("resample", "size"), [(NEVER, 3000), (ALWAYS, 1000), (Adaptive(resampling.multinomial, 0.5), 1000)]
)
@pytest.mark.parametrize("explore", [0.0, 0.5])
@torch.no_grad()
def test_evidence_is_unbiased(resample, size, explore):
    particle_filter = switching_filter(size, resample=resample, explore=explore)
    evidence = run(particle_filter, torch.arange(40)).log_evidence.sum(0)
    ratio = (evidence - exact(particle_filter)[0]).exp()
    assert ratio.std() < 0.8  # or the standard error would say nothing
    assert_mean(ratio, 1.0)


@pytest.mark.parametrize("frames", [1, 2, 4])
@pytest.mark.parametrize("explore", [0.0, 0.5])
@torch.no_grad()
def test_modes_have_the_probabilities_of_the_enumeration(explore, frames):
    particle_filter = switching_filter(2000, resample=ALWAYS, explore=explore)
    track = run(particle_filter, torch.arange(40), frames)
    evidence, modes, mean = exact(particle_filter, frames)
    # a ratio of means: weighted by the evidence of the run, numerator and denominator are unbiased
    ratio = (track.log_evidence.sum(0) - evidence).exp()[:, None]
    assert_mean(ratio * (track.mode[-1] - torch.tensor(modes)), torch.zeros(2))
    assert_mean(ratio * (track.position[-1] - torch.tensor(mean)), torch.zeros(2))
    torch.testing.assert_close(track.mode.sum(-1), torch.ones(frames, 40))
    assert (track.mode[-1].std(0) < 0.1).all()


@torch.no_grad()
def test_speech_decides_which_modes_there_are():
    """The same observations heard the other way round have other modes, and the filter follows both."""
    chain = MarkovChain(FIRST, SILENCE, silence=SPEECH, dt=DT)
    swapped, given = switching_filter(2000, resample=ALWAYS, chain=chain), switching_filter(2000, resample=ALWAYS)
    modes = [torch.tensor(exact(f)[1]) for f in (swapped, given)]
    assert (modes[0] - modes[1]).abs().max() > 0.1
    for f, wanted in zip((swapped, given), modes, strict=True):
        track = run(f, torch.arange(40))
        ratio = (track.log_evidence.sum(0) - exact(f)[0]).exp()[:, None]
        assert_mean(ratio * (track.mode[-1] - wanted), torch.zeros(2))


@torch.no_grad()
def test_a_chain_that_does_not_listen():
    particle_filter = switching_filter(1000, resample=ALWAYS, chain=MarkovChain(FIRST, SPEECH, dt=DT))
    evidence = run(particle_filter, torch.arange(40)).log_evidence.sum(0)
    assert_mean((evidence - exact(particle_filter)[0]).exp(), 1.0)


# gradients


def gradients(particle_filter, runs, frames=4):
    """Gradients of the evidence relative to the exact one by all parameters (runs, P): their mean is exact."""
    whole, rows = exact(particle_filter, frames)[0], []
    for seed in range(runs):
        ratio = (run(particle_filter, seed, frames).log_evidence.sum() - whole).exp()
        rows.append(torch.cat([g.flatten() for g in torch.autograd.grad(ratio, list(particle_filter.parameters()))]))
    return torch.stack(rows)


@pytest.mark.parametrize(
    ("resample", "explore", "known"),
    [
        (NEVER, 0.0, 1),
        (NEVER, 0.4, 1),
        (StopGradient(resampling.systematic), 0.0, 7),
        (Adaptive(StopGradient(resampling.systematic), 0.5), 0.4, 7),
    ],
)
def test_gradient_of_the_evidence_is_that_of_the_enumeration(resample, explore, known):
    particle_filter = switching_filter(2000, resample=resample, explore=explore)
    wanted, drawn = exact_gradient(particle_filter), gradients(particle_filter, 25)
    assert_mean(drawn, wanted)
    of_chain = slice(-11, -1)  # the ten numbers before that of the measurement's error
    assert (wanted[of_chain].abs() > known * drawn[:, of_chain].std(0) / 25**0.5).all()


def test_copies_of_equal_weight_forget_what_the_chain_did():
    particle_filter = switching_filter(2000, resample=ALWAYS)
    wanted, drawn = exact_gradient(particle_filter), gradients(particle_filter, 25)
    away = (drawn.mean(0) - wanted).abs() / (drawn.std(0) / 25**0.5)
    assert away[-11:-1].max() > 20


@pytest.mark.parametrize("explore", [0.0, 0.4])
def test_gradient_of_the_first_frame_is_that_of_the_initial_law(explore):
    particle_filter = switching_filter(2000, explore=explore)
    assert_mean(gradients(particle_filter, 25, frames=1), exact_gradient(particle_filter, frames=1))
    run(particle_filter, 3, frames=1).log_evidence.sum().backward()
    chain = particle_filter.dynamics.chain
    assert (chain.logit_initial.grad.abs() > 0.05).all()
    assert (chain.logit_transition.grad == 0).all()
    assert (chain.logit_silence.grad == 0).all()


def test_gradient_does_not_change_the_numbers():
    particle_filter = switching_filter(100, resample=ALWAYS)
    track = run(particle_filter, 5)
    with torch.no_grad():
        plain = run(particle_filter, 5)
    assert torch.equal(track.log_evidence, plain.log_evidence)
    assert torch.equal(track.position, plain.position)
