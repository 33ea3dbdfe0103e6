"""A small study: recordings of a loud point, a study file of them, and what a store holds, to compare."""

import numpy as np
import soundfile
import yaml
from scenes import ROOM, noise_from

from probtrack.evaluation import Store
from probtrack.geometry import MicrophoneArray

POSITIONS = [[0.6, 0.4, 1.3], [1.4, 0.4, 1.3], [3.0, 1.2, 1.3], [2.1, 2.7, 1.3], [0.5, 1.9, 1.3]]
POINTS = {"near": (2.4, 1.1, 1.3), "far": (1.1, 2.2, 1.3)}
STUDY = {
    "scenes": ["near", {"path": "far", "conditions": {"room": "hall"}}],
    "trackers": {
        "A": "lehmann2007",
        "B": {"class_path": "lehmann2007", "init_args": {"model": "CU-TCVE", "resample": "stratified"}},
    },
    "vary": {"num_particles": [40, 65]},
    "metrics": ["rmse", {"class_path": "track_loss", "init_args": {"threshold": 0.3}, "name": "far_off"}],
    "runs": 3,
    "seed": 5,
}
CELLS = 8  # 2 recordings, 2 trackers, 2 numbers of particles


def write_recordings(folder, seconds=0.7):
    """Write the two scene folders of a study."""
    for name, point in POINTS.items():
        write_recording(folder / name, point, seconds)


def write_recording(folder, point, seconds=0.7, truth="time,x,y"):
    """Write a scene folder of a loud point, whose truth has two rows."""
    folder.mkdir()
    array = MicrophoneArray(POSITIONS, "five")
    array.to_yaml(folder / "array.yaml", ROOM)
    soundfile.write(folder / "audio.wav", noise_from(point, array, seconds, 0.1).t().numpy(), 16_000, subtype="FLOAT")
    values = dict(zip(("x", "y", "azimuth"), (*point[:2], 0.3), strict=True))
    columns = truth.split(",")[1:]
    rows = [[time, *(values[name] for name in columns)] for time in (0.0, seconds)]
    (folder / "truth.csv").write_text("\n".join([truth, *(",".join(map(str, row)) for row in rows)]) + "\n")


def write_study(folder, **changes):
    """Write a study file of the recordings in `folder`, and return its path as text."""
    (folder / "study.yaml").write_text(yaml.safe_dump({**STUDY, **changes}, sort_keys=False))
    return str(folder / "study.yaml")


def numbers(path):
    """Return what a store holds: the scores of each metric by cell and run."""
    with Store(path) as store:
        keys = {cell.id: cell.key for cell in store.cells}
        rows = {}
        for metric in store.metrics:
            for cell, run, total, count in zip(*store.scores(metric), strict=True):
                rows[metric, keys[cell], int(run)] = float(total), float(count)
        return rows


def failures(path):
    """Return what went wrong with cells, by their keys."""
    with Store(path) as store:
        return {cell.key: cell.failure for cell in store.cells if cell.failure}


def claimed(path):
    """Return the numbers of cells that a process holds."""
    import sqlite3
    from contextlib import closing

    with closing(sqlite3.connect(path)) as db:
        return [cell for (cell,) in db.execute("SELECT id FROM cell WHERE pid IS NOT NULL")]


def same(first, second):
    """Whether two stores hold the very same figures of all cells."""
    return first == second and len(first) == CELLS * 3 * 2 and np.isfinite(list(first.values())).all()
