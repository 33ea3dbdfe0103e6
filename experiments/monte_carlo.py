"""A study of an experiment: planned, done or gone on with, and kept."""

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from probtrack.cli.evaluate import said
from probtrack.evaluation import Progress, StudyFile, evaluate, plan

METRICS = ["rmse", "track_loss", "mstd", "coverage_90", "nees", "azimuth_rmse"]
"""What experiments judge by: S1's two figures, and whether the spread that a track states is true."""

_EVERY = 30.0  # s between two lines of progress


def trackers(models: Sequence[str], **settings: Any) -> dict[str, Any]:
    """Return the trackers of a study file, one a motion model and called like it."""
    return {
        model: {"class_path": "lehmann2007", "init_args": {"model": model, "num_particles": 75, **settings}}
        for model in models
    }


def done(file: StudyFile, store: Path, workers: int) -> Path:
    """Do what is not yet done of a study, tell of it on standard error, and return its store."""
    store.parent.mkdir(parents=True, exist_ok=True)
    last = [time.monotonic()]

    def tell(progress: Progress) -> None:
        if time.monotonic() - last[0] > _EVERY or progress.done == progress.cells:
            last[0] = time.monotonic()
            print(f"{store}: {said(progress)}", file=sys.stderr, flush=True)

    evaluate(plan(file, Path.cwd()), store, workers=workers, on_progress=tell)
    return store
