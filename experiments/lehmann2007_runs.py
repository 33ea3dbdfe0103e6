"""How much does the motion model matter when a talker pauses? S1's question, on the demo's scene.

python -m experiments.lehmann2007_runs --runs 50

S1 Table 2 (20 dB, T60 0.27 s) averages over five recordings of its own room; one simulated scene can show the
order of the models and the size of the gain, not the same numbers.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

import torch

from experiments.command import run
from probtrack.audio import Recording
from probtrack.geometry import MicrophoneArray, Region
from probtrack.metrics import position_error, root_mean_square, track_lost
from probtrack.simulation import ResponseCache, default_cache, demo_scene, save_scene
from probtrack.track_files import read_track
from probtrack.trackers import lehmann2007
from probtrack.trackers.lehmann2007 import Model

S1_TABLE_2 = {
    "CU-LAN-ORIG": (0.068, 4.6), "CU-LAN": (0.027, 0.0), "CU-RWVE": (0.033, 1.2), "CU-TCVE": (0.036, 5.8),
    "CU-TCAC": (0.028, 0.8), "CL-RWVE-RAAC": (0.039, 12.5),
}  # fmt: skip
"""RMSE [m] and track loss [%] at 20 dB and T60 0.27 s, of the models that S1 judged fit for it."""


@dataclass(frozen=True)
class Config:
    """Track one scene many times with each model, from around the talker's first position, as S1 does."""

    runs: int = 50
    num_particles: int = 75
    scene_seed: int = 0
    out: Path = Path("build/lehmann2007_runs")  # folder of the scene, simulated if it is not there


def main(config: Config) -> dict[str, Any]:
    """Return median and mean RMSE [m] and track loss [%] of each model."""
    torch.set_num_threads(1)
    folder = config.out / f"scene-{config.scene_seed}"
    if not (folder / "truth.csv").exists():
        scene = demo_scene(config.scene_seed)
        save_scene(folder, scene, scene.simulate(ResponseCache(default_cache())))
    result = {model: run_model(model, folder, config) for model in get_args(Model)}
    settings = {name: str(value) if isinstance(value, Path) else value for name, value in asdict(config).items()}
    print(json.dumps({"config": settings, "result": result}))
    return result


@torch.no_grad()
def run_model(model: Model, folder: Path, config: Config) -> dict[str, float | None]:
    """Track the scene in `folder` with every seed at once."""
    path = folder / "array.yaml"
    region = Region.from_yaml(path)
    assert region is not None  # a scene's array file has the room
    tracker = lehmann2007(MicrophoneArray.from_yaml(path), region, model, num_particles=config.num_particles)
    truth = read_track(folder / "truth.csv").position
    assert truth is not None
    start = truth[0, :2].float()
    track = tracker(Recording.open(folder / "audio.wav").read(), torch.arange(config.runs), start)
    frames = min(len(truth), track.num_frames)
    error = position_error(track.position[:frames].double(), truth[:frames, None, :2])  # (T, runs)
    rmse, lost = root_mean_square(error), track_lost(error, tracker.dt)
    s1_rmse, s1_loss = S1_TABLE_2.get(model, (None, None))
    return {
        "median_rmse": round(float(rmse.median()), 4),
        "mean_rmse": round(float(rmse.mean()), 4),
        "track_loss_percentage": round(100 * float(lost.double().mean()), 1),
        "s1_rmse": s1_rmse,
        "s1_track_loss_percentage": s1_loss,
    }


if __name__ == "__main__":
    run(main, Config)
