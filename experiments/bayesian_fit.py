"""How sure may one be of a motion model's parameters, and is what a posterior says of itself true?

python -m experiments.bayesian_fit
python -m experiments.bayesian_fit --datasets 5 --draws 16 --steps 16   # in seconds

Four parts. Calibration: parameters of CU-LAN are drawn from a prior, talkers move by them and are measured; how often
are the 50 and 90 % intervals right, and are the ranks of the truth among the draws uniform (Talts et al. 2018,
arXiv 1804.06788)? Each data set has parameters of its own in one module, so that one run of the sampler draws from all
their posteriors. Exact and estimated: the same talkers by the Kalman filter and by particles. Curvilinear: the same for
CL-TCVE-TCTU, by particles alone. Switching: transition probabilities by particles.
"""

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import pyro.distributions as dist
import torch
from torch import Tensor, nn

from experiments.command import run
from probtrack.dynamics import (
    CoordinateUncoupled,
    DrivenVelocity,
    Dynamics,
    Kinematics,
    TimeCorrelated,
    euler,
    lehmann2007,
)
from probtrack.filters import Gaussian, ParticleFilter, StopGradient, kalman_filter, position_system, resampling
from probtrack.likelihoods import GaussianPosition
from probtrack.switching import MarkovChain, SwitchingDynamics
from probtrack.training.bayesian import NUTS, SVI, ParticleMetropolis, Posterior, fit_posterior

DT, ERROR = 0.5, 0.2  # s, m
PRIOR = {"rate": dist.LogNormal(math.log(0.5), 0.6), "std": dist.LogNormal(math.log(0.7), 0.4)}


@dataclass(frozen=True)
class Config:
    """Sizes of the four parts."""

    datasets: int = 100
    """Data sets of the calibration."""
    draws: int = 400
    """Draws a chain; half as many for warm-up."""
    steps: int = 300
    """Steps of a variational fit."""
    seed: int = 0


def main(config: Config) -> dict[str, Any]:
    """Print and return posteriors, truths, calibration and seconds."""
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    result = {}
    for part in (calibration, exact_and_estimated, curvilinear, switching):
        torch.manual_seed(config.seed)
        before = time.perf_counter()
        result[part.__name__] = {**part(config), "seconds": round(time.perf_counter() - before, 1)}
    print(json.dumps({"config": asdict(config), "result": result}))
    return result


