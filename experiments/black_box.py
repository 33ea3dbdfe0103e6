"""What do gradients gain over a black-box search for the same parameters, in time and in error?

python -m experiments.black_box

Both begin from S1's Table 1 and change the same values of CU-LAN and its likelihood: rate, speed and exponent, and
those of the relocation. CMA-ES makes S1's RMSE over a training set small (eq. 33, by search); gradient
descent follows the likelihood of the true position under the cloud. Both are judged by the RMSE on recordings that
neither saw, whenever a fifth of the time is over.
"""

import json
import math
import time
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from experiments.command import run
from experiments.fit_scenes import data_set
from probtrack.filters import Adaptive, Relocation, StopGradient
from probtrack.filters.resampling import systematic
from probtrack.metrics import position_error
from probtrack.training import (
    CloudLikelihood,
    Lehmann2007FrontEnd,
    Lehmann2007Settings,
    SceneBatch,
    SceneDataset,
    SceneFit,
    collate,
)

_TRAINED = ("filter.dynamics", "filter.likelihood", "filter.relocation")
_REPORTS = 5


@dataclass(frozen=True)
class Config:
    """Search for as long with gradients as without."""

    seconds: float = 300.0  # for each of the two
    recordings: int = 16  # of training, and as many of the test
    population: int = 8  # of CMA-ES
    num_particles: int = 75
    learning_rate: float = 0.05
    data: Path = Path("build/fit_scenes/data")
    seed: int = 0
    quick: bool = False


def main(config: Config) -> dict[str, Any]:
    """Print and return the RMSE on test recordings over time, of both searches."""
    torch.set_num_threads(1)
    training, test = (recordings(name, config) for name in ("walks-training", "walks-test"))
    result = {
        "start": rmse(begun(config), test, 9),
        "gradient": followed(begun(config), descend, training, test, config),
        "black_box": followed(begun(config), search, training, test, config),
    }
    print(json.dumps({"config": asdict(config) | {"data": str(config.data)}, "result": result}))
    return result


def begun(config: Config) -> SceneFit:
    """Return a tracker with Table 1's values that is to be fitted."""
    tracker = Lehmann2007Settings(
        low=(0.0, 0.0, 0.0),
        high=(3.5, 3.1, 2.2),
        num_particles=config.num_particles,
        relocation=Relocation(),
        resample=Adaptive(StopGradient(systematic)),
    )
    return SceneFit(tracker, CloudLikelihood(0.15, 0.02), fixed=("front_end",), learning_rate=config.learning_rate)


def recordings(name: str, config: Config) -> SceneBatch:
    """Return observations of some whole recordings of a data set, at all of its signal-to-noise ratios."""
    folders = data_set(name, config.data, quick=config.quick)
    count = 2 if config.quick else config.recordings
    chosen = [folders[round(i)] for i in np.linspace(0, len(folders) - 1, count)]
    tracker = begun(config).tracker
    front_end = Lehmann2007FrontEnd().make(chosen[0].array, tracker.fs)
    dataset = SceneDataset([folder.path for folder in chosen], front_end)
    return collate([dataset[number] for number in range(count)])


@torch.no_grad()
def rmse(fit: SceneFit, batch: SceneBatch, draw: int) -> float:
    """Return S1's RMSE (eq. 7) over whole recordings, a mean over them [m]."""
    outcome = fit.outcome(batch, fit.seeds(batch, draw))
    assert outcome.truth is not None
    return float(position_error(outcome.estimate, outcome.truth).square().mean(0).sqrt().mean())


def descend(fit: SceneFit, training: SceneBatch, config: Config) -> Iterator[int]:
    """Follow the gradient on crops of the recordings, half of them begun anywhere; yields the number of filter runs."""
    optimiser = fit.configure_optimizers()
    frames, crop, step = training.num_frames, 150, 0
    generator = torch.Generator().manual_seed(config.seed)
    while True:
        start = int(torch.randint(frames - crop, (), generator=generator))
        batch = cropped(training, start, crop)
        fit.anywhere = 0.5
        loss = fit.run_loss(batch, step).mean()
        fit.anywhere = 0.0  # judged, like all others, from around the talker's first position
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(fit.parameters(), 1.0)
        optimiser.step()
        step += 1
        yield step * len(batch.names)


def search(fit: SceneFit, training: SceneBatch, config: Config) -> Iterator[int]:
    """Search by CMA-ES for the smallest RMSE on the recordings; yields the number of filter runs."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of pictures that its extra would draw
        import cma
    parameters = [p for name, p in fit.model.named_parameters() if name.startswith(_TRAINED)]

    def put(values: Any) -> None:
        with torch.no_grad():
            for parameter, value in zip(parameters, values, strict=True):
                parameter.fill_(float(value))

    begin = [float(p.detach()) for p in parameters]
    strategy = cma.CMAEvolutionStrategy(
        begin, 0.4, {"seed": config.seed + 1, "popsize": config.population, "verbose": -9}
    )
    generation = 0
    while True:
        candidates = strategy.ask()
        errors = []
        for candidate in candidates:
            put(candidate)
            error = rmse(fit, training, generation)
            errors.append(error if math.isfinite(error) else 1e3)
        strategy.tell(candidates, errors)
        put(strategy.mean)
        generation += 1
        yield generation * config.population * len(training.names)


def followed(fit: SceneFit, way: Any, training: SceneBatch, test: SceneBatch, config: Config) -> list[dict[str, float]]:
    """Return how a search does over time; judging it does not count as time."""
    spent, rows, seconds = 0.0, [], 1.0 if config.quick else config.seconds
    steps = way(fit, training, config)
    while spent < seconds:
        begin = time.perf_counter()
        runs = next(steps)
        spent += time.perf_counter() - begin
        if spent >= seconds * (len(rows) + 1) / _REPORTS:
            found = np.mean([rmse(fit, test, draw) for draw in range(1 if config.quick else 4)])
            rows.append({"seconds": round(spent, 1), "filter_runs": runs, "test_rmse": round(float(found), 3)})
    return rows


def cropped(batch: SceneBatch, start: int, frames: int) -> SceneBatch:
    """Return some frames of all recordings of a batch."""
    here = slice(start, start + frames)

    def cut(columns: Any) -> Any:
        return type(columns)(*(None if x is None else x[here] for x in columns))

    return batch._replace(start=batch.start + start, observations=cut(batch.observations), truth=cut(batch.truth))


if __name__ == "__main__":
    run(main, Config)
