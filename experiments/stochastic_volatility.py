"""How well is a parameter learned through each way of resampling, on the example that PyDPF's paper gives figures for?

python -m experiments.stochastic_volatility --out build/stochastic-volatility

Hidden log variances x' = alpha x + u and returns y = 0.5 exp(x / 2) e. Only alpha = 0.91 is learned, as published: from
a start uniform in (0, 1), 250 sequences of 101 frames in batches of 32, 100 particles that are resampled in each frame,
10 epochs of stochastic gradient descent (0.05, a twentieth less each epoch, gradient clamped to 1), and the best of all
epochs on 125 more sequences. The state has one dimension: sums over a grid give the exact evidence, and with it what
the best fit to the same sequences is and what the gradient should have been.
"""

import json
import math
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from experiments.autoregressive import Autoregressive, Volatility
from experiments.command import run
from experiments.resampling_schemes import SCHEMES, Scheme, log_evidence
from probtrack._files import check_writable
from probtrack.errors import InputError
from probtrack.filters import Belief, ParticleFilter

TRUE, AT = 0.91, 0.93  # what sequences are made by, and where the spread of the gradient is measured
SCALE, FRAMES, PARTICLES = 0.5, 101, 100
TRAIN, VALID, BATCH = 250, 125, 32
BOUNDS = (0.01, 0.99)
PUBLISHED = {  # error of alpha, standard deviation of the gradient
    "naive, cut every frame": (0.0035, 0.035),
    "soft": (0.0053, 0.38),
    "stop-gradient": (0.0062, 1.17),
    "marginal stop-gradient": (0.0052, 0.48),
    "optimal transport": (0.084, 12.95),
    "kernel mixture": (0.0039, 0.35),
}

NAMES = ["naive", *PUBLISHED]


@dataclass(frozen=True)
class Config:
    """Learn alpha from 10 starts by each scheme; --quick takes two starts and one epoch.

    A scheme that looks at all pairs of particles takes 20 minutes for what the others do in one. It gets one start, and
    none unless it is named.
    """

    seed: int = 0
    schemes: tuple[str, ...] = tuple(name for name in NAMES if not SCHEMES[name].pairs)
    repeats: int = 10
    epochs: int = 10
    quick: bool = False
    out: Path = Path("build/stochastic-volatility")


def main(config: Config) -> dict[str, Any]:
    """Print the figures in one line and write them as a table."""
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float32)
    table = config.out.with_suffix(".md")
    check_writable(table)
    unknown = [name for name in config.schemes if name not in NAMES]
    if unknown:
        raise InputError(f"schemes must be of {', '.join(NAMES)}, got {unknown[0]!r}")
    if config.quick:
        config = replace(config, repeats=2, epochs=1)
    seen = simulate(torch.full((config.repeats, 1, 1, 1), TRUE), TRAIN + VALID, config.seed)
    best = exact_fit(seen[:, :, :TRAIN])
    rows = [study(name, config, seen, best) for name in config.schemes]
    result = {
        "config": {**asdict(config), "out": str(config.out)},
        "error_of_exact_fit": _short(float((best - TRUE).abs().mean())),
        "exact_fit": [_short(x) for x in best.tolist()],
        "result": rows,
    }
    table.write_text(markdown(result))
    print(json.dumps(result))
    return result


def study(name: str, config: Config, seen: Tensor, best: Tensor) -> dict[str, Any]:
    """Return how well alpha is learned from `seen` by the scheme `name`, and how its gradient spreads.

    Args:
        name: Key of `SCHEMES`.
        config: Settings.
        seen: Returns (T, repeats, TRAIN + VALID, 1).
        best: The exact fit to each (repeats,).
    """
    scheme = SCHEMES[name]
    repeats = 1 if scheme.pairs else config.repeats
    seen = seen[:, :repeats]
    begin = time.thread_time()
    learned = learn(scheme, seen, config.epochs, config.seed)
    seconds = time.thread_time() - begin
    error = (learned - TRUE).abs()
    return {
        "scheme": name,
        "starts": repeats,
        "error": _short(float(error.mean())),
        "se": _short(float(error.std(correction=0)) / max(1, repeats - 1) ** 0.5),
        "off_exact_fit": _short(float((learned - best[:repeats]).abs().mean())),
        "learned": [_short(x) for x in learned.tolist()],
        "seconds_a_start": _short(seconds / repeats),
        **gradient_moments(scheme, config),
    }


