"""What does each way of resampling do to the evidence and its gradient, and what does it cost?

python -m experiments.resampling_schemes --out build/schemes

Sequences are simulated by linear Gaussian models, and the particle filter runs over each several times. Its log
evidence and its gradient in every parameter are held against the Kalman filter's on the same sequence. What the errors
of all runs over a sequence share is the bias there, which need not be the same on every sequence; the rest is chance.
Every scheme resamples in every frame unless its name says otherwise, and gets the observations, first clouds and (if it
needs as many uniform numbers) the random numbers that the others get.
"""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from experiments.autoregressive import Autoregressive, EachRun, NoisyPosition
from experiments.command import run
from experiments.scheme_pictures import draw, markdown
from probtrack._files import check_writable
from probtrack.dynamics import lehmann2007
from probtrack.filters import (
    Adaptive,
    Belief,
    Gaussian,
    LinearSystem,
    NoiseStream,
    ParticleFilter,
    Resampler,
    StopGradient,
    kalman_filter,
)
from probtrack.filters.resampling import KernelMixture, MarginalStopGradient, OptimalTransport, Soft, systematic


class Scheme(NamedTuple):
    """A way of resampling.

    Attributes:
        resample: What happens to the cloud after each frame.
        cut: After how many frames the gradient is cut, None for never.
        pairs: Whether it looks at all pairs of particles.
        density: Whether it needs the density of the motion.
    """

    resample: Resampler
    cut: int | None = None
    pairs: bool = False
    density: bool = False


SCHEMES = {
    "naive": Scheme(systematic),
    "naive, cut every frame": Scheme(systematic, cut=1),
    "soft": Scheme(Soft(systematic, 0.7)),
    "stop-gradient": Scheme(StopGradient(systematic)),
    "stop-gradient, cut every 16": Scheme(StopGradient(systematic), cut=16),
    "stop-gradient on N_eff < N/2": Scheme(Adaptive(StopGradient(systematic), 0.5)),
    "marginal stop-gradient": Scheme(MarginalStopGradient(systematic), pairs=True, density=True),
    "kernel mixture": Scheme(KernelMixture(), pairs=True),
    "optimal transport": Scheme(OptimalTransport(), pairs=True),
}
_MOST_PAIRS = 64  # particles of a scheme that looks at all pairs: beyond it takes minutes


class Model(NamedTuple):
    """A linear Gaussian model with parameters of its own for each run.

    Attributes:
        dynamics: How it moves.
        likelihood: How it is seen.
        initial: Law of the state before the first frame.
        dt: Time step [s].
        parameters: Leaves of the gradient by name, (runs, 1) or (runs, 1, 1).
    """

    dynamics: Autoregressive | EachRun
    likelihood: NoisyPosition
    initial: Gaussian
    dt: float
    parameters: dict[str, Tensor]


class Estimate(NamedTuple):
    """Log evidence of each run, and its gradient in each parameter.

    Attributes:
        log_evidence: (runs,).
        gradient: By the parameter's name, (runs,).
    """

    log_evidence: Tensor
    gradient: dict[str, Tensor]


def autoregressive(runs: int, *, dim: int = 1) -> Model:
    """Return a = 0.5, Q = 1 and R = 0.5 in `dim` dimensions."""
    dynamics = Autoregressive(torch.full((runs, 1, 1), 0.5), torch.ones(runs, 1, 1), dim)
    likelihood = NoisyPosition(torch.full((runs, 1), 0.5**0.5))
    parameters = {"a": dynamics.coefficient, "log σ_Q": dynamics.log_std, "log σ_R": likelihood.log_std}
    return Model(dynamics, likelihood, Gaussian(torch.zeros(dim), torch.eye(dim)), 1.0, parameters)


