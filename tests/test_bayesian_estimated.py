"""Posteriors by an estimated evidence: as exact as by the evidence itself."""

import math

import pyro.distributions as dist
import torch
from oracles.mode_paths import answers
from torch import nn

from probtrack.dynamics import CoordinateUncoupled, DrivenVelocity, RandomWalk, TimeCorrelated
from probtrack.filters import Gaussian, ParticleFilter, StopGradient, kalman_filter, position_system, resampling
from probtrack.likelihoods import GaussianPosition
from probtrack.switching import MarkovChain, SwitchingDynamics
from probtrack.training.bayesian import SVI, ParticleMetropolis, fit_posterior


class Places(nn.Module):
    """What is estimated in the tests without a filter: a number, a share and probabilities."""

    def __init__(self):
        super().__init__()
        self.log_size = nn.Parameter(torch.zeros(()))
        self.logit_share = nn.Parameter(torch.zeros(()))
        self.logit_rows = nn.Parameter(torch.zeros(2, 3))
        self.offset = nn.Parameter(torch.zeros(2))


def noisy(evidence, std):
    """An estimate of `evidence(module)` whose logarithm has standard deviation `std(module)`, and mean evidence."""

    def log_evidence(module, seed):
        spread = std(module)
        u = torch.randn((), generator=torch.Generator().manual_seed(seed))
        return evidence(module) + spread * u - spread**2 / 2

    return log_evidence


def assert_mean(draws, mean, std):
    """The mean of `draws` (C, S, ...) is `mean` to 5 standard errors of independent chains' means."""
    size = len(draws) * draws.shape[1] / 25  # a random walk forgets itself in 25 steps or so
    assert ((draws.mean((0, 1)) - mean).abs() < 5 * std / math.sqrt(size)).all(), f"{draws.mean((0, 1))} for {mean}"


def test_noise_of_the_evidence_does_not_move_the_posterior():
    """One count of a Poisson law with a gamma prior, and an estimate that is noisier where the rate is high."""
    evidence = noisy(lambda m: m.log_size - 2 * m.log_size.exp(), lambda m: 1.2 * m.log_size.exp())
    posterior = fit_posterior(Places(), {"size": dist.Gamma(2.0, 1.0)}, evidence, ParticleMetropolis(1500, 150, 4))
    size = posterior.values["size"]
    assert_mean(size, 3 / 3, 0.577)
    assert_mean((size - 1).square(), 1 / 3, 0.67)
    assert ((posterior.notes["acceptance"] - 0.2).abs() < 0.1).all()
    assert abs(posterior.notes["log_evidence_std"] / (1.2 * size.mean()) - 1) < 5 / math.sqrt(2 * 19)


def test_every_kind_of_value_has_its_conjugate_posterior():
    counts, seen = torch.tensor([[5.0, 1.0, 2.0], [0.0, 3.0, 9.0]]), torch.tensor([0.4, -1.1])

    def log_evidence(m, _):
        rows = (counts * m.logit_rows.log_softmax(-1)).sum()
        share = 4 * nn.functional.logsigmoid(m.logit_share) + 7 * nn.functional.logsigmoid(-m.logit_share)
        return rows + share - 2 * (m.offset - seen).square().sum()

    priors = {
        "rows": dist.Dirichlet(torch.ones(2, 3)),
        "share": dist.Beta(1.0, 2.0),
        "offset": dist.Normal(torch.tensor([1.0, 0.0]), 0.5),
    }
    posterior = fit_posterior(Places(), priors, log_evidence, ParticleMetropolis(500, 300, 3))
    row = dist.Dirichlet(1 + counts)
    assert_mean(posterior.values["rows"], row.mean, 2 * row.stddev)  # seven numbers are explored slowly
    share = dist.Beta(5.0, 9.0)
    assert_mean(posterior.values["share"], share.mean, 2 * share.stddev)
    assert_mean(posterior.values["offset"], (seen + torch.tensor([1.0, 0.0])) / 2, 2 * math.sqrt(1 / 8))


# by a particle filter

DT, ERROR, NAME = 0.5, 0.4, "dynamics.axis_model.process.diffusion"


def walking():
    """A talker in the plane whose velocity wanders, measured at 5 times, twice."""
    model = CoordinateUncoupled(DrivenVelocity(RandomWalk(0.6)))
    state, seen, step = torch.zeros(2, 4), [], model.transition(DT)
    with torch.no_grad():
        for _ in range(5):
            state = step(state, torch.randn(2, 4))
            seen.append(state[:, :2] + ERROR * torch.randn(2, 2))
    return ParticleFilter(model, GaussianPosition(ERROR), num_particles=60, resample=SCHEME), torch.stack(seen)


SCHEME = StopGradient(resampling.systematic)


