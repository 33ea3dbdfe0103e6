"""Truncated back-propagation: the values of a whole run, and gradients that end where a window begins."""

import math

import pytest
import torch
from torch import nn
from torch.distributions import Independent, Normal

from probtrack.audio import Observations
from probtrack.dynamics import Dynamics, Kinematics, lehmann2007
from probtrack.errors import InputError
from probtrack.filters import Adaptive, Belief, ParticleFilter, Relocation, StopGradient, resampling
from probtrack.likelihoods import EvidenceMap, GaussianPosition, Likelihood, Positions
from probtrack.switching import speech_and_silence
from probtrack.training import run_in_windows

STD, FRAMES, RUNS, COUNT = 0.3, 11, 3, 17


def a_filter(dynamics=None, likelihood=None, **settings):
    return ParticleFilter(
        lehmann2007("CU-LAN") if dynamics is None else dynamics,
        GaussianPosition(STD) if likelihood is None else likelihood,
        num_particles=COUNT,
        resample=Adaptive(StopGradient(resampling.systematic), 0.8),
        **settings,
    )


def begun(tracked):
    noise = tracked.noise(torch.arange(RUNS) + 5)
    return tracked.spread_around(torch.zeros(RUNS, 2), noise, std=0.2), noise


def walks():
    return (0.2 * torch.randn(FRAMES, RUNS, 2)).cumsum(0)


def whole(tracked, observations, dt):
    belief, noise = begun(tracked)
    return tracked.run(belief, observations, dt, noise)[1]


def windowed(tracked, observations, dt, window):
    belief, noise = begun(tracked)
    return run_in_windows(tracked, belief, observations, dt, noise, window)


def gradients(tracked, cloud):
    loss = (cloud.log_evidence.sum() + cloud.state[..., :2].square().sum()) / FRAMES
    return torch.autograd.grad(loss, list(tracked.parameters()), allow_unused=True)


class Spoken(Likelihood):
    """Hears speech, and knows that the talker is about the origin."""

    def __init__(self):
        super().__init__()
        self.log_std = nn.Parameter(torch.tensor(STD).log())
        self.centre = torch.cartesian_prod(torch.linspace(-0.6, 0.6, 4), torch.linspace(-0.6, 0.6, 3))

    def evidence_map(self, prepared):
        offset = self.centre - prepared.gcc[..., :1, :]
        return EvidenceMap(-0.5 * offset.square().sum(-1), self.centre, torch.tensor([0.4, 0.6]))

    def forward(self, observation, kinematics):
        offset = kinematics.position - observation.gcc[..., :1, :]
        return Normal(0.0, self.log_std.exp()).log_prob(offset).sum(-1) * observation.speech[..., None]


def spoken():
    return Observations(walks()[..., None, :], torch.rand(FRAMES, RUNS))


CASES = {
    "one tensor": (lambda: a_filter(), walks),
    "some unobserved": (lambda: a_filter(), lambda: Positions(walks(), torch.rand(FRAMES, RUNS) < 0.7)),
    "switching by speech": (lambda: a_filter(speech_and_silence(dt=0.1), Spoken()), spoken),
    "relocation": (lambda: a_filter(likelihood=Spoken(), relocation=Relocation(share=0.3)), spoken),
}


@pytest.mark.parametrize("window", [1, 4, FRAMES - 1, 99])
@pytest.mark.parametrize("case", CASES)
def test_values_are_those_of_the_whole_run(case, window):
    make, observe = CASES[case]
    tracked, observations, dt = make(), observe(), 0.05 + 0.1 * torch.rand(FRAMES, RUNS)
    one, other = whole(tracked, observations, dt), windowed(tracked, observations, dt, window)
    for name, a, b in zip(one._fields, one, other, strict=True):
        if a is not None:
            torch.testing.assert_close(b, a, rtol=1e-12, atol=1e-12, msg=lambda m, name=name: f"{name}: {m}")
    assert (other.log_proposal is None) == (one.log_proposal is None) == (case != "relocation")