def langevin(runs: int) -> Model:
    """Return CU-LAN in steps of 0.1 s in two dimensions, seen with an error of 0.1 m."""
    dynamics, likelihood = EachRun(lehmann2007("CU-LAN"), runs), NoisyPosition(torch.full((runs, 1), 0.1))
    named = {name.rpartition(".")[2].replace("_", " "): p for name, p in dynamics.named_parameters()}
    initial = Gaussian(torch.zeros(4), torch.diag(torch.tensor([0.1, 0.1, 0.5, 0.5]).square()))
    return Model(dynamics, likelihood, initial, 0.1, {**named, "log σ_R": likelihood.log_std})


MODELS: dict[str, Callable[[int], Model]] = {
    "autoregressive, d = 1": autoregressive,
    "autoregressive, d = 2": lambda runs: autoregressive(runs, dim=2),
    "CU-LAN, d = 4": langevin,
}


class Case(NamedTuple):
    """One cell of the study."""

    model: str
    frames: int
    particles: int


_FIRST = Case("autoregressive, d = 1", 128, 32)
_CASES = (
    _FIRST,
    *(_FIRST._replace(particles=n) for n in (16, 64, 256)),
    *(_FIRST._replace(frames=t) for t in (32, 256)),
    Case("autoregressive, d = 2", 128, 32),
    Case("CU-LAN, d = 4", 64, 64),
)


@dataclass(frozen=True)
class Config:
    """Hold each scheme against the Kalman filter on 100 sequences; --quick takes shorter and fewer ones."""

    seed: int = 0
    sequences: int = 100
    repeats: int = 4
    quick: bool = False
    out: Path = Path("build/schemes")


def main(config: Config) -> dict[str, Any]:
    """Print the figures in one line, and write them as a table and a picture."""
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    check_writable(config.out.with_suffix(".md"))
    if config.quick:
        config, cases = replace(config, sequences=10, repeats=2), (Case("autoregressive, d = 1", 16, 8),)
    else:
        cases = _CASES
    rows = []
    for case in cases:
        rows += study(case, config)
        config.out.with_suffix(".md").write_text(markdown(rows))  # what is known so far: all takes minutes
    draw(rows, config.out.with_suffix(".png"))
    result = {"config": {**asdict(config), "out": str(config.out)}, "result": rows}
    print(json.dumps(result))
    return result


def study(case: Case, config: Config) -> Iterator[dict[str, Any]]:
    """Yield what each scheme does to the evidence of sequences like `case`."""
    seen = simulate(MODELS[case.model](config.sequences), case.frames, config.seed).repeat(1, config.repeats, 1)
    model = MODELS[case.model](seen.shape[1])
    truth = exact(model, seen)
    for name, scheme in SCHEMES.items():
        too_many = scheme.pairs and case.particles > _MOST_PAIRS
        if too_many or (scheme.density and case.model == "CU-LAN, d = 4"):  # S1's steps have no density
            continue
        estimated(model, seen[:2], scheme, case.particles, config.seed)  # loads what a scheme loads once
        begin = time.thread_time()
        found = estimated(model, seen, scheme, case.particles, config.seed)
        seconds = time.thread_time() - begin
        pairs = [("log evidence", found.log_evidence, truth.log_evidence)]
        pairs += [(key, found.gradient[key], truth.gradient[key]) for key in truth.gradient]
        yield {
            "scheme": name,
            **case._asdict(),
            "ms_per_frame": _short(1e3 * seconds / case.frames),
            "error": {key: moments((ours - true).view(config.repeats, -1)) for key, ours, true in pairs},
            "exact_std": {key: _short(float(gradient.std())) for key, gradient in truth.gradient.items()},
        }


