"""Does the tracker hold a real talker, whatever the seed? The AV16.3 recording, six models, many seeds.

python -m experiments.av163 --num_particles 500
python -m experiments.av163 --num_particles 75 --keep_out 0

There is no truth for this recording: what can be asked is whether azimuth runs smoothly while the talker speaks,
whether the cloud stays spread before, and whether seeds agree within the spread that each of them states.
"""

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from experiments.command import run
from probtrack.audio import Recording
from probtrack.geometry import MicrophoneArray, Region, shipped_arrays, wrap_angle
from probtrack.trackers import lehmann2007
from probtrack.trackers.lehmann2007 import Model

MODELS: tuple[Model, ...] = ("CU-LAN", "CU-LAN-ORIG", "CU-RWVE", "CU-TCVE", "CU-TCAC", "CL-RWVE-RAAC")  # of S1 Table 2
FIRST_WORD, LAST_WORD, LOCKED = 5.6, 29.5, 6.1  # s; half a second after the first word the track must be locked


@dataclass(frozen=True)
class Config:
    """Track the recording with each model of S1's Table 2 and many seeds."""

    data_dir: Path = Path(os.environ.get("PROBTRACK_DATA", "../shared/data"))
    runs: int = 50
    num_particles: int = 500
    keep_out: float = 0.2  # m
    models: tuple[Model, ...] = MODELS
    parameters: str = "printed"  # or learned, or a file


def main(config: Config) -> dict[str, Any]:
    """Print and return figures of each model, angles in degrees and lengths in metres."""
    torch.set_num_threads(1)
    samples = Recording.open(config.data_dir / "recordings/seq11-1p-0100_array1_8ch.flac").read()
    result: dict[str, Any] = {model: run_model(model, samples, config) for model in config.models}
    print(json.dumps({"config": {**asdict(config), "data_dir": config.data_dir.name}, "result": result}))
    return result


@torch.inference_mode()
def run_model(model: Model, samples: torch.Tensor, config: Config) -> dict[str, float]:
    """Track with all seeds at once."""
    path = shipped_arrays()["av16.3-array1"]
    region = Region.from_yaml(path)
    assert region is not None  # the shipped file has one
    tracker = lehmann2007(
        MicrophoneArray.from_yaml(path),
        region,
        model,
        parameters=config.parameters,
        num_particles=config.num_particles,
        keep_out=config.keep_out,
    )
    track = tracker(samples, torch.arange(config.runs))
    assert track.azimuth is not None  # the tracker knows the array's centre
    assert track.std_azimuth is not None
    before = track.time < FIRST_WORD - 0.1
    speaking = (track.time > LOCKED) & (track.time < LAST_WORD)
    azimuth, position = track.azimuth[speaking], track.position[speaking]
    jumps = wrap_angle(azimuth.diff(dim=0)).abs().rad2deg().amax(0)
    resultant = torch.stack([azimuth.cos(), azimuth.sin()], -1).mean(1).norm(dim=-1)
    figures = {
        "seeds_with_a_jump_over_15": float((jumps > 15).sum()),
        "largest_jump_median": float(jumps.median()),
        "largest_jump_worst": float(jumps.max()),
        "smallest_std_before_the_first_word": float(track.std[before].min()),
        "azimuth_std_of_a_run": float(track.std_azimuth[speaking].square().mean().sqrt().rad2deg()),
        "azimuth_std_between_runs": float((-2 * resultant.log()).clamp_min(0).sqrt().mean().rad2deg()),
        "position_std_of_a_run": float(track.std[speaking].square().sum(-1).mean().sqrt()),
        "position_std_between_runs": float(position.var(1).sum(-1).mean().sqrt()),
    }
    return {name: round(value, 2) for name, value in figures.items()}


if __name__ == "__main__":
    run(main, Config)