def simulate(alpha: Tensor, sequences: int, seed: int) -> Tensor:
    """Return the returns (T, repeats, sequences, 1) of sequences with `alpha` (repeats, 1, 1, 1)."""
    generator = torch.Generator().manual_seed(seed)
    shape = (len(alpha), sequences, 1)
    state = torch.randn(shape, generator=generator) * (1 - alpha[..., 0].square()).rsqrt()
    seen = []
    for _ in range(FRAMES):
        state = alpha[..., 0] * state + torch.randn(shape, generator=generator)
        seen.append(SCALE * (state / 2).exp() * torch.randn(shape, generator=generator))
    return torch.stack(seen)


def learn(scheme: Scheme, seen: Tensor, epochs: int, seed: int) -> Tensor:
    """Return alpha (repeats,) learned from the returns `seen` (T, repeats, TRAIN + VALID, 1)."""
    repeats = seen.shape[1]
    generator = torch.Generator().manual_seed(seed + 1)
    dynamics = Autoregressive(torch.rand(repeats, 1, 1, 1, generator=generator).clamp(*BOUNDS), torch.ones(()))
    dynamics.log_std.requires_grad_(False)
    alpha = dynamics.coefficient
    particle_filter = _filter(dynamics, scheme)
    optimiser = torch.optim.SGD([alpha], lr=0.05)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimiser, 0.95)
    best, least = alpha.detach().clone(), torch.full((repeats,), torch.inf)
    for epoch in range(epochs):
        order = torch.rand(repeats, TRAIN, generator=generator).argsort(-1)
        for step, rows in enumerate(order.split(BATCH, -1)):
            batch = seen[:, torch.arange(repeats)[:, None], rows]
            loss = -mean_log_evidence(particle_filter, batch, scheme, 1000 * epoch + step)
            optimiser.zero_grad()
            loss.mean(-1).sum().backward()  # repeats know nothing of each other
            assert alpha.grad is not None
            alpha.grad.clamp_(-1.0, 1.0)
            optimiser.step()
            alpha.data.clamp_(*BOUNDS)
        schedule.step()
        with torch.no_grad():
            loss = -mean_log_evidence(particle_filter, seen[:, :, TRAIN:], scheme, 1000 * epoch + 999).mean(-1)
        better = loss < least
        least = torch.where(better, loss, least)
        best = torch.where(better[:, None, None, None], alpha.detach(), best)
    return best.flatten()


def gradient_moments(scheme: Scheme, config: Config) -> dict[str, Any]:
    """Return the standard deviation of the gradient of a sequence, over runs, and its bias, over sequences."""
    sequences, runs, rounds = (10, 16, 1) if config.quick or scheme.pairs else (10, 64, 4)
    seen = simulate(torch.full((1, 1, 1, 1), TRUE), sequences, config.seed + 7).movedim(1, 2)
    gradients = []
    for index in range(rounds):
        dynamics = Autoregressive(torch.full((sequences, runs, 1, 1), AT), torch.ones(()))
        evidence = mean_log_evidence(_filter(dynamics, scheme), seen.expand(-1, -1, runs, 1), scheme, 10**6 + index)
        gradients.append(torch.autograd.grad(evidence.sum(), dynamics.coefficient)[0][..., 0, 0])
    gradient = torch.cat(gradients, -1)
    at = torch.full((sequences,), AT, dtype=torch.float64, requires_grad=True)
    truth = torch.autograd.grad(exact_log_evidence(at, seen).sum() / FRAMES, at)[0]
    std, bias = gradient.std(-1), (gradient.mean(-1) - truth)
    return {
        "gradient_std": _short(float(std.median())),
        "gradient_std_range": [_short(float(std.min())), _short(float(std.max()))],
        "gradient_rms_bias": _short(float(bias.square().mean().sqrt())),
        "exact_gradient_rms": _short(float(truth.square().mean().sqrt())),
    }


