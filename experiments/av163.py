"""Does the tracker hold a real talker, whatever the seed? The AV16.3 recording, all models, 50 seeds: a study.

python -m experiments.av163 --workers 2
python -m experiments.av163 --num_particles '[75]' --keep_out '[0.0]' --learned false --name keep-out
python -m experiments.av163 --models '["CU-LAN"]' --vad_threshold '[2.0, 4.0, 8.0]' --learned false --name detector

There is no truth for this recording: what can be asked is whether azimuth runs smoothly while the talker speaks, how
many frames are locked, and whether seeds agree within the spread that each of them states.
"""

import os
import shutil
from dataclasses import dataclass
from math import pi
from pathlib import Path
from typing import Any, get_args

from experiments.command import run
from experiments.monte_carlo import done, trackers
from probtrack.dynamics import Lehmann2007Model
from probtrack.errors import InputError
from probtrack.evaluation import Scenes, Store, StudyFile
from probtrack.evaluation.tables import StudyTable, tabulate
from probtrack.geometry import shipped_arrays
from probtrack.trackers.lehmann2007 import Model, learned_models

RECORDING = "recordings/seq11-1p-0100_array1_8ch.flac"
SPEAKING = {"begin": 6.1, "end": 29.5}  # s: from half a second after the first word, when a track must be locked
BEFORE = {"begin": 0.0, "end": 5.5}  # s: chairs and clicks, but no word
NAMES = (
    "azimuth_jumps", "largest_jump", "locked", "azimuth_spread", "azimuth_disagreement", "position_spread",
    "position_disagreement",
)  # fmt: skip


@dataclass(frozen=True)
class Config:
    """Track the recording with each model and many seeds, beginning anywhere."""

    data_dir: Path = Path(os.environ.get("PROBTRACK_DATA", "../shared/data"))
    models: tuple[Model, ...] = get_args(Lehmann2007Model)
    learned: bool = True  # the models that have learned parameters with these too
    num_particles: tuple[int, ...] = (75, 500)
    keep_out: tuple[float, ...] = (0.2,)  # m
    vad_threshold: tuple[float, ...] = (8.0,)  # dB
    runs: int = 50
    workers: int = 2
    quick: bool = False  # two models, 75 particles, 4 runs
    name: str = "study"  # of the store
    out: Path = Path("build/av163")  # folder of the scene and of the store


def main(config: Config) -> StudyTable:
    """Do the study, print it and return its table."""
    models = config.models[:2] if config.quick else config.models
    compared = trackers(models, {}) | (trackers_learned(models) if config.learned else {})
    file = StudyFile(
        scenes=[Scenes(str(scene(config).resolve()))],
        trackers=compared,
        vary={
            "num_particles": [75] if config.quick else [*config.num_particles],
            "keep_out": [*config.keep_out],
            "vad_threshold": [*config.vad_threshold],
        },
        metrics=[
            *({"class_path": name, "init_args": SPEAKING} for name in NAMES),
            {"class_path": "azimuth_spread", "init_args": BEFORE, "name": "azimuth_spread_before"},
        ],
        runs=4 if config.quick else config.runs,
        start="anywhere",
    )
    with Store(
        done(file, config.out / f"{config.name}{'-quick' if config.quick else ''}.sqlite", config.workers)
    ) as store:
        table = tabulate(store, rows=["num_particles", "keep_out", "vad_threshold", "tracker"], over="runs")
    print(in_degrees(table))
    return table


def in_degrees(table: StudyTable) -> str:
    """Return the table in Markdown, a row a tracker, angles in degrees."""
    heads = [*table.rows[0], *(f"{name} [{'°' if unit == 'rad' else unit}]" for name, unit in table.metrics.items())]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for i, row in enumerate(table.rows):
        cells = [str(value) for value in row.values()]
        for j, unit in enumerate(table.metrics.values()):
            value, low, high = (
                x[i, 0, j] * (180 / pi if unit == "rad" else 1) for x in (table.value, table.low, table.high)
            )
            digits = 2 if unit == "m" else 1
            cells.append(f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def scene(config: Config) -> Path:
    """Return the scene folder of the recording, made if it is not there."""
    audio, folder = config.data_dir / RECORDING, config.out / "seq11-1p-0100"
    if not audio.is_file():
        raise InputError(f"{audio}: no such recording: --data_dir, or PROBTRACK_DATA, names the folder that holds it")
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(audio, folder / "audio.flac")
    shutil.copyfile(shipped_arrays()["av16.3-array1"], folder / "array.yaml")
    return folder


def trackers_learned(models: tuple[Model, ...]) -> dict[str, Any]:
    """Return the trackers with learned parameters, of the models that have some."""
    chosen = trackers([model for model in models if model in learned_models()], {"parameters": "learned"})
    return {f"{model}, learned": choice for model, choice in chosen.items()}


if __name__ == "__main__":
    run(main, Config)
