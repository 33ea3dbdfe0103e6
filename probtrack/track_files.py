"""Tables of tracks and of truth: written as frames come, read back with checks. CSV, JSON lines, Parquet."""

import abc
import csv
import json
import math
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TextIO

import torch
from torch import Tensor

from probtrack._files import check_suffix, check_writable
from probtrack.errors import InputError
from probtrack.tracks import Track

COLUMNS = (
    "time", "track", "x", "y", "z", "std_x", "std_y", "std_z", "azimuth", "std_azimuth", "heading", "speech", "ess",
    "lost",
)  # fmt: skip
"""Columns of a table in their order [s, m, rad]; a file has those that are known, and `time` always.

The probabilities of the motion models of a track that switches follow as mode_0, mode_1, and so on.
"""

SUFFIXES = (".csv", ".jsonl", ".parquet")
"""Kinds of file, by suffix."""

Row = dict[str, float | None]

_WHOLE = ("track", "lost")  # columns of integers
_MODE = re.compile(r"mode_\d+")


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
    path = Path(path)
    kind = _kind(path)
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
    names = [name for name in columns.get("track", torch.zeros(1)).unique().tolist() if not math.isnan(name)]
    if len(names) > 1:
        raise InputError(f"{path}: holds tracks {', '.join(f'{name:g}' for name in names)}, expected one")
    if not (columns["time"].diff() > 0).all():
        raise InputError(f"{path}: times must increase from row to row")
    return TrackTable(path, columns)


def rows_of(track: Track, name: int = 1) -> list[Row]:
    """Return the rows of a track without batch, under the track number `name`."""
    if track.ess.ndim != 1:
        raise InputError(f"a track file holds one run, got a batch {tuple(track.ess.shape[1:])}")
    known: dict[str, Tensor | None] = {
        "time": track.time,
        "track": torch.full_like(track.time, name),
        **dict(zip("xyz", track.position.unbind(-1), strict=False)),
        **{f"std_{axis}": column for axis, column in zip("xyz", track.std.unbind(-1), strict=False)},
        "azimuth": track.azimuth,
        "std_azimuth": track.std_azimuth,
        "heading": track.heading,
        "speech": track.speech,
        "ess": track.ess,
        "lost": track.lost,
    }
    if track.mode is not None:
        known |= {f"mode_{s}": column for s, column in enumerate(track.mode.unbind(-1))}
    names = sorted((name for name, column in known.items() if column is not None), key=_place)
    table = torch.stack([known[column].detach().double() for column in names], -1).tolist()  # type: ignore[union-attr]
    return [dict(zip(names, values, strict=True)) for values in table]


def check_track_output(path: str | Path) -> None:
    """Raise `InputError` unless a track file can be written to `path` ('-' is standard output)."""
    if str(path) != "-":
        _kind(Path(path))
        check_writable(Path(path))


class TrackWriter(abc.ABC):
    """Writes rows as they come; what was written before an interruption is a valid file.

    A Parquet file is valid once it is closed, as the end of a `with` does even on an error.
    `TrackWriter.open(path)` picks the kind by the suffix; '-' writes CSV to standard output.
    """

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @abc.abstractmethod
    def write(self, rows: Sequence[Row]) -> None:
        """Append `rows`, which all have the columns of the first."""

    @abc.abstractmethod
    def close(self) -> None:
        """Finish the file."""

    @staticmethod
    def open(path: str | Path) -> "TrackWriter":
        """Return the writer for `path`, emptied.

        Raises:
            InputError: for an unknown suffix or a path that cannot be written.
        """
        if str(path) == "-":
            return _TextWriter(os.fdopen(os.dup(1), "w", newline=""), _csv_lines)
        path = Path(path)
        kind = _kind(path)
        try:
            if kind == ".parquet":
                return _ParquetWriter(path)
            return _TextWriter(path.open("w", newline=""), _csv_lines if kind == ".csv" else _json_lines)
        except OSError as error:
            raise InputError(f"{path}: cannot write there: {error.strerror}") from None


