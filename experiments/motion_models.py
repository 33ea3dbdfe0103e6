"""What does each motion model expect of a talker, and what does it do when the talker falls silent?

python -m experiments.motion_models

For every model of S1's Table 1 three pictures: 50 walks of 4 s that the model draws by itself from the start of a
true walk; the particles of a filter that hears where that talker is; and the same with a gap of silence, in which
particles go on by the model alone, as in S1 Figure 5. Each line is what became of one particle from frame to frame.
The switching models follow, told when the talker is silent; what they draw freely is a talker who speaks.
"""

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple, get_args

import torch
from torch import Tensor

from experiments.command import run
from probtrack.dynamics import Dynamics, Kinematics, Lehmann2007Model, lehmann2007
from probtrack.errors import InputError
from probtrack.filters import Adaptive, NoiseStream, resampling
from probtrack.likelihoods import GaussianPosition
from probtrack.likelihoods.gaussian import MeasuredPosition
from probtrack.switching import PRESETS

DT = 0.032  # s, the step of Table 1


@dataclass(frozen=True)
class Config:
    """Draw from and filter with every model."""

    draws: int = 50  # walks, and particles of the filter
    seconds: float = 4.0
    silence: tuple[float, float] = (1.4, 2.8)  # s
    std: float = 0.03  # m, of the measured position
    seed: int = 0
    out: Path = Path("build/motion_models")


class Hearing(NamedTuple):
    """What is heard: measured positions (T, 2) [m], and whether the talker speaks (T,), 1 or 0."""

    position: Tensor
    speech: Tensor


def main(config: Config) -> dict[str, Any]:
    """Draw the pictures; print and return the figures of each model, lengths in metres."""
    torch.set_num_threads(1)
    if not 10 * DT < config.silence[0] < config.silence[1] - DT < config.seconds:
        raise InputError(f"silence must lie between {10 * DT} and {config.seconds} s, got {config.silence}")
    if config.draws < 1:
        raise InputError(f"draws must be at least 1, got {config.draws}")
    config.out.mkdir(parents=True, exist_ok=True)
    models = {name: lehmann2007(name) for name in get_args(Lehmann2007Model)}
    models |= {name: make(2) for name, make in PRESETS.items()}
    truth = true_walk(config.seconds)
    with torch.inference_mode():
        tries = {name: attempt(model, truth, config) for name, model in models.items()}
    for part, prefix in (("cu", ("CU",)), ("cl", ("CL",)), ("switching", tuple(PRESETS))):
        chosen = {name: paths for name, (paths, _) in tries.items() if name.startswith(prefix)}
        draw(chosen, truth, config, config.out / f"motion-models-{part}.png")
    result = {name: figures for name, (_, figures) in tries.items()}
    print(json.dumps({"config": {**asdict(config), "out": str(config.out)}, "result": result}))
    return result


def true_walk(seconds: float) -> Tensor:
    """Return positions (T, 2) [m] of a talker who bends to the left at 0.5 m/s, as in S1 Figure 3."""
    t = DT * torch.arange(1, round(seconds / DT) + 1)
    angle = -0.6 + 0.35 * t
    return torch.stack([0.8 + 0.5 / 0.35 * angle.sin(), 1.9 - 0.5 / 0.35 * angle.cos()], -1)


def attempt(model: Dynamics, truth: Tensor, config: Config) -> tuple[list[Tensor], dict[str, float]]:
    """Return the steps (2, T, N, 2) of particles drawn freely, heard throughout and with a gap; and figures."""
    t = DT * torch.arange(1, len(truth) + 1)
    spoken = ((t < config.silence[0]) | (t > config.silence[1])).float()
    generator = torch.Generator().manual_seed(config.seed)
    heard = truth + config.std * torch.randn(truth.shape, generator=generator)
    throughout = torch.ones_like(spoken)
    tries = [
        follow(model, heard, speech, weigh, config)
        for speech, weigh in ((throughout, 0 * spoken), (throughout, throughout), (spoken, spoken))
    ]
    (_, free), _, (_, gap) = tries
    last = int((spoken == 0).nonzero()[-1])
    error = (gap[last].mean(0) - truth[last]).norm()
    figures = {
        "free_spread_after_1_s": _spread(free[round(1 / DT)]),
        "free_spread_at_the_end": _spread(free[-1]),
        "spread_at_the_end_of_the_silence": _spread(gap[last]),
        "error_at_the_end_of_the_silence": float(error),
        "error_at_the_end": float((gap[-1].mean(0) - truth[-1]).norm()),
    }
    return [torch.stack(pair) for pair in tries], {name: round(value, 3) for name, value in figures.items()}


