"""Learning a chain: from talkers whose modes are known, and from noisy positions by the particle filter."""

import math

import pytest
import torch
from switching_parts import Heard, Measured

from probtrack.dynamics import CoordinateUncoupled, DrivenAcceleration, DrivenVelocity, Kinematics, TimeCorrelated
from probtrack.filters import ParticleFilter, StopGradient, resampling
from probtrack.switching import MarkovChain, SwitchingDynamics

DT = 0.1
FIRST, ROWS, QUIET = [0.7, 0.3], [[0.9, 0.1], [0.25, 0.75]], [[0.35, 0.65], [0.55, 0.45]]


def talker(chain, *, slow=0.2, fast=1.5):
    """One who drifts, or accelerates: states of 4 and 6 numbers, each with a density."""
    drift = CoordinateUncoupled(DrivenVelocity(TimeCorrelated(2.0, slow)))
    return SwitchingDynamics([drift, CoordinateUncoupled(DrivenAcceleration(TimeCorrelated(5.0, fast)))], chain)


def dancer(chain, *, explore=0.0):
    """One who stands or jumps about, which shows in each frame."""
    parts = [CoordinateUncoupled(DrivenVelocity(TimeCorrelated(*process))) for process in ((20.0, 0.05), (5.0, 3.0))]
    model = SwitchingDynamics(parts, chain, explore=explore)
    model.models.requires_grad_(requires_grad=False)
    return model


def simulated(model, frames, talkers, speech=None):
    """States (frames + 1, talkers, D), the first of which has no mode yet."""
    state = model.from_kinematics(Kinematics(torch.zeros(talkers, 1, 2), torch.zeros(talkers, 1, 2)))
    states = [state]
    with torch.no_grad():
        for _, move in zip(range(frames), model.moves(Heard(None, speech), DT), strict=False):
            state, _ = move(state, torch.randn(talkers, 1, model.noise_dim))
            states.append(state)
    return torch.stack(states)[:, :, 0]


def counted(states):
    """How often each mode follows each, (2, 2)."""
    before, after = states[1:-1, :, -1].long(), states[2:, :, -1].long()
    return torch.bincount((2 * before + after).flatten(), minlength=4).view(2, 2)


def assert_within_errors(learned, truth, counts, z=5.0):
    """Rows are learned to z standard errors of shares of that many draws."""
    p = torch.tensor(truth)
    error = (learned - p).abs() / (p * (1 - p) / counts.sum(-1, keepdim=True)).sqrt()
    assert (error < z).all(), error


def test_chain_and_models_are_recovered_from_known_modes():
    truth = talker(MarkovChain(FIRST, ROWS, dt=DT))
    states = simulated(truth, 20, 150)
    model = talker(MarkovChain([0.5, 0.5], [[0.5, 0.5], [0.5, 0.5]], dt=DT), slow=0.5, fast=0.6)
    optimiser = torch.optim.LBFGS(model.parameters(), max_iter=25, line_search_fn="strong_wolfe")

    def loss():
        optimiser.zero_grad()
        value = -model(states[:-1], DT).log_prob(states[1:]).mean()
        value.backward()
        return value

    optimiser.step(loss)
    counts, learned = counted(states), model.chain(DT).detach().exp()
    # given the modes the most likely probabilities are the shares that were seen
    torch.testing.assert_close(learned[:2], counts / counts.sum(-1, keepdim=True), rtol=0, atol=2e-3)
    torch.testing.assert_close(learned[2, 0], (states[1, :, -1] == 0).double().mean(), rtol=0, atol=2e-3)
    assert_within_errors(learned[:2], ROWS, counts)
    for made, true, draws in zip(model.models, truth.models, counts.sum(0).tolist(), strict=True):
        error = made.axis_model.process.log_std - true.axis_model.process.log_std
        assert error.abs() < 5 * 1.5 / math.sqrt(4 * draws)  # of 2 axes; rate and spread are learned together


WRONG, WRONG_QUIET = [[0.3, 0.7], [0.8, 0.2]], [[0.85, 0.15], [0.1, 0.9]]  # to start from


def observed(chain, speech=None):
    """Noisy positions of 24 talkers over 20 frames, and how often their modes followed each other."""
    states = simulated(dancer(chain), 20, 24, speech)
    return states[1:, :, :2] + 0.1 * torch.randn(20, 24, 2), counted(states)


def climb(model, seen, steps=15):
    """Take some steps up the evidence, each with other random numbers."""
    particle_filter = ParticleFilter(
        model, Measured(0.1), num_particles=100, resample=StopGradient(resampling.systematic)
    )
    optimiser = torch.optim.Adam(model.chain.parameters(), lr=0.25)
    for seed in range(steps):
        noise = particle_filter.noise(torch.arange(24) + 100 * seed)
        start = particle_filter.spread_around(torch.zeros(24, 2), noise, std=0.01, speed=0.01)
        optimiser.zero_grad()
        (-particle_filter(seen, start, DT, noise).log_evidence.mean()).backward()
        optimiser.step()


@pytest.mark.parametrize("explore", [0.0, 0.2])
def test_transitions_are_recovered_by_the_particle_filter(explore):
    positions, counts = observed(MarkovChain(FIRST, ROWS, dt=DT))
    model = dancer(MarkovChain(FIRST, WRONG, dt=DT), explore=explore)
    climb(model, Heard(positions, torch.zeros(20, 24)))
    # modes that are guessed from positions are known less well than by sight, as if from half of them
    assert_within_errors(model.chain(DT).detach().exp()[:2], ROWS, counts / 2)


def test_transitions_in_speech_and_silence_are_recovered_by_the_particle_filter():
    speech = (torch.rand(20, 24) < 0.4).double()
    positions, counts = observed(MarkovChain(FIRST, ROWS, silence=QUIET, dt=DT), speech)
    model = dancer(MarkovChain(FIRST, WRONG, silence=WRONG_QUIET, dt=DT))
    climb(model, Heard(positions, speech))
    spoken, silent = model.chain(DT, torch.tensor([1.0, 0.0])).detach().exp()[:, :2]
    assert_within_errors(spoken, ROWS, 0.4 * counts / 2)
    assert_within_errors(silent, QUIET, 0.6 * counts / 2)
