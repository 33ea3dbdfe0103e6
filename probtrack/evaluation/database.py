"""The SQLite file of a study: its tables, how scores are packed in them, and what goes wrong with it in one line."""

import json
import sqlite3
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from probtrack.errors import InputError

FORMAT = 2
"""Of the tables below: a store says which it has."""

BESIDE = ("-wal", "-shm")
"""What the names of the files end in that SQLite keeps beside a store at work."""

TABLES = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE scene (name TEXT PRIMARY KEY, fingerprint TEXT NOT NULL, conditions TEXT NOT NULL,
    origin TEXT NOT NULL, seeds INTEGER NOT NULL, checksum INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE seed (scene TEXT NOT NULL, run INTEGER NOT NULL, seed INTEGER NOT NULL, PRIMARY KEY (scene, run))
    WITHOUT ROWID;
CREATE TABLE metric (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, unit TEXT NOT NULL);
CREATE TABLE cell (
    id INTEGER PRIMARY KEY, key TEXT NOT NULL UNIQUE, scene TEXT NOT NULL, settings TEXT NOT NULL,
    runs INTEGER NOT NULL, checksum INTEGER NOT NULL,
    pid INTEGER, pid_since TEXT, finished REAL, seconds REAL, duration REAL, failure TEXT,
    done_checksum INTEGER);
CREATE TABLE score (
    metric INTEGER NOT NULL, cell INTEGER NOT NULL, numerator BLOB NOT NULL, denominator BLOB NOT NULL,
    checksum INTEGER NOT NULL, PRIMARY KEY (metric, cell));
"""


class DamagedStoreError(InputError):
    """Bytes of a store are not what was written, or it never was one."""


Packed = tuple[int, int, bytes, bytes, int]
"""A row of the scores: metric, cell, numerators and denominators (little-endian), and a checksum of all that."""

_NOT_WRITABLE = ("readonly database", "unable to open")  # of a folder in which SQLite can put nothing
_DAMAGE = ("malformed", "not a database", "Could not decode")  # what SQLite says of a file that was changed


def packed(metric: int, cell: int, numerator: NDArray[np.float64], denominator: NDArray[np.float64]) -> Packed:
    """Return the row of the scores that holds a metric of a cell."""
    first, second = (np.ascontiguousarray(part, "<f8").tobytes() for part in (numerator, denominator))
    return metric, cell, first, second, _checksum(metric, cell, first, second)


def unpacked(
    metric: int, cell: int, first: bytes, second: bytes, checksum: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return numerators and denominators of a row of the scores, or raise `sqlite3.DatabaseError` if it has changed."""
    check_scores(metric, cell, first, second, checksum)
    return np.frombuffer(first, "<f8"), np.frombuffer(second, "<f8")


def check_scores(metric: int, cell: int, first: bytes, second: bytes, checksum: int) -> None:
    """Raise `sqlite3.DatabaseError` if a row of the scores is not as it was written."""
    blobs = isinstance(first, bytes) and isinstance(second, bytes)
    if not blobs or _checksum(metric, cell, first, second) != checksum:
        raise sqlite3.DatabaseError("scores are malformed")


def _checksum(metric: int, cell: int, first: bytes, second: bytes) -> int:
    return zlib.crc32(f"{metric} {cell} ".encode() + first + second)


def checksum_of(*columns: object) -> int:
    """Return the checksum of columns of names and numbers, as they were planned."""
    return zlib.crc32("\n".join(map(str, columns)).encode())


def check_unchanged(checksum: object, *columns: object) -> None:
    """Raise `sqlite3.DatabaseError` if columns are not as they were planned."""
    if checksum_of(*columns) != checksum:
        raise sqlite3.DatabaseError("the plan is malformed")


def plan_checksum(db: sqlite3.Connection) -> int:
    """Return the checksum of what a store says of itself and of its metrics."""
    meta = db.execute("SELECT key, value FROM meta WHERE key != 'checksum' ORDER BY key").fetchall()
    return checksum_of(*meta, *db.execute("SELECT id, name, unit FROM metric ORDER BY id").fetchall())


def check_plan(db: sqlite3.Connection) -> None:
    """Raise `sqlite3.DatabaseError` if what a store says of itself and of its metrics is not as it was written."""
    checksum = db.execute("SELECT value FROM meta WHERE key = 'checksum'").fetchone()
    if checksum is None or checksum[0] != str(plan_checksum(db)):
        raise sqlite3.DatabaseError("the plan is malformed")


def seeds_of(db: sqlite3.Connection, scene: str) -> list[int]:
    """Return the seeds of the runs of a scene; `sqlite3.DatabaseError` if they are not as they were planned."""
    seeds = [seed for (seed,) in db.execute("SELECT seed FROM seed WHERE scene = ? ORDER BY run", (scene,))]
    checksum = db.execute("SELECT seeds FROM scene WHERE name = ?", (scene,)).fetchone()
    check_unchanged(checksum and checksum[0], *seeds)
    return seeds


def connected(path: Path, mode: str) -> sqlite3.Connection:
    """Open a store to read it ("ro"), to add to it ("rw") or to make it ("rwc")."""
    db = _opened(path, f"mode={mode}")
    if mode != "ro":
        db.execute("PRAGMA journal_mode = WAL")
        db.execute("PRAGMA synchronous = FULL")
        return db
    try:
        db.execute("PRAGMA schema_version").fetchone()
    except sqlite3.OperationalError as error:
        wal = path.with_name(path.name + BESIDE[0])
        if not any(word in str(error) for word in _NOT_WRITABLE) or (wal.exists() and wal.stat().st_size):
            return db
        db.close()
        return _opened(path, "mode=ro&immutable=1")  # nobody is at work on it, and nothing can be put beside it
    except sqlite3.DatabaseError:
        pass  # what is first asked of it says so again
    return db


def _opened(path: Path, how: str) -> sqlite3.Connection:
    return sqlite3.connect(f"{path.absolute().as_uri()}?{how}", uri=True, timeout=60, isolation_level=None)


@contextmanager
def in_one_line(path: Path) -> Iterator[None]:
    """Say in one line what SQLite or the disk has against it."""
    try:
        yield
    except (sqlite3.Error, OSError, json.JSONDecodeError) as error:
        what = str(error)
        if isinstance(error, json.JSONDecodeError) or any(word in what for word in _DAMAGE):
            what = f"is damaged, or no study ({what}): probtrack study export gets out what can be read"
            raise DamagedStoreError(f"{path}: {what}") from None
        raise InputError(f"{path}: {what}") from None
