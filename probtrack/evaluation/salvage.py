"""What can still be read of a damaged store, row by row."""

import json
import sqlite3
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from probtrack.errors import InputError
from probtrack.evaluation.database import FORMAT, check_plan, check_unchanged, connected, seeds_of, unpacked
from probtrack.evaluation.store import Scores, Store, StoredCell

_UNREADABLE = (sqlite3.Error, ValueError)  # pages, and what is in them: JSON, text


class Runs(NamedTuple):
    """All runs of a study that can be read.

    Attributes:
        cells: Finished cells.
        metrics: Units of the metrics by name.
        scores: Of these cells, by metric.
        seeds: Of the runs by scene; no entry where they cannot be read.
        warning: What cannot be read, in one line; None where all is well.
    """

    cells: list[StoredCell]
    metrics: dict[str, str]
    scores: dict[str, Scores]
    seeds: dict[str, list[int]]
    warning: str | None = None


def runs_of(store: Store) -> Runs:
    """Return all runs of a store that is whole, finished or not."""
    cells = {cell.id: cell for cell in store.cells if cell.finished is not None}
    metrics = store.metrics
    scores = {name: _only(store.scores(name), list(cells)) for name in metrics}
    scenes = dict.fromkeys(cell.scene for cell in cells.values())
    return Runs(list(cells.values()), metrics, scores, {scene: store.seeds(scene) for scene in scenes})


def salvage(path: str | Path) -> Runs:
    """Return the runs of those cells of a damaged store that are whole, with a warning that says what is not.

    Raises:
        InputError: for a file of which nothing can be read: no study, one whose first pages are damaged, or one of
            which no cell is whole.
    """
    with closing(_opened(Path(path))) as db:
        try:
            meta = dict(db.execute("SELECT key, value FROM meta").fetchall())
            metrics = dict(db.execute("SELECT name, unit FROM metric ORDER BY id").fetchall())
            known = int(meta["cells"]) if meta["format"] == str(FORMAT) else None
        except (sqlite3.Error, KeyError, ValueError, TypeError) as error:
            raise InputError(f"{path}: nothing can be read of it: {error}") from None
        if known is None:
            raise InputError(f"{path}: a study of format {meta['format']}, this version reads format {FORMAT}")
        changed = _plan_changed(db)
        scenes = _Scenes(db)
        cells = [cell for i in range(1, known + 1) if (cell := _cell(db, i, scenes)) is not None]
        parts = _parts(db, known * len(metrics))
        whole = [cell for cell in cells if _is_whole(cell, parts, len(metrics))]
        begun = {number for _, number in parts} | {cell.id for cell in cells if cell.finished is not None}
        names = list(dict.fromkeys(cell.scene for cell in whole))
        seeds = {name: some for name in names if (some := scenes.seeds(name))}
    if not whole:
        raise InputError(f"{path}: is damaged, and no cell of it is whole")
    scores = {name: _scores(parts, whole, metric) for metric, name in enumerate(metrics, start=1)}
    left = [
        f"{count} {what}"
        for count, what in (
            (len(begun & {cell.id for cell in cells}) - len(whole), "whose scores are damaged"),
            (known - len(cells), "of which it is not known what they are"),
        )
        if count
    ]
    warning = (
        f"{path} is damaged: got {len(whole)} of {known} cells, {sum(cell.runs for cell in whole)} runs; "
        f"left behind are {' and '.join(left) or 'none that were finished'}"
    )
    blank = [
        f"{what} of {count} recordings"
        for count, what in ((len(scenes.unknown & set(names)), "conditions"), (len(names) - len(seeds), "seeds"))
        if count
    ]
    warning += f"; empty are {' and '.join(blank)}" if blank else ""
    warning += "; the names of metrics may not be what they were" if changed else ""
    return Runs(whole, metrics, scores, seeds, warning)


def _plan_changed(db: sqlite3.Connection) -> bool:
    try:
        check_plan(db)
    except _UNREADABLE:
        return True
    return False