def estimated(seen):
    def log_evidence(model, seed):
        noise = model.noise(seed + torch.arange(2))
        start = model.spread_around(torch.zeros(2, 2), noise, std=0.3, speed=0.5)
        return model(seen, start, DT, noise).log_evidence

    return log_evidence


def of_grid(seen):
    """Mean and standard deviation of log diffusion by the Kalman filter on a grid, prior LogNormal(-0.5, 0.7)."""
    grid = torch.linspace(-3, 2, 41)
    start = Gaussian(torch.zeros(4), torch.diag(torch.tensor([0.09, 0.09, 0.25, 0.25])))
    level = torch.empty(41)
    with torch.no_grad():
        for i, value in enumerate(grid.exp().tolist()):
            model = CoordinateUncoupled(DrivenVelocity(RandomWalk(value)))
            level[i] = kalman_filter(seen, position_system(model, DT, ERROR), start).log_evidence.sum()
    weight = (level - 0.5 * ((grid + 0.5) / 0.7).square()).softmax(0)
    mean = weight @ grid
    return mean, (weight @ (grid - mean).square()).sqrt()


def test_particle_metropolis_is_as_exact_as_the_kalman_filter():
    model, seen = walking()
    posterior = fit_posterior(model, {NAME: dist.LogNormal(-0.5, 0.7)}, estimated(seen), ParticleMetropolis(200, 50, 1))
    mean, std = of_grid(seen)
    draws = posterior.parameters["dynamics.axis_model.process.log_diffusion"]
    assert_mean(draws, mean, std)
    assert_mean((draws - mean).square(), std**2, 2 * std**2)


def test_variational_posterior_by_particles_is_near_the_kalman_filters():
    model, seen = walking()
    model.num_particles = 150  # so that half the variance of the log evidence is small
    posterior = fit_posterior(
        model, {NAME: dist.LogNormal(-0.5, 0.7)}, estimated(seen), SVI(steps=110, lr=0.08, num_samples=200)
    )
    mean, std = of_grid(seen)
    draws = posterior.parameters["dynamics.axis_model.process.log_diffusion"]
    assert abs(draws.mean() - mean) < 0.4 * std
    assert abs(draws.std() / std - 1) < 0.35


def test_chain_is_learned_as_by_the_sum_over_all_mode_paths():
    """Probabilities of staying, a uniform prior: the posterior mean on a grid of the enumerated evidence."""
    rates, stds, initial = (20.0, 5.0), (0.05, 3.0), [0.7, 0.3]
    parts = [CoordinateUncoupled(DrivenVelocity(TimeCorrelated(r, s))) for r, s in zip(rates, stds, strict=True)]
    chain = MarkovChain(initial, [[0.5, 0.5], [0.5, 0.5]], dt=0.1)
    model = ParticleFilter(
        SwitchingDynamics(parts, chain), GaussianPosition(0.1), num_particles=60, resample=resampling.systematic
    )
    seen = 0.15 * torch.randn(4, 2).cumsum(0)

    def log_evidence(model, seed):
        noise = model.noise(torch.tensor([seed]))
        start = model.spread_around(torch.zeros(1, 2), noise, std=0.05, speed=0.1)
        return model(seen[:, None], start, 0.1, noise).log_evidence

    priors = {"dynamics.chain.transition": dist.Dirichlet(torch.tensor([[6.0, 2.0], [2.0, 1.0]]))}
    posterior = fit_posterior(model, priors, log_evidence, ParticleMetropolis(150, 40, 1), seed=4)
    with torch.no_grad():
        matrices = [tuple(x.numpy() for x in part.matrices(0.1)) for part in parts]
    start = torch.zeros(4).numpy(), torch.diag(torch.tensor([0.05, 0.05, 0.1, 0.1]).square()).numpy()
    H, R, eye = torch.eye(2, 4).numpy(), 0.01 * torch.eye(2).numpy(), torch.eye(4).numpy()
    middle = (torch.arange(8) + 0.5) / 8
    stay = torch.cartesian_prod(middle, middle)
    rows = torch.stack([stay[:, 0], 1 - stay[:, 0], 1 - stay[:, 1], stay[:, 1]], -1).view(-1, 2, 2)
    level = torch.tensor(
        [answers(seen.numpy(), matrices, [[eye] * 2] * 2, initial, [p.numpy()] * 4, start, [H, H], R)[0] for p in rows]
    )
    weight = (level + priors["dynamics.chain.transition"].log_prob(rows).sum(-1)).softmax(0)
    mean = weight @ stay
    std = (weight @ (stay - mean).square()).sqrt()
    drawn = posterior.values["dynamics.chain.transition"].diagonal(dim1=-2, dim2=-1)
    assert_mean(drawn, mean, std)
    away = dist.Dirichlet(torch.tensor([[6.0, 2.0], [2.0, 1.0]])).mean.diagonal() - mean
    assert away.abs().max() > 0.02
