"""A new store, which is there whole or not at all."""

import json
import os
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from probtrack.evaluation.database import BESIDE, FORMAT, TABLES, checksum_of, connected, in_one_line, plan_checksum
from probtrack.evaluation.processes import started
from probtrack.evaluation.records import PlannedCell, PlannedScene


def create(
    path: Path,
    config: dict[str, Any],
    scenes: Sequence[PlannedScene],
    metrics: Sequence[tuple[str, str]],
    cells: Sequence[PlannedCell],
) -> None:
    """Make a store of `scenes`, `metrics` by name and unit, and `cells`, unless another process made it meanwhile."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    _forget_ended(path)
    unfinished.unlink(missing_ok=True)
    try:
        with in_one_line(path):
            _write(unfinished, config, scenes, metrics, cells)
            _put(unfinished, path)
    finally:
        for end in ("", *BESIDE):
            unfinished.with_name(unfinished.name + end).unlink(missing_ok=True)


def _write(
    path: Path,
    config: dict[str, Any],
    scenes: Sequence[PlannedScene],
    metrics: Sequence[tuple[str, str]],
    cells: Sequence[PlannedCell],
) -> None:
    with closing(connected(path, "rwc")) as db, db:
        db.executescript("BEGIN;" + TABLES)
        db.executemany("INSERT INTO metric (name, unit) VALUES (?, ?)", metrics)
        rows = (
            (s.name, s.fingerprint, json.dumps(s.conditions), s.origin or s.name, checksum_of(*s.seeds)) for s in scenes
        )
        db.executemany("INSERT INTO scene VALUES (?, ?, ?, ?, ?, ?)", _with_checksums(rows))
        seeds = ((one.name, run, seed) for one in scenes for run, seed in enumerate(one.seeds))
        db.executemany("INSERT INTO seed VALUES (?, ?, ?)", seeds)
        db.executemany(
            "INSERT INTO cell (key, scene, settings, runs, checksum) VALUES (?, ?, ?, ?, ?)",
            _with_checksums((c.key, c.scene, json.dumps(c.settings), c.runs) for c in cells),
        )
        meta = {"format": str(FORMAT), "created": str(time.time()), "config": json.dumps(config)}
        meta["cells"] = str(len(cells))  # so that a damaged file can say what is missing
        db.executemany("INSERT INTO meta VALUES (?, ?)", meta.items())
        db.execute("INSERT INTO meta VALUES ('checksum', ?)", (plan_checksum(db),))


def _put(unfinished: Path, path: Path) -> None:
    try:
        os.link(unfinished, path)  # unlike a renaming it leaves a file alone that another process made
    except FileExistsError:
        pass
    except OSError:  # a disk without links
        if not path.exists():
            unfinished.rename(path)


def _forget_ended(path: Path) -> None:
    """Remove what processes left that were killed while they made this store."""
    begin = f".{path.name}."
    for one in path.parent.glob(".*.tmp*"):
        pid = one.name.removeprefix(begin).partition(".")[0]
        if one.name.startswith(begin) and pid.isdigit() and started(int(pid)) is None:
            one.unlink(missing_ok=True)


def _with_checksums(rows: Iterable[tuple[object, ...]]) -> Iterator[tuple[object, ...]]:
    return ((*row, checksum_of(*row)) for row in rows)
