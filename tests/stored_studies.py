"""Stores of studies made by hand, with figures whose means are known."""

import itertools

import numpy as np

from probtrack.evaluation import CellScores, PlannedCell, PlannedScene, Store

SCENES = {
    "a": {"snr_db": 20, "t60": 0.27},
    "b": {"snr_db": 5, "t60": 0.27},
    "c": {"snr_db": 5, "t60": 0.27},
}
METRICS = (("rmse", "m"), ("track_loss", "%"))
RUNS = 4


def rmse(settings, scene, run):
    """Numerator and denominator: frames differ from scene to scene, so an average of averages is another figure."""
    frames = {"a": 10.0, "b": 20.0, "c": 60.0}.get(scene, 30.0)
    level = {"loud": 0.1, "soft": 0.3}.get(settings["tracker"], 0.2)
    return frames * (level + {"a": 0.0, "b": 0.02, "c": 0.05}.get(scene, 0.01) + 0.001 * run), frames


def track_loss(settings, _scene, run):
    lost = settings["tracker"] == "soft" and run == 0
    return float(lost), 1.0


def write_study(
    path,
    *,
    trackers=("soft", "loud"),
    vary=None,
    scenes=SCENES,
    runs=RUNS,
    metrics=METRICS,
    scores=(rmse, track_loss),
    finished=None,
    failure=None,
    first_seed=100,
    fingerprint="f",
    config=None,
):
    """Write a store of which the first `finished` cells are done, all by default, and the next failed, if it did."""
    names = list(vary or {})
    combinations = itertools.product(trackers, *(vary or {}).values())
    settings = [dict(zip(["tracker", *names], values, strict=True)) for values in combinations]
    planned = [
        PlannedScene(name, f"{fingerprint} of {name}", conditions, range(first_seed, first_seed + runs))
        for name, conditions in scenes.items()
    ]
    cells = [PlannedCell(f"{one} on {scene}", scene, one, runs) for scene in scenes for one in settings]
    with Store.create(path, config or {}, planned, metrics, cells) as store:
        done = len(cells) if finished is None else finished
        for number, cell in enumerate(cells[:done], start=1):
            save(store, number, cell.settings, cell.scene, runs, scores)
        if failure is not None:
            store.give_up(done + 1, failure)
    return path


def save(store, number, settings, scene, runs=RUNS, scores=(rmse, track_loss)):
    pairs = np.array([[score(settings, scene, run) for run in range(runs)] for score in scores])
    store.save(number, CellScores(pairs[..., 0], pairs[..., 1], seconds=0.5 * runs, duration=2.0))
