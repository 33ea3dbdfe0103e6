"""Posteriors by an exact evidence: against quadrature, and calibrated over talkers drawn from the prior."""

import math

import numpy as np
import pyro.distributions as dist
import torch
from oracles.joint_gaussian import JointGaussian
from oracles.van_loan import van_loan
from torch import nn

from probtrack.dynamics import CoordinateUncoupled, DrivenVelocity, RandomWalk, TimeCorrelated
from probtrack.filters import Gaussian, kalman_filter, position_system
from probtrack.training.bayesian import NUTS, SVI, fit_posterior

DT, SETS, PATHS, FRAMES = 0.7, 30, 4, 9
SPREAD = {"rate": (math.log(0.8), 0.5), "std": (math.log(0.6), 0.4)}  # of the logarithms, a priori


def speeds():
    """A process in which each of SETS talkers has a rate and a spread of its own."""
    process = TimeCorrelated(rate=1.0, std=1.0)
    process.log_rate = nn.Parameter(torch.zeros(SETS, 1))
    process.log_std = nn.Parameter(torch.zeros(SETS, 1))
    return process


def priors():
    return {name: dist.LogNormal(*spread).expand([SETS, 1]) for name, spread in SPREAD.items()}


def simulated(truth):
    """Values (FRAMES + 1, SETS, PATHS) from zero."""
    x, decay = [torch.zeros(SETS, PATHS)], torch.exp(-truth["rate"] * DT)
    for _ in range(FRAMES):
        x.append(decay * x[-1] + truth["std"] * (1 - decay**2).sqrt() * torch.randn(SETS, PATHS))
    return torch.stack(x)


def log_evidence_of(x):
    def log_evidence(process, _):
        step = process(DT)
        return dist.Normal(step.decay * x[:-1], step.std, validate_args=False).log_prob(x[1:])

    return log_evidence


def by_quadrature(x):
    """Oracle: posterior means and standard deviations of log rate and log std of one talker's `x` (T + 1, P)."""
    cells = 81
    rate, std = (np.exp(mean + np.linspace(-4.5, 4.5, cells) * s) for mean, s in SPREAD.values())
    before, after = x[:-1].reshape(-1, 1), x[1:].reshape(-1, 1)
    decay = np.exp(-rate * DT)
    squares = ((after - before * decay) ** 2).sum(0)[:, None]
    variance = (1 - decay**2)[:, None] * std**2
    level = -0.5 * squares / variance - len(after) / 2 * np.log(variance)
    level = level - 0.5 * np.add.outer(*[np.linspace(-4.5, 4.5, cells) ** 2] * 2)
    weight = np.exp(level - level.max())
    weight /= weight.sum()
    moments = []
    for axis, value in enumerate((np.log(rate), np.log(std))):
        marginal = weight.sum(1 - axis)
        mean = marginal @ value
        moments.append((mean, math.sqrt(marginal @ (value - mean) ** 2)))
    return moments


def test_nuts_draws_from_the_posterior():
    torch.manual_seed(1)
    x = simulated({name: prior.sample() for name, prior in priors().items()})[:, 3]
    separate = {name: dist.LogNormal(*spread) for name, spread in SPREAD.items()}
    posterior = fit_posterior(TimeCorrelated(1.0, 1.0), separate, log_evidence_of(x), NUTS(80, 60, 1), seed=2)
    for name, (mean, std) in zip(SPREAD, by_quadrature(x.numpy()), strict=True):
        draws = posterior.parameters[f"log_{name}"]
        standard = std / math.sqrt(80 / 3)  # neighbours are alike
        assert abs(draws.mean() - mean) < 5 * standard
        assert abs(draws.std() - std) < 5 * standard / math.sqrt(2)
    assert posterior.notes["divergences"].tolist() == [0.0]
    assert all(r < 1.2 for r in posterior.r_hat().values())


def test_ranks_of_the_truth_among_the_draws_are_uniform():
    """Talts et al. (2018), Theorem 1, for talkers that were drawn from the prior, each with a spread of its own."""
    truth = {name: prior.sample() for name, prior in priors().items()}
    x, process = simulated(truth), speeds()
    with torch.no_grad():
        process.log_rate.copy_(truth["rate"].log())
    std = {"std": priors()["std"]}
    posterior = fit_posterior(process, std, log_evidence_of(x), SVI(steps=250, lr=0.05, num_samples=100))
    share = (posterior.values["std"][0] < truth["std"]).double().mean(0)
    assert abs(share.mean() - 0.5) < 4 / math.sqrt(12 * SETS)
    for probability in (0.5, 0.9):
        inside = ((share - 0.5).abs() < probability / 2).double().mean()
        assert abs(inside - probability) < 4 * math.sqrt(probability * (1 - probability) / SETS)
    spread = 1 / math.sqrt(2 * PATHS * FRAMES + 1 / SPREAD["std"][1] ** 2)  # of log std, where a Gaussian has it
    draws = posterior.parameters["log_std"].std((0, 1))
    assert (draws / spread - 1).abs().mean() < 0.2


def positions(frames, paths, std):
    """Noisy positions (frames, paths, 1) of a walk whose velocity wanders."""
    model, state, seen = CoordinateUncoupled(DrivenVelocity(RandomWalk(0.5)), 1), torch.zeros(paths, 2), []
    step = model.transition(DT)
    with torch.no_grad():
        for _ in range(frames):
            state = step(state, torch.randn(paths, 2))
            seen.append(state[:, :1] + std * torch.randn(paths, 1))
    return torch.stack(seen)


def test_posterior_by_the_kalman_filter_is_that_of_the_joint_law():
    y, seen = positions(3, 5, 0.3), torch.ones(3, 5, dtype=torch.bool)
    seen[1, 2] = False
    rest, name = Gaussian(torch.zeros(2), torch.zeros(2, 2)), "axis_model.process.diffusion"

    def log_evidence(model, _):
        return kalman_filter(y, position_system(model, DT, 0.3), rest, observed=seen).log_evidence

    model = CoordinateUncoupled(DrivenVelocity(RandomWalk(3.0)), 1)
    posterior = fit_posterior(model, {name: dist.LogNormal(-0.5, 0.8)}, log_evidence, SVI(60, 0.15, 200), seed=3)
    log_value, level = np.linspace(-3.5, 2.5, 61), []
    for q in np.exp(log_value):
        F, Q = van_loan(0.0, q, DT, 2)
        steps = (np.repeat(x[None], 3, 0) for x in (F, np.linalg.cholesky(Q)))
        law = JointGaussian(*steps, np.eye(1, 2), np.array([[0.09]]), np.zeros(2), np.zeros((2, 2)))
        level.append(sum(law.log_evidence(y[:, i].numpy(), seen[:, i].tolist()) for i in range(5)))
    level = np.array(level) - 0.5 * ((log_value + 0.5) / 0.8) ** 2
    weight = np.exp(level - level.max()) / np.exp(level - level.max()).sum()
    mean = weight @ log_value
    std = math.sqrt(weight @ (log_value - mean) ** 2)
    draws = posterior.parameters["axis_model.process.log_diffusion"]
    # a Gaussian whose last gradients were noisy
    assert abs(draws.mean() - mean) < 0.5 * std
    assert abs(draws.std() / std - 1) < 0.4