def simulate(model: Model, frames: int, seed: int) -> Tensor:
    """Return observations (T, runs, A) of sequences that the model makes."""
    generator = torch.Generator().manual_seed(seed)
    runs = len(model.likelihood.log_std)
    step, kinematics = model.dynamics.transition(model.dt), model.dynamics.kinematics
    with torch.no_grad():
        root = torch.linalg.cholesky(model.initial.covariance)
        state = model.initial.mean + torch.randn(runs, 1, len(root), generator=generator) @ root.mT
        seen = []
        for _ in range(frames):
            state = step(state, torch.randn(runs, 1, model.dynamics.noise_dim, generator=generator))
            place = kinematics(state).position[:, 0]
            seen.append(place + model.likelihood.log_std.exp() * torch.randn(place.shape, generator=generator))
    return torch.stack(seen)


def exact(model: Model, seen: Tensor) -> Estimate:
    """Return what the Kalman filter says of observations `seen` (T, runs, A)."""
    return _with_gradient(model, kalman_filter(seen, system_of(model), model.initial).log_evidence)


def estimated(model: Model, seen: Tensor, scheme: Scheme, num_particles: int, seed: int) -> Estimate:
    """Return what the particle filter says of observations `seen` (T, runs, A)."""
    runs = seen.shape[1]
    particle_filter = ParticleFilter(
        model.dynamics, model.likelihood, num_particles=num_particles, resample=scheme.resample
    )
    noise = particle_filter.noise(torch.arange(runs) + 1_000_003 * (seed + 1))
    root = torch.linalg.cholesky(model.initial.covariance)
    state = model.initial.mean + noise.normal(num_particles, len(root)) @ root.mT
    belief = Belief(state, torch.zeros_like(state[..., 0]).log_softmax(-1), torch.zeros(runs))
    return _with_gradient(model, log_evidence(particle_filter, belief, seen, model.dt, noise, cut=scheme.cut))


def log_evidence(
    particle_filter: ParticleFilter, belief: Belief, seen: Tensor, dt: float, noise: NoiseStream, *, cut: int | None
) -> Tensor:
    """Return the log evidence (runs,) of `seen` with the gradient `cut` after so many frames, if at all."""
    for block in seen.split(cut or len(seen)):
        belief, _ = particle_filter.run(belief, block, dt, noise)
        belief = belief._replace(state=belief.state.detach(), log_weight=belief.log_weight.detach())
    return belief.log_evidence


def system_of(model: Model) -> LinearSystem:
    """Return the matrices of the model, one for each run."""
    dynamics, state_dim = model.dynamics, model.dynamics.state_dim
    eye = torch.eye(state_dim)
    H = dynamics.kinematics(eye).position.mT
    F, G = dynamics.matrices(model.dt)
    error = (2 * model.likelihood.log_std).exp()[..., None]
    return LinearSystem(F, G, H, error * torch.eye(dynamics.axes))


def _with_gradient(model: Model, evidence: Tensor) -> Estimate:
    """Return `evidence` (runs,) and each run's gradient: a run's evidence knows no other run's parameters."""
    gradients = torch.autograd.grad(evidence.sum(), list(model.parameters.values()))
    named = zip(model.parameters, gradients, strict=True)
    return Estimate(evidence.detach(), {name: gradient.flatten() for name, gradient in named})


def moments(error: Tensor) -> dict[str, float]:
    """Return what is common to errors (repeats, sequences), with its standard error, and what is not.

    The products of the errors of two runs over a sequence have the square of the bias there as their mean; chance
    alone makes that mean as large as the square of the resolution, at two standard deviations.
    """
    repeats, sequences = error.shape
    mean = error.mean(0)
    chance = error.var(0).mean()
    squared_bias = (mean.square() - error.var(0) / repeats).mean()
    return {
        "bias": _short(float(mean.mean())),
        "se": _short(float(mean.std() / sequences**0.5)),
        "rms_bias": _short(float(squared_bias.clamp_min(0).sqrt())),
        "resolution": _short(float(chance.sqrt()) * (8 / (sequences * repeats * (repeats - 1))) ** 0.25),
        "chance": _short(float(chance.sqrt())),
    }


def _short(value: float) -> float:
    return float(f"{value:.4g}")


if __name__ == "__main__":
    run(main, Config)
