"""Do the learned parameters that ship with probtrack track better than those of S1's Table 1?

python -m experiments.learned_scenes

Printed values, printed values with a relocation as training began with, and learned ones, on data sets that training
did not hear: other walks and voices in S1's room, and a larger room with more reverberation, other levels and noise
from all around.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from experiments.command import run
from experiments.fit_scenes import data_set, first_relocation
from experiments.scene_scores import by_condition, scores
from probtrack.dynamics import Lehmann2007Model
from probtrack.simulation import SceneFolder
from probtrack.trackers import Tracker, lehmann2007


@dataclass(frozen=True)
class Config:
    """Compare on `walks-test` and `walks-elsewhere`."""

    models: tuple[Lehmann2007Model, ...] = ("CU-LAN", "CU-TCVE")
    num_particles: int = 75
    runs: int = 4  # of each recording
    data: Path = Path("build/fit_scenes/data")  # folder of the data sets, simulated if they are not there
    quick: bool = False  # two recordings, one run


def main(config: Config) -> dict[str, Any]:
    """Print and return the scores by model, data set and condition."""
    torch.set_num_threads(1)
    result: dict[str, Any] = {}
    for model in config.models:
        result[model] = {}
        for name in ("walks-test", "walks-elsewhere"):
            folders = data_set(name, config.data, quick=config.quick)
            result[model][name] = {
                what: by_condition(folders, scores(tracker, folders, 1 if config.quick else config.runs))
                for what, tracker in trackers(model, folders, config.num_particles).items()
            }
    print(json.dumps({"config": asdict(config) | {"data": str(config.data)}, "result": result}))
    return result


def trackers(model: Lehmann2007Model, folders: Sequence[SceneFolder], num_particles: int) -> dict[str, Tracker]:
    """Return the trackers that are compared, for the room of a data set."""
    array, region = folders[0].array, folders[0].region
    assert region is not None  # a simulated scene has its room
    printed, relocating, learned = (
        lehmann2007(array, region, model, num_particles=num_particles, parameters=parameters)
        for parameters in ("printed", "printed", "learned")
    )
    relocating.filter.relocation = first_relocation()
    return {"printed": printed, "printed, relocating": relocating, "learned": learned}


if __name__ == "__main__":
    run(main, Config)
