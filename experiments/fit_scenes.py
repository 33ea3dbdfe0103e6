"""What parameters does S1's tracker learn from simulated recordings?

python -m experiments.fit_scenes --models '["CU-LAN", "CU-TCVE"]'

Training hears the data set `walks-training`: walks and voices in S1's room at four T60s and four signal-to-noise
ratios. Likelihood and front end are fitted first, at the true positions; then the tracker as a whole, with the
relocation that finds a lost talker again. The learned parameters are written to a file a model; those that ship with
probtrack were made so, and `learned_scenes` compares them with the printed ones.
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
from probtrack import __version__
from probtrack.dynamics import Lehmann2007Model
from probtrack.filters import Adaptive, Relocation, StopGradient
from probtrack.filters.resampling import systematic
from probtrack.parameters import physical_summary, write_parameters
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


@dataclass(frozen=True)
class Config:
    """Learn from `walks-training`."""

    models: tuple[Lehmann2007Model, ...] = ("CU-LAN",)
    num_particles: int = 75
    likelihood_epochs: int = 3
    epochs: int = 5
    data: Path = Path("build/fit_scenes/data")  # folder of the data set, simulated if it is not there
    out: Path = Path("build/fit_scenes")  # folder of the learned parameters
    seed: int = 0
    quick: bool = False  # two recordings and one step


def main(config: Config) -> dict[str, Any]:
    """Print and return the learned values, single numbers by name, of each model, and how long learning took."""
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
            settings(config, model, first_relocation()),
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
        chosen = {"num_particles", "likelihood_epochs", "epochs", "seed"}
        made_by |= {key: value for key, value in asdict(config).items() if key in chosen}
        write_parameters(config.out / f"{model}.yaml", learned, made_by | {"probtrack": __version__})
        result[model] = {name: float(f"{value:.4g}") for name, value in physical_summary(learned).items()}
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
    folders = [str(folder.path) for folder in data_set("walks-training", config.data, quick=config.quick)]
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


def first_relocation() -> Relocation:
    """Return the relocation that training begins with."""
    return Relocation(rate=1.0, share=0.1, sharpness=8.0)


def data_set(name: str, data: Path, *, quick: bool) -> list[SceneFolder]:
    """Return the recordings of a shipped data set, simulated if they are not there; two of them if `quick`."""
    content = load_data_set(shipped_scenes()[name])
    if quick:
        content = dataclasses.replace(content, count=2, snr_db=content.snr_db[:1])
    folder = data / (f"{name}-quick" if quick else name)
    for _ in make_data_set(content, folder, default_cache()):
        pass
    return [SceneFolder(folder / row["folder"]) for row in read_manifest(folder)]


if __name__ == "__main__":
    run(main, Config)