class _TextWriter(TrackWriter):
    def __init__(self, file: TextIO, lines: Any) -> None:
        self._file, self._lines, self._first = file, lines, True

    def write(self, rows: Sequence[Row]) -> None:
        self._file.writelines(self._lines(rows, self._first))
        self._file.flush()
        self._first = self._first and not rows

    def close(self) -> None:
        self._file.close()


class _ParquetWriter(TrackWriter):
    def __init__(self, path: Path) -> None:
        self._pyarrow = _pyarrow()
        self._file = path.open("wb")
        self._writer: Any = None

    def write(self, rows: Sequence[Row]) -> None:
        if not rows:
            return
        writer = self._started(rows[0])
        cells = [{name: _cell(name, value) for name, value in row.items()} for row in rows]
        writer.write_table(self._pyarrow.Table.from_pylist(cells, schema=writer.schema))

    def close(self) -> None:
        self._started(COLUMNS).close()
        self._file.close()

    def _started(self, names: Iterable[str]) -> Any:
        # types by name and not by the first rows, in which a column may be empty throughout
        if self._writer is None:
            fields = [(n, self._pyarrow.int64() if n in _WHOLE else self._pyarrow.float64()) for n in names]
            self._writer = self._pyarrow.parquet.ParquetWriter(self._file, self._pyarrow.schema(fields))
        return self._writer


def _csv_lines(rows: Sequence[Row], first: bool) -> Iterator[str]:
    if first and rows:
        yield ",".join(rows[0]) + "\n"
    for row in rows:
        yield ",".join("" if (cell := _cell(*item)) is None else f"{cell:.15g}" for item in row.items()) + "\n"


def _json_lines(rows: Sequence[Row], first: bool) -> Iterator[str]:  # noqa: ARG001
    for row in rows:
        yield json.dumps({name: _cell(name, value) for name, value in row.items()}) + "\n"


def _cell(name: str, value: float | None) -> float | None:
    """Return a value as files hold it: integers where the column has them, rounded to a microsecond or micrometre."""
    if value is None or not math.isfinite(value):
        return None
    return int(value) if name in _WHOLE else round(value, 6)


def _is_known(name: str) -> bool:
    return name in COLUMNS or _MODE.fullmatch(name) is not None


def _place(name: str) -> tuple[int, int]:
    """Return what sorts columns: those of `COLUMNS`, then the modes by their number."""
    return (COLUMNS.index(name), 0) if name in COLUMNS else (len(COLUMNS), int(name.removeprefix("mode_")))


def _kind(path: Path) -> str:
    return check_suffix(path, "a track file", SUFFIXES)


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
    header = list(dict.fromkeys(name for _, row in rows for name in row if _is_known(name)))
    return _columns(path, header, ((number, [row.get(name) for name in header]) for number, row in rows))


def _read_parquet(path: Path) -> dict[str, Tensor]:
    pyarrow = _pyarrow()
    try:
        with path.open("rb") as file:
            table = pyarrow.parquet.read_table(file)
    except pyarrow.ArrowException as error:
        raise InputError(f"{path}: not a Parquet file: {' '.join(str(error).split())}") from None
    rows = zip(*(table.column(name).to_pylist() for name in table.column_names), strict=True)
    return _columns(path, table.column_names, enumerate(rows, 1))


def _columns(path: Path, header: Sequence[str], rows: Iterable[tuple[int, Sequence[Any]]]) -> dict[str, Tensor]:
    """Return the known columns of `rows`, (line number, cells) each."""
    picked = [(i, name.strip()) for i, name in enumerate(header) if _is_known(name.strip())]
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


def _pyarrow() -> Any:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise ImportError("Parquet files need pyarrow: pip install 'probtrack[report]'") from None
    return pyarrow


_READERS = {".csv": _read_csv, ".jsonl": _read_jsonl, ".parquet": _read_parquet}
