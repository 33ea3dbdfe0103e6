"""How fine must the grid of responses be? What a tracker sees of the same scenes on grids of several spacings.

python -m experiments.response_grid

Reflections come from the nearest point of a grid, the direct sound from where the talker is. If that matters to
localisation, it must show in the steered power: in its value at the talker, over its mean in the room, and in how
often its maximum is near the talker.
"""

import dataclasses
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from experiments.command import run
from probtrack.simulation import DataSet, SceneFolder, default_cache, make_data_set, preset
from probtrack.simulation.rooms import ShoeboxRoom
from probtrack.simulation.trajectories import lehmann2007_way
from probtrack.trackers import lehmann2007

NEAR = 0.3  # m


@dataclass(frozen=True)
class Config:
    """Simulate S1's five ways on each grid and look at the steered power of frames with speech."""

    spacings: tuple[float, ...] = (0.025, 0.05, 0.1, 0.2, 0.4)
    scenes: int = 5
    duration: float = 8.0
    t60: float = 0.27
    out: Path = Path("build/response_grid")


def main(config: Config) -> dict[str, Any]:
    """Return for each spacing [m] the contrast of the steered power [dB] and the share of frames localised [%]."""
    torch.set_num_threads(1)
    result = {f"{spacing:g}": seen(spacing, config) for spacing in config.spacings}
    settings = {key: str(value) if isinstance(value, Path) else value for key, value in asdict(config).items()}
    print(json.dumps({"config": settings, "result": result}))
    return result


def seen(spacing: float, config: Config) -> dict[str, float]:
    """Return what the steered power says of the scenes on a grid of `spacing` [m]."""
    base = preset("lehmann2007")
    assert isinstance(base.room, ShoeboxRoom)
    room = dataclasses.replace(base.room, spacing=spacing, t60=config.t60)
    scenes = [
        dataclasses.replace(base, room=room, duration=config.duration, trajectories=lehmann2007_way(n))
        for n in range(1, config.scenes + 1)
    ]
    data_set = DataSet(tuple(scenes), count=len(scenes))
    folder = config.out / f"{spacing:g}-{config.scenes}-{config.duration:g}-{config.t60:g}"
    for _ in make_data_set(data_set, folder, default_cache(), workers=os.cpu_count() or 1):
        pass
    frames = [_frames(SceneFolder(folder / name)) for i in range(data_set.count) for name in data_set.recordings(i)]
    contrast, near = (torch.cat(column) for column in zip(*frames, strict=True))
    return {
        "contrast_db": round(float(contrast.mean()), 3),
        "contrast_std_db": round(float(contrast.std()), 3),
        "localised_percent": round(100 * float(near.double().mean()), 2),
        "frames": len(near),
    }


@torch.no_grad()
def _frames(folder: SceneFolder) -> tuple[torch.Tensor, torch.Tensor]:
    """Return of each frame with speech the power at the talker over its mean [dB], and whether the maximum is near."""
    region, truth = folder.region, folder.truth
    assert region is not None
    assert truth is not None
    position, speech = truth[0].position, truth[0].get("speech")
    assert position is not None
    assert speech is not None
    tracker = lehmann2007(folder.array, region)
    observations = tracker.front_end(folder.open_recording().read())
    count = min(len(position), len(observations.gcc))
    talks = speech[:count] > 0
    gcc, place = observations.gcc[:count][talks], position[:count][talks, :2].float()
    power = tracker.filter.likelihood.power
    grid = region.plane().grid(3000)
    everywhere = torch.cat([power.at(grid)(part) for part in gcc.split(50)])
    there = power(gcc, place[:, None, :])[:, 0]
    best = grid[everywhere.argmax(-1)]
    contrast = 10 * torch.log10(there.clamp(min=1e-9) / everywhere.clamp(min=0).mean(-1))
    return contrast, torch.linalg.vector_norm(best - place, dim=-1) < NEAR


if __name__ == "__main__":
    run(main, Config)
