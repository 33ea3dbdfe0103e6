"""A study of an experiment: planned, done or gone on with, and kept."""

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from probtrack.cli.evaluate import said
from probtrack.errors import InputError
from probtrack.evaluation import Progress, Store, StudyFile, compare, evaluate, plan
from probtrack.evaluation.pairing import Side
from probtrack.metrics.bootstrap import Over

METRICS = ["rmse", "track_loss", "mstd", "coverage_90", "nees", "azimuth_rmse"]
"""What experiments judge by: S1's two figures, and whether the spread that a track states is true."""

_EVERY = 30.0  # s between two lines of progress


def trackers(models: Sequence[str], settings: dict[str, Any]) -> dict[str, Any]:
    """Return the trackers of a study file, one a motion model and called like it, all with the same `settings`."""
    return {model: {"class_path": "lehmann2007", "init_args": {"model": model, **settings}} for model in models}


def done(file: StudyFile, store: Path, workers: int) -> Path:
    """Do what is not yet done of a study, tell of it on standard error, and return its store."""
    store.parent.mkdir(parents=True, exist_ok=True)
    told = [time.monotonic()]

    def tell(progress: Progress) -> None:
        if time.monotonic() - told[0] > _EVERY or progress.done == progress.cells:
            told[0] = time.monotonic()
            print(f"{store}: {said(progress)}", file=sys.stderr, flush=True)

    last = evaluate(plan(file, Path.cwd()), store, workers=workers, on_progress=tell)
    if last.done < last.cells:
        raise InputError(f"{store}: {said(last)}{f', the first: {last.failure}' if last.failure else ''}")
    return store


def differences(store: Store, first: str, others: Sequence[str], over: Over) -> str:
    """Return how far one tracker is above others in RMSE and track loss, with p-values adjusted for the two."""
    lines = [f"| {first} less | RMSE [m] | p | track loss [%] | p |", "|---|---|---|---|---|"]
    for other in others:
        sides = Side(store, [f"tracker={first}"], first), Side(store, [f"tracker={other}"], other)
        found = compare(*sides, metrics=["rmse", "track_loss"], over=over)
        cells = [other]
        for j, digits in enumerate((3, 1)):
            ends = f"[{found.low[0, j]:+.{digits}f}, {found.high[0, j]:+.{digits}f}]"
            cells += [f"{found.difference[0, j]:+.{digits}f} {ends}", f"{found.adjusted[0, j]:.2g}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
