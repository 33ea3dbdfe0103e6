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

FORMAT = 1
"""Of the tables below: a store says which it has."""

BESIDE = ("-wal", "-shm")
"""What the names of the files end in that SQLite keeps beside a store at work."""

TABLES = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE scene (name TEXT PRIMARY KEY, fingerprint TEXT NOT NULL, conditions TEXT NOT NULL,
    origin TEXT NOT NULL, checksum INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE seed (scene TEXT NOT NULL, run INTEGER NOT NULL, seed INTEGER NOT NULL, PRIMARY KEY (scene, run))
    WITHOUT ROWID;
CREATE TABLE metric (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, unit TEXT NOT NULL);
CREATE TABLE cell (
    id INTEGER PRIMARY KEY, key TEXT NOT NULL UNIQUE, scene TEXT NOT NULL, settings TEXT NOT NULL,
    runs INTEGER NOT NULL, checksum INTEGER NOT NULL,
    pid INTEGER, pid_since TEXT, finished REAL, seconds REAL, duration REAL, failure TEXT);
CREATE TABLE score (
    metric INTEGER NOT NULL, cell INTEGER NOT NULL, numerator BLOB NOT NULL, denominator BLOB NOT NULL,
    checksum INTEGER NOT NULL, PRIMARY KEY (metric, cell));
"""


class DamagedStoreError(InputError):
    """Bytes of a store are not what was written, or it never was one."""


Packed = tuple[int, int, bytes, bytes, int]
"""A row of the scores: metric, cell, numerators and denominators (little-endian), and a checksum of all that."""

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


def connected(path: Path, mode: str) -> sqlite3.Connection:
    """Open a store to read it ("ro"), to add to it ("rw") or to make it ("rwc")."""
    db = sqlite3.connect(f"{path.absolute().as_uri()}?mode={mode}", uri=True, timeout=60, isolation_level=None)
    if mode != "ro":
        db.execute("PRAGMA journal_mode = WAL")
        db.execute("PRAGMA synchronous = FULL")
    return db


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