def follow(model: Dynamics, heard: Tensor, speech: Tensor, weigh: Tensor, config: Config) -> tuple[Tensor, Tensor]:
    """Return where the particles of each frame came from and where they went, both (T, N, 2), before resampling.

    Frames in which `weigh` (T,) is 0 leave the particles to the model, which is told of `speech` (T,).
    """
    n = config.draws
    likelihood, resample = GaussianPosition(config.std), Adaptive(resampling.systematic)
    noise = NoiseStream(config.seed, n, model.noise_dim, 1)
    velocity = (heard[10] - heard[0]) / (10 * DT)
    start = Kinematics(heard[0] + config.std * noise.normal(n, 2), velocity + 0.1 * noise.normal(n, 2))
    state, log_weight = model.from_kinematics(start), torch.full((n,), -math.log(n))
    moves, steps = iter(model.moves(Hearing(heard, speech), DT)), []
    observations = map(MeasuredPosition._make, zip(*likelihood.prepare(heard), strict=True))
    for observation, weighs, move in zip(observations, weigh, moves, strict=False):
        before = model.kinematics(state).position
        normal, uniform = noise.frame()
        state, _ = move(state, normal)
        after = model.kinematics(state)
        steps.append((before.clone(), after.position.clone()))
        if weighs:
            log_weight = torch.log_softmax(log_weight + likelihood(observation, after), -1)
            state, log_weight = resample(state, log_weight, uniform)
    came, went = zip(*steps, strict=True)
    return torch.stack(came), torch.stack(went)


def draw(tries: dict[str, list[Tensor]], truth: Tensor, config: Config, output: Path) -> None:
    """Draw a row for each model: free walks from above, x against time heard throughout, and with the silence."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    t = DT * torch.arange(len(truth) + 1)
    figure, axes = plt.subplots(len(tries), 3, figsize=(10.5, 2.3 * len(tries)), layout="constrained", squeeze=False)
    for row, (name, paths) in zip(axes, tries.items(), strict=True):
        lines(row[0], paths[0][:, :, :, 0], paths[0][:, :, :, 1])
        row[0].plot(truth[:, 0], truth[:, 1], "k--", lw=1.2)
        row[0].set(xlim=(-1.2, 3.4), ylim=(-1.2, 3.0), aspect="equal", ylabel=f"{name}\ny [m]")
        for axis, path in zip(row[1:], paths[1:], strict=True):
            time = torch.stack([t[:-1], t[1:]])[:, :, None].expand(-1, -1, config.draws)
            lines(axis, time, path[..., 0])
            axis.plot(t[1:], truth[:, 0], "k--", lw=1.2)
            axis.set(xlim=(0, config.seconds), ylim=(-0.6, 2.6), ylabel="x [m]")
        row[2].axvspan(*config.silence, color="0.9", zorder=0)
    for axis, title in zip(axes[0], ("drawn freely, from above", "heard throughout", "with a silence"), strict=True):
        axis.set_title(title, fontsize=10)
    for axis, label in zip(axes[-1], ("x [m]", "time [s]", "time [s]"), strict=True):
        axis.set_xlabel(label)
    figure.savefig(output, dpi=80)
    plt.close(figure)


def lines(axis: Any, x: Tensor, y: Tensor) -> None:
    """Draw the steps with coordinates `x`, `y` (2, T, N): a line from where each came to where it went."""
    from matplotlib.collections import LineCollection

    segments = list(torch.stack([x, y], -1).flatten(1, 2).movedim(0, 1).numpy())
    axis.add_collection(LineCollection(segments, colors="#1764ab", linewidths=0.5, alpha=0.35))


def _spread(position: Tensor) -> float:
    """Return the root mean square distance of particles (N, 2) from their mean [m]."""
    return float((position - position.mean(0)).square().sum(-1).mean().sqrt())


if __name__ == "__main__":
    run(main, Config)
