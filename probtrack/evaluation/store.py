"""The store of a study: one SQLite file, of which a killed process loses no more than what it was working on.

Every finished cell is one transaction. Reading needs neither torch nor the study's files. The runs of a cell are one
row a metric, with numerators and denominators as arrays: a row a run would take eight times as long to read.
"""

import json
import os
import sqlite3
import time
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from probtrack.errors import InputError, NotFiniteError

FORMAT = 1
"""Of the tables below: a store says which it has."""

_TABLES = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE scene (name TEXT PRIMARY KEY, fingerprint TEXT NOT NULL, conditions TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE seed (scene TEXT NOT NULL, run INTEGER NOT NULL, seed INTEGER NOT NULL, PRIMARY KEY (scene, run))
    WITHOUT ROWID;
CREATE TABLE metric (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, unit TEXT NOT NULL);
CREATE TABLE cell (
    id INTEGER PRIMARY KEY, key TEXT NOT NULL UNIQUE, scene TEXT NOT NULL, settings TEXT NOT NULL,
    runs INTEGER NOT NULL, pid INTEGER, pid_since TEXT, finished REAL, seconds REAL, duration REAL, failure TEXT);
CREATE TABLE score (
    metric INTEGER NOT NULL, cell INTEGER NOT NULL, numerator BLOB NOT NULL, denominator BLOB NOT NULL,
    checksum INTEGER NOT NULL, PRIMARY KEY (metric, cell));
"""


_DAMAGE = ("malformed", "not a database", "Could not decode")  # what SQLite says of a file that was changed


class PlannedScene(NamedTuple):
    """A recording of a study.

    Attributes:
        name: What it is called.
        fingerprint: What tells its files from others of the same name.
        conditions: What is varied between recordings, by name, such as `snr_db` and `t60`.
        seeds: Of the runs on it.
    """

    name: str
    fingerprint: str
    conditions: dict[str, Any]
    seeds: Sequence[int]


class PlannedCell(NamedTuple):
    """A cell before it is worked on: a tracker on a recording.

    Attributes:
        key: What tells it from all others of the study.
        scene: Name of its recording.
        settings: The tracker's name as `tracker`, and what is varied of its settings, by name.
        runs: Monte-Carlo runs.
    """

    key: str
    scene: str
    settings: dict[str, Any]
    runs: int


class StoredCell(NamedTuple):
    """A cell of a store.

    Attributes:
        id: Its number.
        key: What tells it from all others of the study.
        scene: Name of its recording.
        settings: The tracker's name as `tracker`, and what is varied of its settings, by name.
        conditions: What is varied between recordings, by name.
        runs: Monte-Carlo runs.
        finished: When it was finished [s since 1970]; None before.
        seconds: What it took [s of one processor].
        duration: How long the recording is [s].
        failure: What went wrong with it last, if it did.
    """

    id: int
    key: str
    scene: str
    settings: dict[str, Any]
    conditions: dict[str, Any]
    runs: int
    finished: float | None
    seconds: float | None
    duration: float | None
    failure: str | None


class CellScores(NamedTuple):
    """What came of a cell.

    Attributes:
        numerator: Numerators of each metric and run (J, R).
        denominator: Denominators (J, R).
        seconds: What it took [s].
        duration: How long the recording is [s].
    """

    numerator: NDArray[np.float64]
    denominator: NDArray[np.float64]
    seconds: float
    duration: float


class Scores(NamedTuple):
    """Runs of finished cells for one metric.

    Attributes:
        cell: Number of the cell of each run (n,).
        run: Number of the run within it (n,).
        numerator: Numerators (n,).
        denominator: Denominators (n,).
    """

    cell: NDArray[np.int64]
    run: NDArray[np.int64]
    numerator: NDArray[np.float64]
    denominator: NDArray[np.float64]


class Store:
    """A study's results on disk. Use as a context, or `close` it.

    Args:
        path: The file, which must be there.
        write: Whether results are to be added.

    Raises:
        InputError: for a file that is not there, is no study, is damaged or of another format.
    """

    def __init__(self, path: str | Path, *, write: bool = False) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise InputError(f"{path}: no such study")
        with self._said():
            self._db = _connected(self.path, "rw" if write else "ro")
            try:
                self._check_format()
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
        path = Path(path)
        unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        unfinished.unlink(missing_ok=True)
        try:
            with _said_of(path):
                db = _connected(unfinished, "rwc")
                with db:
                    db.executescript("BEGIN;" + _TABLES)
                    meta = {"format": str(FORMAT), "created": str(time.time()), "config": json.dumps(config)}
                    meta["cells"] = str(len(cells))  # so that a damaged file can say what is missing
                    db.executemany("INSERT INTO meta VALUES (?, ?)", meta.items())
                    db.executemany(
                        "INSERT INTO scene VALUES (?, ?, ?)",
                        ((one.name, one.fingerprint, json.dumps(one.conditions)) for one in scenes),
                    )
                    rows = ((one.name, run, seed) for one in scenes for run, seed in enumerate(one.seeds))
                    db.executemany("INSERT INTO seed VALUES (?, ?, ?)", rows)
                    db.executemany("INSERT INTO metric (name, unit) VALUES (?, ?)", metrics)
                    db.executemany(
                        "INSERT INTO cell (key, scene, settings, runs) VALUES (?, ?, ?, ?)",
                        ((c.key, c.scene, json.dumps(c.settings), c.runs) for c in cells),
                    )
                db.close()
                with suppress(FileExistsError):
                    os.link(unfinished, path)  # unlike a renaming it leaves a file alone that another process made
        finally:
            unfinished.unlink(missing_ok=True)
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
        query = (
            "SELECT id, key, scene, settings, conditions, runs, finished, seconds, duration, failure "
            "FROM cell JOIN scene ON cell.scene = scene.name ORDER BY id"
        )
        with self._said():
            return [
                StoredCell(i, key, scene, json.loads(settings), json.loads(conditions), *rest)
                for i, key, scene, settings, conditions, *rest in self._db.execute(query)
            ]

    def seeds(self, scene: str) -> list[int]:
        """Return the seeds of the runs of a scene."""
        with self._said():
            return [s for (s,) in self._db.execute("SELECT seed FROM seed WHERE scene = ? ORDER BY run", (scene,))]

    def scores(self, metric: str) -> Scores:
        """Return all runs of finished cells for one metric, sorted by cell and run.

        Raises:
            InputError: for a metric that the study does not have.
        """
        if metric not in self.metrics:
            raise InputError(f"{self.path}: has no metric {metric}: there are {', '.join(self.metrics)}")
        query = (
            "SELECT cell, numerator, denominator, checksum FROM score "
            "WHERE metric = (SELECT id FROM metric WHERE name = ?) ORDER BY cell"
        )
        with self._said():
            rows = [(cell, *unpacked(*row)) for cell, *row in self._db.execute(query, (metric,))]
        runs = [len(numerator) for _, numerator, _ in rows]
        return Scores(
            np.repeat([cell for cell, *_ in rows], runs).astype(np.int64),
            np.concatenate([np.arange(n) for n in runs] or [np.zeros(0, np.int64)]),
            np.concatenate([numerator for _, numerator, _ in rows] or [np.zeros(0)]),
            np.concatenate([denominator for *_, denominator in rows] or [np.zeros(0)]),
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
                raise NotFiniteError(f"scores of {metric} must be finite, got {pair[0]} over {pair[1]} in cell {cell}")
        rows = [(metric, cell, *_packed(*pair)) for metric, pair in enumerate(pairs, start=1)]
        done = (time.time(), scores.seconds, scores.duration, cell)
        with self._said(), self._transaction():
            self._db.executemany("INSERT OR IGNORE INTO score VALUES (?, ?, ?, ?, ?)", rows)
            self._db.execute(
                "UPDATE cell SET pid = NULL, finished = ?, seconds = ?, duration = ?, failure = NULL "
                "WHERE id = ? AND finished IS NULL",
                done,
            )

    def give_up(self, cell: int, failure: str) -> None:
        """Note what went wrong with a cell; the next start tries again."""
        with self._said(), self._transaction():
            self._db.execute("UPDATE cell SET pid = NULL, failure = ? WHERE id = ?", (failure, cell))

    def retry(self) -> None:
        """Forget failures of before, so that their cells are tried again."""
        with self._said(), self._transaction():
            self._db.execute("UPDATE cell SET failure = NULL WHERE failure IS NOT NULL")

    def _check_format(self) -> None:
        try:
            found = dict(self._db.execute("SELECT key, value FROM meta"))
        except sqlite3.OperationalError as error:
            if "no such table" not in str(error):
                raise
            found = {}
        if "format" not in found:
            raise InputError(f"{self.path}: not a study made by probtrack evaluate")
        if found["format"] != str(FORMAT):
            raise InputError(
                f"{self.path}: a study of format {found['format']}, this version of probtrack reads format {FORMAT}"
            )

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """Write all that is done within, or nothing; other processes wait meanwhile."""
        self._db.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            self._db.rollback()
            raise
        self._db.commit()

    def _said(self) -> Any:
        return _said_of(self.path)


def started(pid: int) -> str | None:
    """Return what tells a running process from another that had the same number before; None if there is none."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:  # another user's
        pass
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    except OSError:
        return ""  # no such files on this system: the number alone must do
    return text.rpartition(")")[2].split()[19]  # clock ticks from the system's start to the process's


def _packed(numerator: NDArray[np.float64], denominator: NDArray[np.float64]) -> tuple[bytes, bytes, int]:
    """Return the columns of a score: both arrays, little-endian, and the checksum of their bytes."""
    first, second = (np.ascontiguousarray(part, "<f8").tobytes() for part in (numerator, denominator))
    return first, second, zlib.crc32(first + second)


def unpacked(first: bytes, second: bytes, checksum: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return numerators and denominators of a score, or raise `sqlite3.DatabaseError` for bytes that have changed."""
    if not isinstance(first, bytes) or not isinstance(second, bytes) or zlib.crc32(first + second) != checksum:
        raise sqlite3.DatabaseError("scores are malformed")
    return np.frombuffer(first, "<f8"), np.frombuffer(second, "<f8")


def _connected(path: Path, mode: str) -> sqlite3.Connection:
    db = sqlite3.connect(f"{path.absolute().as_uri()}?mode={mode}", uri=True, timeout=60, isolation_level=None)
    if mode != "ro":
        db.execute("PRAGMA journal_mode = WAL")
        db.execute("PRAGMA synchronous = FULL")
    return db


@contextmanager
def _said_of(path: Path) -> Iterator[None]:
    """Say in one line what SQLite or the disk has against it."""
    try:
        yield
    except (sqlite3.Error, OSError, json.JSONDecodeError) as error:
        what = str(error)
        if isinstance(error, json.JSONDecodeError) or any(word in what for word in _DAMAGE):
            what = f"is damaged, or no study ({what}): probtrack study export gets out what can be read"
        raise InputError(f"{path}: {what}") from None
