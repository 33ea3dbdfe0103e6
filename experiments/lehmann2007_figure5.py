"""S1's Figure 5 again: every motion model through a silence, the x estimate and the spread of its cloud.

python -m experiments.lehmann2007_figure5

A talker walks S1's drawn way and is silent from 3.0 to 4.5 s. 50 runs a model, 75 particles, 20 dB, begun around the
talker. Prints what each model makes of the gap, and draws x: the truth dotted, the mean of the estimates, and one
standard deviation of the clouds on both sides dashed.
"""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, get_args

import torch
from torch import Tensor

from experiments.command import run
from probtrack.dynamics import Lehmann2007Model
from probtrack.metrics import Talkers, position_error
from probtrack.simulation import SceneFolder, preset, save_scene
from probtrack.simulation.rooms import ResponseCache, default_cache
from probtrack.simulation.voices import GivenTurns
from probtrack.trackers import lehmann2007
from probtrack.tracks import Track

SILENCE = (3.0, 4.5)  # s


@dataclass(frozen=True)
class Config:
    """Track one recording 50 times with each of the ten models."""

    runs: int = 50
    num_particles: int = 75
    directivity: bool = True  # of the mouth; otherwise it is as loud in all directions
    quick: bool = False  # two models, 4 runs
    out: Path = Path("build/lehmann2007")  # folder of the recording and of the picture


def main(config: Config) -> dict[str, Any]:
    """Print and return the figures of each model, and draw all."""
    torch.set_num_threads(1)
    models = get_args(Lehmann2007Model)[: 2 if config.quick else None]
    folder = recording(config)
    tables = folder.truth
    assert tables is not None  # a simulated scene has one
    tracks = {model: tracked(folder, model, config) for model in models}
    truth = Talkers.of_tables(tables, next(iter(tracks.values())).time)
    assert truth.position is not None
    path = truth.position[:, 0, :2]
    result = {model: figures(track, path) for model, track in tracks.items()}
    draw(tracks, path, config.out / f"figure5{'-quick' if config.quick else ''}.png")
    print(json.dumps({"config": asdict(config) | {"out": str(config.out)}, "result": result}))
    return result


def recording(config: Config) -> SceneFolder:
    """Return the recording, simulated if it is not there."""
    folder = config.out / f"silence-{'directional' if config.directivity else 'omnidirectional'}"
    scene = replace(
        preset("lehmann2007"),
        turns=GivenTurns(((0, 0.1, SILENCE[0]), (0, SILENCE[1], 8.0))),
        directivity="speech" if config.directivity else "omnidirectional",
    )
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        save_scene(folder, scene, scene.simulate(ResponseCache(default_cache())))
    return SceneFolder(folder)


@torch.inference_mode()
def tracked(folder: SceneFolder, model: Lehmann2007Model, config: Config) -> Track:
    """Return the track of all runs."""
    region, tables = folder.region, folder.truth
    assert region is not None
    assert tables is not None
    position = tables[0].position
    assert position is not None
    tracker = lehmann2007(folder.array, region, model, num_particles=config.num_particles)
    runs = torch.arange(4 if config.quick else config.runs)
    return tracker(folder.open_recording().read(), runs, position[0, :2].float())


def figures(track: Track, path: Tensor) -> dict[str, float]:
    """Return what a model makes of the silence, of `track` (T, runs, 2) and the true `path` (T, 2)."""
    error = position_error(track.position.double(), path[:, None])
    spread = track.std.double().square().sum(-1).sqrt()
    last = int((track.time < SILENCE[1]).sum()) - 1
    first = int((track.time < SILENCE[0]).sum())
    walked = torch.linalg.vector_norm(path[last] - path[first])
    followed = (track.position[last] - track.position[first]).double() @ ((path[last] - path[first]) / walked)
    after = track.time >= SILENCE[1] + 1.0
    return {
        "error_before_m": round(float(error[first].mean()), 3),
        "error_at_the_end_of_the_silence_m": round(float(error[last].mean()), 3),
        "share_of_the_way_followed": round(float(followed.mean() / walked), 2),
        "spread_at_the_end_of_the_silence_m": round(float(spread[last].mean()), 3),
        "runs_back_within_10_cm_after_1_s_percentage": round(
            100 * float((error[after].mean(0) < 0.1).double().mean()), 1
        ),
    }


def draw(tracks: dict[Lehmann2007Model, Track], path: Tensor, to: Path) -> None:
    """Draw x over time, a panel a model, in the manner of S1's Figure 5."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 2.0 * ((len(tracks) + 1) // 2)), layout="constrained")
    axes = figure.subplots((len(tracks) + 1) // 2, 2, sharex=True, sharey=True, squeeze=False).ravel()
    for ax, (model, track) in zip(axes, tracks.items(), strict=False):
        mean, std = track.position[..., 0].mean(1), track.std[..., 0].mean(1)
        ax.axvspan(*SILENCE, color="0.92", linewidth=0)
        ax.plot(track.time, path[:, 0], ":", color="black", linewidth=1.2)
        ax.plot(track.time, mean, color="C0", linewidth=1.4)
        for side in (-1, 1):
            ax.plot(track.time, mean + side * std, "--", color="C0", linewidth=0.7)
        ax.set_title(model, fontsize=9, loc="left")
    for ax in axes[-2:]:
        ax.set_xlabel("time [s]")
    for ax in axes[::2]:
        ax.set_ylabel("x [m]")
    figure.savefig(to, dpi=130)


if __name__ == "__main__":
    run(main, Config)