def _is_whole(cell: StoredCell, parts: dict[tuple[int, int], Any], metrics: int) -> bool:
    """Whether there are scores of all runs of a cell for all metrics."""
    pairs = [parts.get((metric, cell.id)) for metric in range(1, metrics + 1)]
    return all(pair is not None and len(pair[0]) == len(pair[1]) == cell.runs for pair in pairs)


class _Scenes:
    """What is known of recordings, read once; empty where it cannot be read."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db
        self._planned: dict[str, tuple[dict[str, Any], str]] = {}
        self.unknown: set[str] = set()

    def planned(self, name: str) -> tuple[dict[str, Any], str]:
        """Return conditions and origin."""
        if name not in self._planned:
            self._planned[name] = {}, name
            self.unknown.add(name)
            query = "SELECT name, fingerprint, conditions, origin, seeds, checksum FROM scene WHERE name = ?"
            row = _row(self._db, query, (name,))
            if row is not None:
                *planned, checksum = row
                with suppress(*_UNREADABLE):
                    check_unchanged(checksum, *planned)
                    self._planned[name] = json.loads(planned[2]), planned[3]
                    self.unknown.discard(name)
        return self._planned[name]

    def seeds(self, name: str) -> list[int]:
        with suppress(*_UNREADABLE):
            return seeds_of(self._db, name)
        return []


def _cell(db: sqlite3.Connection, number: int, scenes: _Scenes) -> StoredCell | None:
    row = _row(db, "SELECT key, scene, settings, runs, checksum FROM cell WHERE id = ?", (number,))
    if row is None:
        return None
    *planned, checksum = row
    key, scene, settings, runs = planned
    with suppress(*_UNREADABLE):
        check_unchanged(checksum, *planned)
        done = db.execute("SELECT finished, seconds, duration, failure FROM cell WHERE id = ?", (number,)).fetchone()
        return StoredCell(number, key, scene, json.loads(settings), *scenes.planned(scene), runs, *done)
    return None


def _parts(db: sqlite3.Connection, most: int) -> dict[tuple[int, int], Any]:
    """Return numerators and denominators by metric and cell, not found by the index, which may be damaged."""
    found = {}
    for number in range(1, most + 1):
        row = _row(db, "SELECT metric, cell, numerator, denominator, checksum FROM score WHERE rowid = ?", (number,))
        if row is not None:
            with suppress(*_UNREADABLE):
                found[row[:2]] = unpacked(*row)
    return found


def _scores(parts: dict[tuple[int, int], Any], cells: list[StoredCell], metric: int) -> Scores:
    pairs = [parts[metric, cell.id] for cell in cells]
    runs = [len(numerator) for numerator, _ in pairs]
    empty = [np.zeros(0)]
    return Scores(
        np.repeat([cell.id for cell in cells], runs).astype(np.int64),
        np.concatenate([np.arange(n) for n in runs] or [np.zeros(0, np.int64)]),
        np.concatenate([numerator for numerator, _ in pairs] or empty),
        np.concatenate([denominator for _, denominator in pairs] or empty),
    )


def _only(scores: Scores, cells: list[int]) -> Scores:
    known = np.isin(scores.cell, cells)  # without those that another process has finished since
    return Scores(scores.cell[known], scores.run[known], scores.numerator[known], scores.denominator[known])


def _row(db: sqlite3.Connection, query: str, values: tuple[Any, ...]) -> Any:
    with suppress(*_UNREADABLE):
        return db.execute(query, values).fetchone()
    return None


def _opened(path: Path) -> sqlite3.Connection:
    if not path.is_file():
        raise InputError(f"{path}: no such study")
    try:
        db = connected(path, "ro")
        db.execute("PRAGMA writable_schema = ON")  # a file that was cut off is otherwise refused as a whole
        db.execute("PRAGMA cell_size_check = ON")
    except sqlite3.Error as error:
        raise InputError(f"{path}: nothing can be read of it: {error}") from None
    return db
