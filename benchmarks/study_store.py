"""A store of a million scores: read and tabulated by the command, from Python's start to the last line.

The store is made from seeded noise: 48 settings on 200 recordings, 52 runs each, two metrics. One process without
probtrack that imports numpy and rich is the floor.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.pairs import Row, spread
from benchmarks.processes import probtrack
from probtrack.evaluation import CellScores, PlannedCell, PlannedScene, Store

SCENES, RUNS = 200, 52
PARTICLES = (25, 50, 75, 100, 200, 500, 1000, 2000)
TRACKERS = ("CU-LAN-ORIG", "CU-LAN", "CU-RWVE", "CU-TCVE", "CU-TCAC", "CL-RWVE-RAAC")
METRICS = (("rmse", "m"), ("track_loss", "%"))


def run(quick: bool = False) -> list[Row]:
    """Measure the table on all of it, the export, and the growth with the number of scores."""
    repeats = 3 if quick else 7
    with tempfile.TemporaryDirectory() as folder:
        store, runs = Path(folder) / "study.sqlite", Path(folder) / "runs.parquet"
        scores = write(store)
        floor = spread(_seconds(_imports, repeats))
        show = spread(_seconds(lambda: probtrack("study", "show", str(store)), repeats))
        export = spread(_seconds(lambda: probtrack("study", "export", str(store), "-o", str(runs)), repeats))
    against = f"imports alone: {floor.median:.2f} s"
    return [
        Row(f"probtrack study show, {scores:.3g} scores", show, 2.0, unit="s", against=against),
        Row("probtrack study export to Parquet", export, None, unit="s"),
    ]


def write(path: Path) -> int:
    """Write the store; returns how many scores it has."""
    conditions = [{"snr_db": 5.0 * (1 + i % 4), "t60": (0.27, 0.34)[i // 4 % 2]} for i in range(SCENES)]
    scenes = [PlannedScene(f"{i:03d}", str(i), these, range(RUNS)) for i, these in enumerate(conditions)]
    settings = [{"tracker": tracker, "num_particles": n} for tracker in TRACKERS for n in PARTICLES]
    cells = [PlannedCell(f"{one} on {scene.name}", scene.name, one, RUNS) for scene in scenes for one in settings]
    generator = np.random.default_rng(0)
    with Store.create(path, {}, scenes, METRICS, cells) as store:
        for number in range(1, len(cells) + 1):
            rmse, lost = generator.gamma(2.0, 0.05, RUNS), generator.random(RUNS) < 0.1
            store.save(number, CellScores(np.stack([rmse, lost]), np.ones((2, RUNS)), seconds=3.0, duration=8.0))
    return len(cells) * RUNS * len(METRICS)


def _imports() -> None:
    command: Sequence[str] = (sys.executable, "-c", "import numpy, sqlite3, rich.table, rich.console")
    subprocess.run(command, check=True)


def _seconds(work: Callable[[], object], repeats: int) -> list[float]:
    """Return wall times; the first, which fills the disk cache, does not count."""
    times = []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return times[1:]
