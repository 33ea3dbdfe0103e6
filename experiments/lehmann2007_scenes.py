"""Does S1's Table 2 come out in simulated rooms? Five scenes at each T60, every motion model.

python -m experiments.lehmann2007_scenes --runs 60

S1 averages over five recordings of its own room, 60 runs each; here are five ways through a simulated one, with five
talkers.
"""

import dataclasses
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from experiments.command import run
from probtrack.errors import InputError
from probtrack.metrics import position_error, root_mean_square, track_lost
from probtrack.simulation import DataSet, SceneFolder, default_cache, make_data_set, preset
from probtrack.simulation.trajectories import lehmann2007_way
from probtrack.simulation.voices import GivenTurns, RecordedVoices, SyntheticVoices, TurnTaking
from probtrack.trackers import lehmann2007
from probtrack.trackers.lehmann2007 import Model

S1_TABLE_2: dict[str, dict[str, tuple[float, float]]] = {
    "0.27": {
        "CU-LAN-ORIG": (0.068, 4.6), "CU-LAN": (0.027, 0.0), "CU-RWVE": (0.033, 1.2), "CU-TCVE": (0.036, 5.8),
        "CU-TCAC": (0.028, 0.8), "CL-RWVE-RAAC": (0.039, 12.5),
    },
    "0.34": {
        "CU-LAN-ORIG": (0.100, 33.3), "CU-LAN": (0.045, 19.3), "CU-RWVE": (0.059, 19.7), "CU-TCVE": (0.070, 22.0),
        "CU-TCAC": (0.049, 11.3), "CL-RWVE-RAAC": (0.106, 43.7),
    },
}  # fmt: skip
"""RMSE [m] and track loss [%] at 20 dB, by T60 [s] and model: those that S1 judged fit."""

PRESETS = {"0.27": "lehmann2007", "0.34": "lehmann2007-t60-0.34"}


@dataclass(frozen=True)
class Config:
    """Track five scenes at both T60s with each model, from around the talker's first position, as S1 does."""

    runs: int = 60
    models: tuple[Model, ...] = get_args(Model)
    t60: tuple[Literal["0.27", "0.34"], ...] = ("0.27", "0.34")
    num_particles: int = 75
    exponent: float = 2.0
    parameters: str = "printed"  # or learned, or a file
    directivity: bool = True  # of the mouth; otherwise it is as loud in all directions
    pauses: bool = True  # otherwise the talker speaks throughout
    speech: str | None = None  # folder of recorded talkers; synthetic ones by default
    scenes: int = 5
    seed: int = 0
    out: Path = Path("build/lehmann2007_scenes")  # folder of the scenes, simulated if they are not there


def main(config: Config) -> dict[str, Any]:
    """Return mean RMSE [m] and track loss [%] of each model at each T60, beside S1's."""
    if not 1 <= config.scenes <= 5:
        raise InputError(f"scenes must be from 1 to 5, S1's ways, got {config.scenes}")
    torch.set_num_threads(1)
    result: dict[str, Any] = {}
    for t60 in config.t60:
        folders = simulated(PRESETS[t60], config)
        result[t60] = {model: figures(folders, model, S1_TABLE_2[t60].get(model), config) for model in config.models}
    settings = {key: str(value) if isinstance(value, Path) else value for key, value in asdict(config).items()}
    print(json.dumps({"config": settings, "result": result}))
    return result


def figures(
    folders: list[SceneFolder], model: Model, printed: tuple[float, float] | None, config: Config
) -> dict[str, Any]:
    """Return what is reported of a model, beside what S1 has `printed`."""
    error, lost = tracked(folders, model, config)
    row: dict[str, Any] = {
        "mean_rmse": round(float(error.mean()), 4),
        "median_rmse": round(float(error.median()), 4),
        "track_loss_percentage": round(100 * float(lost.double().mean()), 1),
        "rmse_by_scene": [round(float(x), 4) for x in error.mean(-1)],
    }
    return row if printed is None else row | {"s1_mean_rmse": printed[0], "s1_track_loss_percentage": printed[1]}


def simulated(name: str, config: Config) -> list[SceneFolder]:
    """Return the folders of the five scenes in a room, simulated if they are not there."""
    base = dataclasses.replace(
        preset(name),
        voices=SyntheticVoices() if config.speech is None else RecordedVoices(config.speech),
        turns=TurnTaking() if config.pauses else GivenTurns(((0, 0.2, 8.0),)),
        directivity="speech" if config.directivity else "omnidirectional",
    )
    ways = [dataclasses.replace(base, trajectories=lehmann2007_way(n)) for n in range(1, config.scenes + 1)]
    data_set = DataSet(tuple(ways), count=len(ways), seed=config.seed)
    kind = [
        "directional" if config.directivity else "omnidirectional",
        "pauses" if config.pauses else "no-pauses",
        "synthetic" if config.speech is None else "recorded",
    ]
    folder = config.out / "-".join([name, *kind, str(config.scenes), str(config.seed)])
    for _ in make_data_set(data_set, folder, default_cache(), workers=os.cpu_count() or 1):
        pass
    return [SceneFolder(folder / row) for index in range(data_set.count) for row in data_set.recordings(index)]


@torch.no_grad()
def tracked(folders: list[SceneFolder], model: Model, config: Config) -> tuple[Tensor, Tensor]:
    """Return RMSE [m] and track loss of every run of every scene, (scenes, runs)."""
    errors, losses = [], []
    for folder in folders:
        region, truth = folder.region, folder.truth
        assert region is not None  # a scene has the room and the truth
        assert truth is not None
        tracker = lehmann2007(
            folder.array,
            region,
            model,
            parameters=config.parameters,
            num_particles=config.num_particles,
            exponent=config.exponent,
        )
        position = truth[0].position
        assert position is not None
        track = tracker(folder.open_recording().read(), torch.arange(config.runs), position[0, :2].float())
        frames = min(len(position), track.num_frames)
        error = position_error(track.position[:frames].double(), position[:frames, None, :2])  # (T, runs)
        errors.append(root_mean_square(error))
        losses.append(track_lost(error, tracker.dt))
    return torch.stack(errors), torch.stack(losses)


if __name__ == "__main__":
    run(main, Config)