def mean_log_evidence(particle_filter: ParticleFilter, seen: Tensor, scheme: Scheme, draw: int) -> Tensor:
    """Return the log evidence (*batch) of returns `seen` (T, *batch, 1) a frame, from the stationary law.

    Runs get seeds of their own, other ones for each `draw`.
    """
    batch = seen.shape[1:-1]
    noise = particle_filter.noise(draw * 10**6 + torch.arange(batch.numel()).view(batch))
    alpha = particle_filter.dynamics.coefficient
    state = noise.normal(PARTICLES, 1) * (1 - alpha.square()).rsqrt()
    belief = Belief(state, torch.zeros_like(state[..., 0]).log_softmax(-1), torch.zeros(batch))
    return log_evidence(particle_filter, belief, seen, 1.0, noise, cut=scheme.cut) / len(seen)


def exact_log_evidence(alpha: Tensor, seen: Tensor, spacing: float = 0.4) -> Tensor:
    """Return the log evidence (R, S) of returns `seen` (T, R, S, 1) for `alpha` (R,), in float64.

    Sums over a grid stand for the integrals over the state: the densities are wide, and such sums converge faster than
    any power of the `spacing`.
    """
    grid = torch.arange(-20.0, 20.0 + spacing / 2, spacing, dtype=torch.float64)
    alpha, seen = alpha.double(), seen.double() / SCALE
    unit = spacing / math.sqrt(2 * math.pi)
    moves = unit * (-0.5 * (grid - alpha[:, None, None] * grid[:, None]).square()).exp()
    precision = (1 - alpha.square())[:, None]
    mass = (unit * precision.sqrt() * (-0.5 * precision * grid.square()).exp())[:, None]
    total = torch.zeros(seen.shape[1:3], dtype=torch.float64)
    for frame in seen:
        joint = (mass @ moves) * (-0.5 * (frame.square() * (-grid).exp() + grid)).exp()
        evidence = joint.sum(-1, keepdim=True)
        mass, total = joint / evidence, total + evidence[..., 0].log()
    return total - len(seen) * math.log(SCALE * math.sqrt(2 * math.pi))


@torch.no_grad()
def exact_fit(seen: Tensor) -> Tensor:
    """Return alpha (R,) under which returns `seen` (T, R, S, 1) are most probable, by Newton's steps from the truth."""
    alpha, side = torch.full((seen.shape[1],), TRUE, dtype=torch.float64), 0.002
    for _ in range(3):
        below, at, above = (exact_log_evidence(alpha + shift, seen).sum(-1) for shift in (-side, 0.0, side))
        alpha = alpha + 0.5 * side * (above - below) / (2 * at - above - below)
    return alpha


def _filter(dynamics: Autoregressive, scheme: Scheme) -> ParticleFilter:
    return ParticleFilter(dynamics, Volatility(SCALE), num_particles=PARTICLES, resample=scheme.resample)


def markdown(result: dict[str, Any]) -> str:
    """Return the table of `result`, PyDPF's figures beside ours."""
    names = ("scheme", "error of alpha", "PyDPF's", "off the exact fit", "std of the gradient (over sequences)",
             "PyDPF's", "rms bias of the gradient", "s a start")  # fmt: skip
    lines = ["| " + " | ".join(names) + " |", "|---" * len(names) + "|"]
    for row in result["result"]:
        error, std = PUBLISHED.get(row["scheme"], ("-", "-"))
        low, high = row["gradient_std_range"]
        cells = (
            row["scheme"],
            f"{row['error']} ± {row['se']} ({row['starts']} starts)",
            error,
            row["off_exact_fit"],
            f"{row['gradient_std']} ({low} to {high})",
            std,
            row["gradient_rms_bias"],
            row["seconds_a_start"],
        )
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    lines.append(f"| exact fit | {result['error_of_exact_fit']} | - | 0 | 0 | - | 0 | - |")
    return "\n".join(lines) + "\n"


def _short(value: float) -> float:
    return float(f"{value:.4g}")


if __name__ == "__main__":
    run(main, Config)
