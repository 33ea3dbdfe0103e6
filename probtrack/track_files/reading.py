"""Tables of tracks and of truth, read with checks."""

import csv
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from probtrack.errors import InputError
from probtrack.track_files.columns import is_known, kind_of, with_parquet


@dataclass(frozen=True)
class TrackTable:
    """Columns of a track file.

    Attributes:
        path: Where it was read.
        columns: Column name to values (T,), float64, NaN where a cell is empty. Rows are in time order.
    """

    path: Path
    columns: dict[str, Tensor]

    @property
    def time(self) -> Tensor:
        """Times (T,) [s], increasing."""
        return self.columns["time"]

    @property
    def position(self) -> Tensor | None:
        """Positions (T, 2) or (T, 3) [m], if the file has x and y."""
        names = [axis for axis in "xyz" if axis in self.columns]
        if names[:2] != ["x", "y"]:
            return None
        return torch.stack([self.columns[axis] for axis in names], -1)

    def get(self, name: str) -> Tensor | None:
        """Return a column (T,), None where the file does not have it."""
        return self.columns.get(name)


def read_track(path: str | Path) -> TrackTable:
    """Read the one track of a file.

    Raises:
        InputError: for a file that cannot be read, has no `time`, no position and no azimuth, cells that are not
            numbers, a column twice, times that do not increase, no rows, or more than one track.
    """
    table = _read(Path(path))
    names = _numbers(table)
    if len(names) > 1:
        raise InputError(f"{path}: holds tracks {', '.join(f'{name:g}' for name in names)}, expected one")
    return _in_order(table)


def read_tracks(path: str | Path) -> list[TrackTable]:
    """Read all tracks of a file, such as the truth of several talkers, in the order of their numbers.

    Raises:
        InputError: as `read_track`, and for a row without a track number among several tracks.
    """
    table = _read(Path(path))
    names = _numbers(table)
    if len(names) <= 1:
        return [_in_order(table)]
    number = table.columns["track"]
    if number.isnan().any():
        raise InputError(f"{path}: holds several tracks: every row needs a track number")
    rows = [number == name for name in names]
    return [_in_order(TrackTable(table.path, {n: c[own] for n, c in table.columns.items()})) for own in rows]


def _read(path: Path) -> TrackTable:
    kind = kind_of(path)
    try:
        columns = _READERS[kind](path)
    except OSError as error:
        what = " ".join((error.strerror or str(error)).split())
        raise InputError(f"{path}: cannot read the track file: {what}") from None
    if "time" not in columns:
        raise InputError(f"{path}: a track file needs a column 'time', got {', '.join(columns) or 'no columns'}")
    if "azimuth" not in columns and not {"x", "y"} <= columns.keys():
        raise InputError(f"{path}: a track file needs columns x and y, or azimuth")
    if len(columns["time"]) == 0:
        raise InputError(f"{path}: the track file has no rows")
    if not columns["time"].isfinite().all():
        raise InputError(f"{path}: every row needs a time")
    return TrackTable(path, columns)


def _numbers(table: TrackTable) -> list[float]:
    numbers: list[float] = table.columns.get("track", torch.zeros(1)).unique().tolist()
    return [number for number in numbers if not math.isnan(number)]


def _in_order(table: TrackTable) -> TrackTable:
    later = table.time.diff() > 0
    if not later.all():
        row = int((~later).nonzero()[0, 0]) + 1
        before, after = table.time[row - 1 : row + 1].tolist()
        raise InputError(
            f"{table.path}: times must increase from row to row, got {after:g} s after {before:g} s in row {row + 1}"
        )
    return table


def _read_csv(path: Path) -> dict[str, Tensor]:
    with path.open(newline="", encoding="utf-8-sig") as file:  # spreadsheets put a mark before the first name
        try:
            lines = list(csv.reader(file))
        except (csv.Error, UnicodeDecodeError) as error:
            raise InputError(f"{path}: not a CSV file: {error}") from None
    header, body = (lines[0], lines[1:]) if lines else ([], [])
    return _columns(path, header, ((n, row) for n, row in enumerate(body, 2) if row))


def _read_jsonl(path: Path) -> dict[str, Tensor]:
    rows = []
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a JSON lines file: {error}") from None
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            row = None
        if not isinstance(row, dict):
            raise InputError(f"{path}:{number}: expected a JSON object a line")
        rows.append((number, row))
    header = list(dict.fromkeys(name for _, row in rows for name in row if is_known(name)))
    return _columns(path, header, ((number, [row.get(name) for name in header]) for number, row in rows))


def _read_parquet(path: Path) -> dict[str, Tensor]:
    pyarrow = with_parquet()
    try:
        with path.open("rb") as file:
            table = pyarrow.parquet.read_table(file)
    except pyarrow.ArrowException as error:
        raise InputError(f"{path}: not a Parquet file: {' '.join(str(error).split())}") from None
    rows = zip(*(table.column(name).to_pylist() for name in table.column_names), strict=True)
    return _columns(path, table.column_names, enumerate(rows, 1))


def _columns(path: Path, header: Sequence[str], rows: Iterable[tuple[int, Sequence[Any]]]) -> dict[str, Tensor]:
    """Return the known columns of `rows`, (line number, cells) each."""
    picked = [(i, name.strip()) for i, name in enumerate(header) if is_known(name.strip())]
    names = [name for _, name in picked]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{path}: has the column {twice} more than once")
    values = []
    for number, row in rows:
        if len(row) != len(header):
            raise InputError(f"{path}:{number}: {len(row)} cells under {len(header)} column names")
        try:
            values.append([math.nan if row[i] in (None, "") else float(row[i]) for i, _ in picked])
        except (TypeError, ValueError, OverflowError):
            bad = next(name for i, name in picked if row[i] not in (None, "") and not _is_number(row[i]))
            raise InputError(f"{path}:{number}: column {bad} holds something that is not a number") from None
    table = torch.tensor(values, dtype=torch.float64).reshape(len(values), len(picked))
    return {name: table[:, i] for i, (_, name) in enumerate(picked)}


def _is_number(cell: Any) -> bool:
    try:
        float(cell)
    except (TypeError, ValueError, OverflowError):
        return False
    return True


_READERS = {".csv": _read_csv, ".jsonl": _read_jsonl, ".parquet": _read_parquet}