@pytest.mark.parametrize("window", [FRAMES, None])
@pytest.mark.parametrize("case", CASES)
def test_gradient_of_one_window_is_that_of_the_whole_run(case, window):
    make, observe = CASES[case]
    tracked, observations = make(), observe()
    exact = gradients(tracked, whole(tracked, observations, 0.1))
    for one, other in zip(exact, gradients(tracked, windowed(tracked, observations, 0.1, window)), strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            torch.testing.assert_close(other, one)


class Scaled(Dynamics):
    """x' = a x dt, without noise: what a gradient reaches can be counted."""

    state_dim = noise_dim = 1

    def __init__(self, scale):
        super().__init__()
        self.scale = nn.Parameter(torch.tensor(scale))

    def forward(self, state, dt):
        return Independent(Normal(self.scale * dt * state, 1e-3), 1)

    def transition(self, dt):
        return lambda state, noise: self.scale * dt * state + 0 * noise

    def kinematics(self, state):
        return Kinematics(state, torch.zeros_like(state))

    def from_kinematics(self, kinematics):
        return kinematics.position


@pytest.mark.parametrize("window", [1, 2, 3, 5, None])
def test_gradient_reaches_back_to_the_beginning_of_the_window(window):
    # x_t = x_0 a^t dt_1 ... dt_t: of its derivative t x_t / a in full, as many parts are left as frames in the window
    tracked = ParticleFilter(Scaled(1.2), GaussianPosition(STD), num_particles=1)
    steps, frame = torch.tensor([0.7, 1.3, 0.4, 1.1, 0.9]), torch.arange(1.0, 6.0)
    belief = Belief(torch.tensor([[1.5]]), torch.zeros(1), torch.zeros(()))
    cloud = run_in_windows(tracked, belief, torch.zeros(5, 1), steps, tracked.noise(), window)
    x = 1.5 * (1.2 * steps).cumprod(0)
    torch.testing.assert_close(cloud.state[:, 0, 0], x)
    reach = frame if window is None else (frame - 1) % window + 1
    for t in range(5):
        (by_scale,) = torch.autograd.grad(cloud.state[t].sum(), tracked.dynamics.scale, retain_graph=True)
        torch.testing.assert_close(by_scale, reach[t] * x[t] / 1.2)
    (by_scale,) = torch.autograd.grad(cloud.log_evidence.sum(), tracked.dynamics.scale)
    torch.testing.assert_close(by_scale, -(x * reach * x / 1.2).sum() / STD**2)


def test_first_belief_keeps_its_gradient_in_the_first_window_only():
    tracked, start = a_filter(), torch.zeros(RUNS, 2, requires_grad=True)
    noise = tracked.noise(torch.arange(RUNS))
    belief = tracked.spread_around(start, noise)
    cloud = run_in_windows(tracked, belief, walks(), 0.1, noise, 4)
    (by_start,) = torch.autograd.grad(cloud.state[:4].sum(), start, retain_graph=True)
    assert by_start.abs().min() > 0
    assert not torch.autograd.grad(cloud.state[4:].sum(), start)[0].any()


@pytest.mark.parametrize("dt", [0.1, torch.tensor(0.1), torch.full((FRAMES,), 0.1), torch.full((FRAMES, RUNS), 0.1)])
def test_any_time_step_may_be_cut(dt):
    tracked, observations = a_filter(), walks()
    exact = whole(tracked, observations, 0.1)
    torch.testing.assert_close(windowed(tracked, observations, dt, 3).state, exact.state)


@pytest.mark.parametrize("window", [0, -3, 2.0, True])
def test_rejects_a_window_of_no_frame(window):
    with pytest.raises(InputError, match="window must be an integer of at least 1"):
        windowed(a_filter(), walks(), 0.1, window)


@pytest.mark.parametrize("window", [2, None])
def test_no_frame_is_refused_as_by_the_filter(window):
    with pytest.raises(InputError, match="observations hold no frame"):
        windowed(a_filter(), walks()[:0], 0.1, window)


def test_time_steps_of_the_frames_alone_are_refused_if_they_cannot_be():
    dt = torch.full((FRAMES,), 0.1)
    dt[7] = math.nan
    with pytest.raises(InputError, match="dt must be positive seconds"):
        windowed(a_filter(), walks(), dt, 3)
