"""Motion models are learnable: simulated by one set of parameters, fitted from another, back within 10 %."""

import math

import pytest
import torch

from probtrack.dynamics import CoordinateUncoupled, DrivenAcceleration, DrivenVelocity, RandomWalk, lehmann2007
from probtrack.filters import Gaussian, kalman_filter, position_system


def start_at(model, values):
    """The model with its parameters, in their order, at those physical values."""
    with torch.no_grad():
        for parameter, value in zip(model.parameters(), values, strict=True):
            parameter.fill_(math.log(value))
    return model


def fit(model, loss):
    optimiser = torch.optim.LBFGS(model.parameters(), line_search_fn="strong_wolfe", max_iter=40, tolerance_change=1e-7)

    def closure():
        optimiser.zero_grad()
        value = loss()
        value.backward()
        return value

    optimiser.step(closure)


def assert_recovered(model, truth):
    for fitted, true in zip(model.parameters(), truth.parameters(), strict=True):
        assert abs(fitted.exp() / true.exp() - 1) < 0.1, f"{fitted.exp():.4g} for {true.exp():.4g}"


def walks(model, frames, paths, dt):
    """States (frames + 1, paths, D) from rest at the origin."""
    states, step = [torch.zeros(paths, model.state_dim)], model.transition(dt)
    with torch.no_grad():
        for _ in range(frames):
            states.append(step(states[-1], torch.randn(paths, model.noise_dim)))
    return torch.stack(states)


# One path of a time-correlated process tells its rate to a fraction of sqrt(2 / (rate x duration)): the paths of each
# setting last for at least 1800 times 1 / rate in all, which is 3 %, and are seen several times in each 1 / rate.
SETTINGS = {  # frames, paths, dt [s], observation error [m]
    "CU-LAN": (30, 300, 0.5, 0.02),
    "CU-TCVE": (40, 200, 0.5, 0.02),
    "CU-TCAC": (60, 60, 0.01, 5e-5),
    "CU-RWVE": (30, 60, 0.1, 0.02),
}


@pytest.mark.parametrize(
    ("name", "start"),
    [
        ("CU-LAN", (0.8, 0.2)),
        ("CU-LAN", (0.05, 2.5)),
        ("CU-TCVE", (1.2, 0.2)),
        ("CU-TCAC", (8.0, 7.0)),
        ("CU-TCAC", (100.0, 0.6)),
        ("CU-RWVE", (0.05,)),
        ("CU-RWVE", (1.5,)),
    ],
)
def test_maximum_evidence_recovers_motion_from_noisy_positions(name, start):
    frames, paths, dt, error = SETTINGS[name]
    truth, model = lehmann2007(name), start_at(lehmann2007(name), start)
    positions = walks(truth, frames, paths, dt)[1:, :, :2]
    y = positions + error * torch.randn_like(positions)
    rest = Gaussian(torch.zeros(model.state_dim), torch.zeros(model.state_dim, model.state_dim))
    fit(model, lambda: -kalman_filter(y, position_system(model, dt, error), rest).increments.mean())
    assert_recovered(model, truth)


EXACT = {
    "CU-TCVE": lambda: lehmann2007("CU-TCVE", 3, printed=False),
    "CU-TCAC": lambda: lehmann2007("CU-TCAC", 3, printed=False),
    "walk": lambda: CoordinateUncoupled(DrivenVelocity(RandomWalk(0.3)), 3),
    "driven walk": lambda: CoordinateUncoupled(DrivenAcceleration(RandomWalk(0.3)), 3),
}


@pytest.mark.parametrize(
    ("name", "dt", "start"),
    [
        ("CU-TCVE", 0.5, (1.5, 0.1)),
        ("CU-TCVE", 0.5, (0.05, 3.0)),
        ("CU-TCAC", 0.032, (5.0, 9.0)),
        ("CU-TCAC", 0.032, (120.0, 0.5)),
        ("walk", 0.1, (1.5,)),
        ("driven walk", 0.1, (0.05,)),
    ],
)
def test_maximum_likelihood_recovers_exact_motion_from_its_states(name, dt, start):
    truth, model = EXACT[name](), start_at(EXACT[name](), start)
    states = walks(truth, 40, 100, dt)
    fit(model, lambda: -model(states[:-1], dt).log_prob(states[1:]).mean())
    assert_recovered(model, truth)


def changes(before, after):
    """Log mean squares of change and sum of the variables that have a noise: speed, and acceleration or direction."""
    v, w = before[:, [2, -1]], after[:, [2, -1]]
    return torch.stack([(w - v).square().mean(0), (w + v).square().mean(0)]).log()


@pytest.mark.parametrize(
    ("name", "dt", "spread", "start"),
    [
        ("CL-RWVE-RWTU", 0.005, 0.5, (1.0, 3.5)),
        ("CL-RWVE-RWTU", 0.005, 0.5, (13.0, 3.5)),
        ("CL-TCVE-TCTU", 0.5, 3.0, (0.7, 0.3, 0.6, 1.0)),
        ("CL-RWVE-RAAC", 0.032, 0.5, (1.3, 0.08)),
        ("CL-RWVE-RWAC", 0.032, 0.5, (5.5, 3.5)),
        ("CL-TCVE-TCAC", 1.0, 3.0, (0.5, 1.0, 0.3, 10.0)),
    ],
)
def test_moments_of_samples_recover_a_walk_from_its_states(name, dt, spread, start):
    truth, model, n = lehmann2007(name), start_at(lehmann2007(name), start), 40_000
    states = spread * torch.randn(n, model.state_dim)
    seen = changes(states, truth.transition(dt)(states, torch.randn(n, 2)).detach())
    noise = torch.randn(n, 2)
    fit(model, lambda: (changes(states, model.transition(dt)(states, noise)) - seen).square().sum())
    assert_recovered(model, truth)
