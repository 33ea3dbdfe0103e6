"""Do parameters learned from simulated recordings track better than those of S1's Table 1?

python -m experiments.fit_scenes --models '["CU-LAN", "CU-TCVE"]'

Training hears the data set `walks-training`: walks and voices in S1's room at four T60s and four signal-to-noise
ratios. Likelihood and front end are fitted first, at the true positions; then the tracker as a whole, with the
relocation that finds a lost talker again. The learned parameters are written to files, and compared with the printed
ones on data sets that training did not hear: other walks and voices, and another room.
"""

import dataclasses
import json
import logging
import time
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from lightning import Trainer

from experiments.command import run
from experiments.scene_scores import by_condition, scores
from probtrack.dynamics import Lehmann2007Model
from probtrack.filters import Adaptive, Relocation, StopGradient
from probtrack.filters.resampling import systematic
from probtrack.parameters import write_parameters
from probtrack.simulation import SceneFolder, default_cache, load_data_set, make_data_set, read_manifest, shipped_scenes
from probtrack.trackers import Tracker
from probtrack.training import (
    CloudLikelihood,
    Fit,
    Lehmann2007Settings,
    LikelihoodFit,
    SceneDataModule,
    SceneFit,
)

_WARM_UP = 100  # frames that voice activity hears before a crop
_TESTS = ("walks-test", "walks-elsewhere")


@dataclass(frozen=True)
class Config:
    """Learn from `walks-training`, test on `walks-test` and `walks-elsewhere`."""

    models: tuple[Lehmann2007Model, ...] = ("CU-LAN",)
    num_particles: int = 75
    likelihood_epochs: int = 3
    epochs: int = 5
    runs: int = 10  # of each recording in the tests
    data: Path = Path("build/fit_scenes/data")  # folder of the data sets, simulated if they are not there
    out: Path = Path("build/fit_scenes")  # folder of the learned parameters
    seed: int = 0
    quick: bool = False  # two scenes, one step and one run


def main(config: Config) -> dict[str, Any]:
    """Print and return the scores of printed and learned parameters, by model, data set and condition."""
    torch.set_num_threads(1)
    for noisy in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(noisy).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="lightning")
    config.out.mkdir(parents=True, exist_ok=True)
    begin = time.perf_counter()
    heard = fitted(LikelihoodFit(settings(config), warm_up=_WARM_UP), config.likelihood_epochs, config)
    result: dict[str, Any] = {"seconds": {"likelihood": round(time.perf_counter() - begin)}}
    for model in config.models:
        begin = time.perf_counter()
        fit = SceneFit(
            settings(config, model, Relocation(rate=1.0, share=0.1, sharpness=8.0)),
            CloudLikelihood(0.15, 0.02),
            warm_up=_WARM_UP,
            anywhere=0.5,
            learning_rate=0.03,
            seed=config.seed,
        )
        begin_with(fit.tracker, heard)
        learned = fitted(fit, config.epochs, config)
        result["seconds"][model] = round(time.perf_counter() - begin)
        made_by = {"command": "python -m experiments.fit_scenes", "model": model, "data": "walks-training"}
        write_parameters(config.out / f"{model}.yaml", learned, made_by | {"seed": config.seed})
        result[model] = compared(settings(config, model).make(), learned, config)
    print(json.dumps({"config": asdict(config) | {"data": str(config.data), "out": str(config.out)}, "result": result}))
    return result


def settings(
    config: Config, model: Lehmann2007Model = "CU-LAN", relocation: Relocation | None = None
) -> Lehmann2007Settings:
    """Return S1's tracker for the region of all scenes."""
    resample = Adaptive(StopGradient(systematic))
    return Lehmann2007Settings(
        low=(0.0, 0.0, 0.0),
        high=(3.5, 3.1, 2.2),
        model=model,
        num_particles=config.num_particles,
        relocation=relocation,
        resample=resample,
    )


def begin_with(tracker: Tracker, heard: Tracker) -> None:
    """Give a tracker the likelihood and the front end of another, with a smaller exponent.

    Frames follow each other closely and echoes last, so that what is right for one frame counts the same evidence
    several times over in a filter.
    """
    tracker.front_end.load_state_dict(heard.front_end.state_dict())
    with torch.no_grad():
        exponent = tracker.filter.likelihood.log_exponent
        exponent.copy_(heard.filter.likelihood.log_exponent - torch.tensor(2.0).log())


def fitted(fit: Fit, epochs: int, config: Config) -> Tracker:
    """Return the tracker of `fit` after its training."""
    folders = [str(folder.path) for folder in data_set("walks-training", config)]
    data = SceneDataModule(folders, audio=True, crop=250, batch_size=8, seed=config.seed)
    fit.schedule = lambda optimiser: torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(epochs, 1))
    trainer = Trainer(
        accelerator="cpu",
        max_epochs=1 if config.quick else epochs,
        gradient_clip_val=1.0,
        logger=False,
        enable_checkpointing=False,
        enable_model_summary=False,
        enable_progress_bar=False,
        default_root_dir=str(config.out),
    )
    trainer.fit(fit, data)
    return fit.tracker


def data_set(name: str, config: Config) -> list[SceneFolder]:
    """Return the recordings of a shipped data set, simulated if they are not there."""
    content = load_data_set(shipped_scenes()[name])
    if config.quick:
        content = dataclasses.replace(content, count=2, snr_db=content.snr_db[:1])
    folder = config.data / (f"{name}-quick" if config.quick else name)
    for _ in make_data_set(content, folder, default_cache()):
        pass
    return [SceneFolder(folder / row["folder"]) for row in read_manifest(folder)]


def compared(printed: Tracker, learned: Tracker, config: Config) -> dict[str, Any]:
    """Return the scores of two trackers on the data sets for tests."""
    result = {}
    for name in _TESTS:
        folders, runs = data_set(name, config), 1 if config.quick else config.runs
        found = {what: scores(tracker, folders, runs) for what, tracker in (("printed", printed), ("learned", learned))}
        result[name] = {what: by_condition(folders, value) for what, value in found.items()}
    return result


if __name__ == "__main__":
    run(main, Config)