def calibration(config: Config) -> dict[str, Any]:
    """Return how often intervals hold the truth, and how even its ranks are, by NUTS on the Kalman evidence."""
    frames, paths, sets = 5, 12, config.datasets
    priors = {f"axis_model.process.{name}": law.expand([sets, 1]) for name, law in _float64(PRIOR).items()}
    truth = {name: law.sample() for name, law in priors.items()}
    model, dt = talkers_of_their_own(sets), torch.full((sets, 1), DT)
    with torch.no_grad():
        for (_, parameter), value in zip(model.named_parameters(), truth.values(), strict=True):
            parameter.copy_(value.log())
    y = measured(model, dt, torch.zeros(sets, paths, model.state_dim), frames)
    rest = Gaussian(torch.zeros(2), torch.zeros(2, 2))

    def log_evidence(model: CoordinateUncoupled, _: int) -> Tensor:
        return kalman_filter(y, position_system(model, dt, ERROR), rest).log_evidence

    method = NUTS(config.draws // 2, config.draws // 4, 1)
    posterior = fit_posterior(model, priors, log_evidence, method, seed=config.seed)
    share = torch.stack([(posterior.values[name][0] < truth[name]).double().mean(0) for name in priors]).flatten(1)
    counts = torch.stack([torch.histc(row, 5, 0, 1) for row in share])
    return {
        "parameters": list(priors),
        "inside_50": [round(float(x), 3) for x in ((share - 0.5).abs() < 0.25).double().mean(1)],
        "inside_90": [round(float(x), 3) for x in ((share - 0.5).abs() < 0.45).double().mean(1)],
        "ranks_chi2_4dof": [round(float(x), 2) for x in ((counts - sets / 5) ** 2 / (sets / 5)).sum(1)],
        "ess_median": [round(float(x.median())) for x in posterior.effective_sample_size().values()],
        "divergences": int(posterior.notes["divergences"].sum()),
    }


def exact_and_estimated(config: Config) -> dict[str, Any]:
    """Return posteriors of CU-LAN by the Kalman filter and by a particle filter, from the same positions."""
    frames, paths = 12, 4
    truth = lehmann2007("CU-LAN")
    y = measured(truth, DT, torch.zeros(paths, 4), frames)
    start = Gaussian(torch.zeros(4), torch.diag(torch.tensor([ERROR, ERROR, 0.2, 0.2]).square()))
    model = filter_of(lehmann2007("CU-LAN-ORIG"), particles=300)
    priors = {f"dynamics.axis_model.process.{name}": law for name, law in _float64(PRIOR).items()}

    def exact(model: ParticleFilter, _: int) -> Tensor:
        return kalman_filter(y, position_system(model.dynamics, DT, ERROR), start).log_evidence

    few = max(config.draws // 4, 4)
    found = {
        "nuts": fit_posterior(model, priors, exact, NUTS(few, few, 1), seed=config.seed),
        "svi": fit_posterior(model, priors, exact, SVI(config.steps), seed=config.seed),
        "particle_metropolis": fit_posterior(
            model, priors, by_particles(y), ParticleMetropolis(config.draws, config.draws // 2, 2), seed=config.seed
        ),
        "particle_svi": fit_posterior(model, priors, by_particles(y), SVI(config.steps), seed=config.seed),
    }
    return {"truth": {"rate": 0.2, "std": 0.7}, **{name: said(posterior) for name, posterior in found.items()}}


def curvilinear(config: Config) -> dict[str, Any]:
    """Return the posterior of speed and turning of CL-TCVE-TCTU by particles."""
    truth = lehmann2007("CL-TCVE-TCTU")
    walking = Kinematics(torch.zeros(4, 2), torch.tensor([0.5, 0.0]).expand(4, 2))
    y = measured(truth, 0.2, truth.from_kinematics(walking), 20)
    priors = {"dynamics.speed.std": dist.LogNormal(0.0, 0.5), "dynamics.turning.process.std": dist.LogNormal(0.5, 0.7)}
    known = {name.rpartition("log_")[0] + name.rpartition("log_")[2]: p for name, p in truth.named_parameters()}
    posterior = fit_posterior(
        filter_of(truth, particles=300),
        _float64(priors),
        by_particles(y, dt=0.2, speed=0.5),
        ParticleMetropolis(config.draws, config.draws // 2, 1),
        seed=config.seed,
    )
    return {
        "truth": {name: float(known[name.removeprefix("dynamics.")].detach().exp()) for name in priors},
        "particle_metropolis": said(posterior),
    }


def switching(config: Config) -> dict[str, Any]:
    """Return the posterior of the transition probabilities of one who stands or jumps about."""
    rows = [[0.9, 0.1], [0.25, 0.75]]
    parts = [CoordinateUncoupled(DrivenVelocity(TimeCorrelated(r, s))) for r, s in ((20.0, 0.05), (5.0, 3.0))]
    truth = SwitchingDynamics(parts, MarkovChain([0.7, 0.3], rows, dt=0.1))
    rest = truth.from_kinematics(Kinematics(torch.zeros(4, 2), torch.zeros(4, 2)))
    y = measured(truth, 0.1, rest, 20, error=0.1)
    model = filter_of(
        SwitchingDynamics(parts, MarkovChain([0.7, 0.3], [[0.5, 0.5], [0.5, 0.5]], dt=0.1)), particles=300, error=0.1
    )
    posterior = fit_posterior(
        model,
        {"dynamics.chain.transition": dist.Dirichlet(torch.ones(2, 2))},
        by_particles(y, dt=0.1, speed=0.05),
        ParticleMetropolis(config.draws, config.draws // 2, 1),
        seed=config.seed,
    )
    return {"truth": {"dynamics.chain.transition": rows[0] + rows[1]}, "particle_metropolis": said(posterior)}


def talkers_of_their_own(sets: int) -> CoordinateUncoupled:
    """Return CU-LAN of one coordinate, in which each of `sets` data sets has its parameters."""
    process = TimeCorrelated(1.0, 1.0)
    model = CoordinateUncoupled(DrivenVelocity(process, euler), 1)
    process.log_rate, process.log_std = nn.Parameter(torch.zeros(sets, 1)), nn.Parameter(torch.zeros(sets, 1))
    return model


def filter_of(dynamics: Dynamics, particles: int, error: float = ERROR) -> ParticleFilter:
    """Return the filter of positions measured with a known error."""
    resample = StopGradient(resampling.systematic)
    return ParticleFilter(dynamics, GaussianPosition(error), num_particles=particles, resample=resample)


def by_particles(y: Tensor, dt: float = DT, speed: float = 0.2) -> Callable[[ParticleFilter, int], Tensor]:
    """Return the estimated evidence of positions `y` (T, paths, 2) of talkers who start near the origin."""

    def log_evidence(model: ParticleFilter, seed: int) -> Tensor:
        noise = model.noise(seed + torch.arange(y.shape[1]))
        start = model.spread_around(torch.zeros(y.shape[1], 2), noise, std=ERROR, speed=speed)
        return model(y, start, dt, noise).log_evidence

    return log_evidence


def measured(model: Dynamics, dt: float | Tensor, state: Tensor, frames: int, error: float = ERROR) -> Tensor:
    """Return noisy positions (frames, *batch, A) of talkers who move by `model` from `state` (*batch, D)."""
    step, positions = model.transition(dt), []
    with torch.no_grad():
        for _ in range(frames):
            state = step(state, torch.randn(*state.shape[:-1], model.noise_dim))
            positions.append(model.kinematics(state).position)
    path = torch.stack(positions)
    return path + error * torch.randn_like(path)


def said(posterior: Posterior[Any]) -> dict[str, Any]:
    """Return means, 90 % intervals, diagnostics."""
    ends = posterior.interval(0.9)
    return {
        "mean": {name: _rounded(x) for name, x in posterior.mean().items()},
        "interval_90": {name: _rounded(x.reshape(2, -1).T) for name, x in ends.items()},
        "r_hat": {name: _rounded(x) for name, x in posterior.r_hat().items()},
        "notes": {name: _rounded(x) for name, x in posterior.notes.items() if x.numel() < 10},
    }


def _float64(priors: dict[str, Any]) -> dict[str, Any]:
    """Return LogNormal priors in the default type, which was another when this file was read."""
    return {name: dist.LogNormal(law.loc.double(), law.scale.double()) for name, law in priors.items()}


def _rounded(x: Tensor) -> Any:
    def short(value: Any) -> Any:
        return [short(v) for v in value] if isinstance(value, list) else float(f"{value:.3g}")

    return short(x.tolist())


if __name__ == "__main__":
    run(main, Config)
