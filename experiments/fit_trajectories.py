"""Are the parameters of a motion model found again from measured positions, and which model describes walks best?

python -m experiments.fit_trajectories

Talkers are simulated by each of the ten models of S1's Table 1, with its values, and by a switching one; a model that
starts elsewhere, and with a wrong error of the measured position, is fitted by the exact evidence if it is linear, and
by that of a particle filter if not. How well that can be done is a matter of the data: a correlation time is known from
the number of times it passes, a change of direction from steps so short that it does not turn about within one.

Then all ten are fitted to people who walk by the social force model (96 walks of 4 s, every 96 ms to 2 cm), and held
against 32 other such walks by their log evidence a frame (mean and standard error).
"""

import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from experiments.command import run
from probtrack.dynamics import CoordinateUncoupled, DrivenVelocity, Dynamics, TimeCorrelated, lehmann2007
from probtrack.simulation.trajectories import SocialForceWalk
from probtrack.switching import MarkovChain, SwitchingDynamics
from probtrack.training import (
    SampledTrajectories,
    Trajectory,
    TrajectoryBatch,
    TrajectoryDataset,
    TrajectoryFit,
    WalkedTrajectories,
    collate_trajectories,
    physical_values,
)


class Data(NamedTuple):
    """What is simulated: trajectories, frames, time step [s], error of a position [m], speed at the start [m/s].

    And how many particles it takes for an estimate of the evidence whose logarithm is not far too low.
    """

    count: int
    frames: int
    dt: float
    error: float
    speed: float = 1.0
    particles: int = 300


EXACT = {
    "CU-RWVE": Data(100, 60, 0.1, 0.02),
    "CU-TCVE": Data(300, 40, 0.5, 0.02),
    "CU-TCAC": Data(100, 60, 0.01, 5e-5),
    "CU-LAN": Data(300, 40, 0.5, 0.02),
    "CU-LAN-ORIG": Data(100, 60, 0.05, 0.005),
}
PARTICLES = {
    "CL-RWVE-RWTU": Data(512, 20, 0.005, 0.003),
    "CL-TCVE-TCTU": Data(512, 30, 0.2, 0.15, 2.0),
    "CL-RWVE-RAAC": Data(512, 16, 0.2, 0.05, 0.5),
    "CL-RWVE-RWAC": Data(512, 12, 0.1, 0.06, 3.0, 2000),
    "CL-TCVE-TCAC": Data(512, 12, 0.2, 0.1, 3.0, 3000),
}
SWITCHING = Data(256, 20, 0.1, 0.04, 0.3)
WALKS = WalkedTrajectories(SocialForceWalk(), count=128, duration=8.0, rate=1 / 0.096, error=0.02)
WALKERS = 200  # particles


@dataclass(frozen=True)
class Config:
    """Fit each model from a wrong start."""

    quick: bool = False
    """Two models and fewer steps."""

    seed: int = 0
    steps: int = 150
    """Of the fits by particles."""

    models: tuple[str, ...] = (*EXACT, *PARTICLES, "switching")
    walks: bool = True
    """Fit walks too."""


def main(config: Config) -> dict[str, Any]:
    """Print and return true and fitted values of each model, and what each says of walks."""
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    if config.quick:
        config = replace(config, models=("CU-RWVE", "CL-RWVE-RWTU"), steps=6, walks=False)
    result: dict[str, Any] = {name: recover(name, config) for name in config.models}
    if config.walks:
        result["walks"] = {name: describe(name, config) for name in (*EXACT, *PARTICLES)}
    print(json.dumps({"config": asdict(config), "result": result}))
    return result


def recover(name: str, config: Config) -> dict[str, Any]:
    """Simulate talkers by the model `name` and fit it to their measured positions from a wrong start."""
    data = SWITCHING if name == "switching" else (EXACT | PARTICLES)[name]
    source = SampledTrajectories(made(name), *data[:5], seed=config.seed)
    model = made(name)
    disturb(model)
    fit = TrajectoryFit(model, std=2 * data.error, speed=data.speed, num_particles=data.particles, seed=config.seed)
    start, before = values(fit.model), time.perf_counter()
    climb(fit, source.trajectories(), config)
    found, true = values(fit.model), values(made(name)) | {"likelihood.std": [data.error]}
    table = {
        short: {"true": t, "start": start[short], "fitted": found[short]} for short, t in true.items() if short in found
    }
    errors = [abs(f / t - 1) for row in table.values() for f, t in zip(row["fitted"], row["true"], strict=True)]
    return {
        "evidence": "exact" if fit.exact else "particles",
        "seconds": round(time.perf_counter() - before, 1),
        "largest_error": round(max(errors), 4),
        "parameters": table,
        "data": data._asdict(),
    }


