"""Tables of tracks, written as frames come."""

import abc
import json
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TextIO

import torch
from torch import Tensor

from probtrack._files import check_writable
from probtrack.errors import InputError
from probtrack.track_files.columns import COLUMNS, WHOLE, Row, kind_of, with_parquet
from probtrack.tracks import Track


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
        kind_of(Path(path))
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
        kind = kind_of(path)
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
        self._pyarrow = with_parquet()
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
            fields = [(n, self._pyarrow.int64() if n in WHOLE else self._pyarrow.float64()) for n in names]
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
    return int(value) if name in WHOLE else round(value, 6)


def _place(name: str) -> tuple[int, int]:
    """Return what sorts columns: those of `COLUMNS`, then the modes by their number."""
    return (COLUMNS.index(name), 0) if name in COLUMNS else (len(COLUMNS), int(name.removeprefix("mode_")))
