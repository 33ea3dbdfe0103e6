"""What do simulated talkers' ways look like? Ten walks in each room of the papers, and the papers' own ways.

python -m experiments.walk_pictures --out docs/images/walks.png
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from experiments.command import run
from probtrack.plotting import check_picture
from probtrack.simulation import Motion, preset
from probtrack.simulation.trajectories import (
    GivenPaths,
    SocialForceWalk,
    fallon2006_way,
    klaassen2005_ways,
    lehmann2007_way,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RATE = 50.0  # Hz
ROOMS = {"lehmann2007": 1.51, "fallon2006": 1.6, "klaassen2005": 1.6}  # and the height of the mouths [m]
WAYS: dict[str, list[tuple[GivenPaths, int]]] = {
    "lehmann2007": [(lehmann2007_way(n), 1) for n in range(1, 6)],
    "fallon2006": [(fallon2006_way(n), 1) for n in range(1, 6)],
    "klaassen2005": [(klaassen2005_ways("arc"), 1), (klaassen2005_ways("crossing"), 2)],
}


@dataclass(frozen=True)
class Config:
    """Draw ten walks of 12 s in each room, and below the papers' ways."""

    seed: int = 0
    out: Path = Path("build/walks.png")


def main(config: Config) -> None:
    """Draw the picture and print how far the walks went."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    check_picture(config.out)
    figure, axes = plt.subplots(2, 3, figsize=(11, 8.6), layout="constrained")
    lengths = {}
    for (name, height), column in zip(ROOMS.items(), axes.T, strict=True):
        walks = _drawn(SocialForceWalk(height=height, height_std=0.0), name, 1, range(config.seed, config.seed + 10))
        way = torch.linalg.vector_norm(walks.velocity, dim=-1).sum(0) / RATE
        lengths[name] = [round(float(length), 1) for length in way.flatten()]
        _room(column[0], name, f"{name}: ten walks of 12 s")
        _draw(column[0], walks)
        _room(column[1], name, "its ways")
        for trajectories, talkers in WAYS[name]:
            _draw(column[1], _drawn(trajectories, name, talkers, [0]))
    figure.savefig(config.out, dpi=80)
    print(json.dumps({"metres_walked": lengths, "picture": str(config.out)}))


def _drawn(trajectories: SocialForceWalk | GivenPaths, name: str, talkers: int, seeds: range | list[int]) -> Motion:
    scene = preset(name)
    motion = trajectories.draw(
        seeds,
        num_talkers=talkers,
        duration=12.0,
        rate=RATE,
        region=scene.room.region,
        microphones=scene.load_array().positions,
    )
    return Motion(*(column.flatten(1, 2) for column in motion))


def _room(axis: "Axes", name: str, title: str) -> None:
    scene = preset(name)
    length, width, _ = scene.room.region.high
    axis.plot([0, length, length, 0, 0], [0, 0, width, width, 0], color="black", lw=1)
    place = scene.load_array().positions
    axis.plot(place[:, 0], place[:, 1], "o", mfc="white", mec="black", ms=5)
    axis.set(title=title, aspect="equal", xlabel="x [m]", ylabel="y [m]")


def _draw(axis: "Axes", motion: Motion) -> None:
    """Draw each way, a square where it begins and an arrow a second for where the mouth points."""
    for k in range(motion.mouth.shape[1]):
        x, y = motion.position[:, k, 0], motion.position[:, k, 1]
        (line,) = axis.plot(x, y, lw=1.2)
        axis.plot(x[0], y[0], "s", color=line.get_color(), ms=5)
        at = slice(None, None, round(RATE))
        mouth = motion.mouth[at, k]
        axis.quiver(
            x[at],
            y[at],
            mouth.cos(),
            mouth.sin(),
            color=line.get_color(),
            width=0.004,
            scale=25,
            headwidth=4,
            alpha=0.7,
        )


if __name__ == "__main__":
    run(main, Config)
