"""The store of a study: one SQLite file, of which a killed process loses no more than what it was working on.

Every finished cell is one transaction. Reading needs neither torch nor the study's files. The runs of a cell are one
row a metric, with numerators and denominators as arrays: a row a run would take eight times as long to read.
"""

import json
import os
import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from probtrack.errors import InputError, NotFiniteError
from probtrack.evaluation import creation
from probtrack.evaluation.database import (
    FORMAT,
    Packed,
    check_plan,
    check_scores,
    check_unchanged,
    checksum_of,
    connected,
    in_one_line,
    packed,
    seeds_of,
)  # fmt: skip
from probtrack.evaluation.processes import started
from probtrack.evaluation.records import CellScores as CellScores
from probtrack.evaluation.records import PlannedCell as PlannedCell
from probtrack.evaluation.records import PlannedScene as PlannedScene
from probtrack.evaluation.records import Scores as Scores
from probtrack.evaluation.records import StoredCell as StoredCell


class Store:
    """A study's results on disk. Use as a context, or `close` it.

    Args:
        path: The file, which must be there.
        write: Whether results are to be added.

    Raises:
        InputError: for a file that is not there, is no study or of another format; `DamagedStoreError` for one whose
            bytes are not what was written.
    """

    def __init__(self, path: str | Path, *, write: bool = False) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise InputError(f"{path}: {'is no file' if self.path.exists() else 'no such study'}")
        with self._said():
            self._db = connected(self.path, "ro")  # which leaves a file that is no study as it is
            try:
                self._check_format()
                if write:
                    self._db.close()
                    self._db = connected(self.path, "rw")
            except BaseException:
                self._db.close()
                raise

    @classmethod
    def create(
        cls,
        path: str | Path,
        config: dict[str, Any],
        scenes: Sequence[PlannedScene],
        metrics: Sequence[tuple[str, str]],
        cells: Sequence[PlannedCell],
    ) -> "Store":
        """Return a new store with all cells to be done, which is there whole or not at all.

        Args:
            path: The file, which must not be there.
            config: The study as plain values.
            scenes: All recordings.
            metrics: Name and unit of each metric.
            cells: What is to be done.
        """
        creation.create(Path(path), config, scenes, metrics, cells)
        return cls(path, write=True)

    def __enter__(self) -> "Store":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    @property
    def config(self) -> dict[str, Any]:
        """The study as plain values."""
        with self._said():
            ((text,),) = self._db.execute("SELECT value FROM meta WHERE key = 'config'")
            content: dict[str, Any] = json.loads(text)
        return content

    @property
    def fingerprints(self) -> dict[str, str]:
        """Fingerprint of each scene's files by name."""
        with self._said():
            return dict(self._db.execute("SELECT name, fingerprint FROM scene"))

    @property
    def metrics(self) -> dict[str, str]:
        """Units of the metrics by name, in the order of the study."""
        with self._said():
            return dict(self._db.execute("SELECT name, unit FROM metric ORDER BY id"))

    @property
    def cells(self) -> list[StoredCell]:
        """All cells, finished or not."""
        columns = "id, key, scene, settings, runs, checksum, finished, seconds, duration, failure, done_checksum"
        parsed = cache(json.loads)  # many cells have the same settings
        cells = []
        with self._said():
            scenes = self._scenes()
            rows = self._db.execute(f"SELECT {columns} FROM cell ORDER BY id")
            for i, key, scene, settings, runs, checksum, *rest, done in rows:
                check_unchanged(checksum, key, scene, settings, runs)
                if rest[0] is not None:
                    check_unchanged(done, i, *rest[:3])
                if scene not in scenes:
                    raise sqlite3.DatabaseError(f"scene {scene} is malformed")
                cells.append(StoredCell(i, key, scene, parsed(settings), *scenes[scene], runs, *rest))
        return cells

    @property
    def progress(self) -> tuple[int, int]:
        """How many cells are finished, and how many failed."""
        with self._said():
            ((finished, failed),) = self._db.execute("SELECT count(finished), count(failure) FROM cell")
        return finished, failed

    @property
    def workers(self) -> list[int]:
        """Numbers of the processes that work on it now."""
        with self._said():
            rows = self._db.execute("SELECT DISTINCT pid, pid_since FROM cell WHERE pid IS NOT NULL").fetchall()
        return [pid for pid, since in rows if started(pid) == since]

    def seeds(self, scene: str) -> list[int]:
        """Return the seeds of the runs of a scene."""
        with self._said():
            return seeds_of(self._db, scene)

    def scores(self, metric: str) -> Scores:
        """Return all runs of finished cells for one metric, sorted by cell and run.

        Raises:
            InputError: for a metric that the study does not have.
        """
        if metric not in self.metrics:
            raise InputError(f"{self.path}: has no metric {metric}: there are {', '.join(self.metrics)}")
        query = (
            "SELECT cell.runs, metric, cell, numerator, denominator, score.checksum FROM cell LEFT JOIN score "
            "ON cell = id AND metric = (SELECT id FROM metric WHERE name = ?) WHERE finished IS NOT NULL ORDER BY id"
        )
        with self._said():
            rows = [_whole(*row) for row in self._db.execute(query, (metric,))]
        runs = np.array([len(row[2]) // 8 for row in rows], dtype=np.int64)
        return Scores(
            np.repeat(np.array([row[1] for row in rows], dtype=np.int64), runs),
            np.arange(runs.sum()) - np.repeat(np.cumsum(runs) - runs, runs),
            np.frombuffer(b"".join(row[2] for row in rows), "<f8"),
            np.frombuffer(b"".join(row[3] for row in rows), "<f8"),
        )

    def claim(self) -> int | None:
        """Return a cell that is to be done and that nobody works on, now this process's own; None if there is none.

        What a process that has ended was working on is to be done again.
        """
        with self._said(), self._transaction():
            query = "SELECT id, pid, pid_since FROM cell WHERE finished IS NULL AND failure IS NULL ORDER BY id"
            for cell, pid, since in self._db.execute(query).fetchall():
                if pid is None or started(pid) != since:
                    own = (os.getpid(), started(os.getpid()), cell)
                    self._db.execute("UPDATE cell SET pid = ?, pid_since = ? WHERE id = ?", own)
                    return int(cell)
        return None

    def save(self, cell: int, scores: CellScores) -> None:
        """Keep what came of a cell, in one transaction; the first of two processes that did the same is kept.

        Raises:
            NotFiniteError: for a score that is not finite.
        """
        pairs = list(zip(scores.numerator, scores.denominator, strict=True))
        for metric, pair in zip(self.metrics, pairs, strict=True):
            if not np.isfinite(pair).all():
                bad = np.array(pair)
                run = int((~np.isfinite(bad)).any(0).argmax())
                raise NotFiniteError(f"{metric} is not finite in run {run}: {bad[0, run]:g} over {bad[1, run]:g}")
        rows = [packed(metric, cell, *pair) for metric, pair in enumerate(pairs, start=1)]
        done = (time.time(), float(scores.seconds), float(scores.duration))
        with self._said(), self._transaction():
            self._db.executemany("INSERT OR IGNORE INTO score VALUES (?, ?, ?, ?, ?)", rows)
            self._db.execute(
                "UPDATE cell SET pid = NULL, finished = ?, seconds = ?, duration = ?, failure = NULL, "
                "done_checksum = ? WHERE id = ? AND finished IS NULL",
                (*done, checksum_of(cell, *done), cell),
            )
        with self._said():
            self._db.execute("PRAGMA wal_checkpoint(PASSIVE)")  # a copy of the file alone has what is finished

    def give_up(self, cell: int, failure: str) -> None:
        """Note what went wrong with a cell; the next start tries again."""
        with self._said(), self._transaction():
            query = "UPDATE cell SET pid = NULL, failure = ? WHERE id = ? AND finished IS NULL"
            self._db.execute(query, (failure, cell))

    def release(self) -> None:
        """Let go of all that this process has claimed and not finished: it is to be done again."""
        with self._said(), self._transaction():
            own = (os.getpid(), started(os.getpid()))
            self._db.execute("UPDATE cell SET pid = NULL WHERE pid = ? AND pid_since = ?", own)

    def retry(self) -> None:
        """Forget failures of before, so that their cells are tried again."""
        with self._said(), self._transaction():
            self._db.execute("UPDATE cell SET failure = NULL WHERE failure IS NOT NULL")

    def _check_format(self) -> None:
        try:
            found = dict(self._db.execute("SELECT key, value FROM meta"))
        except sqlite3.OperationalError as error:
            if not any(word in str(error) for word in ("no such table", "no such column")):
                raise
            found = {}
        if not {"format", "cells"} <= found.keys():
            raise InputError(f"{self.path}: not a study made by probtrack evaluate")
        if found["format"] != str(FORMAT):
            raise InputError(
                f"{self.path}: a study of format {found['format']}, this version of probtrack reads format {FORMAT}"
            )
        check_plan(self._db)

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """Write all that is done within, or nothing; other processes wait meanwhile."""
        try:
            self._db.execute("BEGIN IMMEDIATE")
            yield
            self._db.commit()
        except BaseException:
            self._db.rollback()
            raise

    def _scenes(self) -> dict[str, tuple[dict[str, Any], str]]:
        """Return conditions and origin of each recording by name."""
        scenes = {}
        query = "SELECT name, fingerprint, conditions, origin, seeds, checksum FROM scene"
        for name, fingerprint, conditions, origin, seeds, checksum in self._db.execute(query):
            check_unchanged(checksum, name, fingerprint, conditions, origin, seeds)
            scenes[name] = json.loads(conditions), origin
        return scenes

    def _said(self) -> Any:
        return in_one_line(self.path)


def _whole(runs: int, *row: Any) -> Packed:
    """Return a row of the scores; `sqlite3.DatabaseError` if it is not there, has changed, or is of other runs."""
    check_scores(*row)
    if not len(row[2]) == len(row[3]) == 8 * runs:
        raise sqlite3.DatabaseError("scores are malformed")
    return row