def describe(name: str, config: Config) -> dict[str, Any]:
    """Fit the model `name` to walks, and return its log evidence a frame of other walks, before and after."""
    walks = [one._replace(time=one.time[42:], position=one.position[42:]) for one in WALKS.trajectories()]
    fit = TrajectoryFit(lehmann2007(name), num_particles=WALKERS, seed=config.seed)
    dataset = TrajectoryDataset(walks[96:])
    others = collate_trajectories([dataset[n] for n in range(len(dataset))])

    def held_out() -> list[float]:
        with torch.no_grad():
            runs = -fit.run_loss(others, draw=0)
        return [round(float(x), 3) for x in (runs.mean(), runs.std() / len(runs) ** 0.5)]

    table, before = held_out(), time.perf_counter()
    climb(fit, walks[:96], config)
    seconds = round(time.perf_counter() - before, 1)
    return {"table_1": table, "fitted": held_out(), "parameters": values(fit.model), "seconds": seconds}


def made(name: str) -> Dynamics:
    """Return the model `name` of Table 1, or one that switches between standing and walking."""
    if name != "switching":
        return lehmann2007(name)
    parts = [CoordinateUncoupled(DrivenVelocity(TimeCorrelated(*process))) for process in ((10.0, 0.1), (1.0, 1.0))]
    model = SwitchingDynamics(parts, MarkovChain([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]], dt=SWITCHING.dt))
    model.models.requires_grad_(requires_grad=False)
    model.chain.logit_initial.requires_grad_(requires_grad=False)
    return model


def disturb(model: nn.Module) -> None:
    """Move the parameters away from the truth: by factors of 2.5, up and down in turn; shares towards their reverse."""
    with torch.no_grad():
        for number, parameter in enumerate(p for p in model.parameters() if p.requires_grad):
            if parameter.ndim:
                parameter.copy_(parameter.flip(-1))
            else:
                parameter.add_((-1) ** number * math.log(2.5))


def climb(fit: TrajectoryFit, trajectories: Sequence[Trajectory], config: Config) -> None:
    """Move the parameters of `fit` to where the evidence is largest."""
    dataset = TrajectoryDataset(trajectories)
    items = [dataset[n] for n in range(len(dataset))]
    if fit.exact:
        exactly(fit, collate_trajectories(items))
        return
    parameters = [p for p in fit.parameters() if p.requires_grad]
    optimiser = torch.optim.Adam(parameters, lr=0.1, betas=(0.8, 0.99))
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: max(0.1, 1 - step / (0.6 * config.steps)))
    generator, late = torch.Generator().manual_seed(config.seed), []
    for step in range(config.steps):
        chosen = torch.randperm(len(items), generator=generator)[:32].tolist()
        optimiser.zero_grad()
        runs = fit.run_loss(collate_trajectories([items[n] for n in chosen]), draw=step)
        # of a talker who all but stood and went off another way no particle may be left: such a run says nothing
        runs[runs < runs.median() + 2.0].mean().backward()
        nn.utils.clip_grad_norm_(parameters, 5.0)
        optimiser.step()
        schedule.step()
        if step >= 2 * config.steps // 3:
            late.append([p.detach().clone() for p in parameters])
    with torch.no_grad():  # the mean of the last third: what is left of the noise of single steps averages out
        for parameter, history in zip(parameters, zip(*late, strict=True), strict=True):
            parameter.copy_(torch.stack(history).mean(0))


def exactly(fit: TrajectoryFit, batch: TrajectoryBatch) -> None:
    """Maximise an evidence that is the same each time."""
    parameters = [p for p in fit.parameters() if p.requires_grad]
    optimiser = torch.optim.LBFGS(parameters, line_search_fn="strong_wolfe", max_iter=40, tolerance_change=1e-7)

    def loss() -> Tensor:
        optimiser.zero_grad()
        value = fit.run_loss(batch, draw=0).mean()
        value.backward()
        return value

    optimiser.step(loss)


def values(model: nn.Module) -> dict[str, list[float]]:
    """Return trainable parameters by their physical names."""
    named = physical_values(model).items()
    return {
        name.removeprefix("dynamics."): [float(f"{x:.4g}") for x in value.flatten().tolist()] for name, value in named
    }


if __name__ == "__main__":
    run(main, Config)
