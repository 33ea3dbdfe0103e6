"""What talkers do at the times of frames, from tables of truth at times of their own."""

from typing import NamedTuple

import torch
from torch import Tensor

from probtrack.errors import InputError
from probtrack.geometry import wrap_angle
from probtrack.track_files import TrackTable

_ROUNDING = 1.01e-6  # s by which two times that files round to a microsecond may differ
_LONGEST_GAP = 1.0  # s between two rows of the truth over which it is interpolated, as scores do
_BEYOND = 0.04  # s before the first row and after the last for which they still hold: a walker goes 5 cm


class TruthFrames(NamedTuple):
    """Truth of K talkers at T frames; columns are None where the file does not have them.

    Where `known` is False (the file says nothing near that time) the other columns hold on to neighbouring rows, so
    that they are finite, and mean nothing.

    Attributes:
        position: (T, *batch, K, A), of the mouth [m].
        velocity: (T, *batch, K, A), of the mouth [m/s].
        azimuth: (T, *batch, K), of the mouth, seen from the array's centre [rad].
        heading: (T, *batch, K), where the mouth points [rad].
        body: (T, *batch, K), where the body faces [rad].
        speech: (T, *batch, K) bool.
        known: (T, *batch, K) bool.
    """

    position: Tensor | None
    velocity: Tensor | None
    azimuth: Tensor | None
    heading: Tensor | None
    body: Tensor | None
    speech: Tensor | None
    known: Tensor


def truth_at(tables: list[TrackTable], time: Tensor, dtype: torch.dtype = torch.float32) -> TruthFrames:
    """Return the truth of talkers, a table each, at `time` (T,) [s].

    At the time of a row it is that row. Between rows at most 1 s apart, positions and velocities are linear, angles
    go the short way round, and speech is that of the nearer row. Rows with an empty cell count as not there.

    Raises:
        InputError: for talkers with different columns, or one without a complete row.
    """
    one = [_Talker(table, time) for table in tables]
    if len({talker.names for talker in one}) > 1:
        raise InputError(f"{tables[0].path}: every talker of a truth must have the same columns")
    names = one[0].names
    axes = [axis for axis in "xyz" if axis in names]

    def linear(columns: list[str]) -> Tensor | None:
        if not set(columns) <= set(names):
            return None
        return torch.stack([torch.stack([t.linear(c) for c in columns], -1) for t in one], 1).to(dtype)

    def angle(column: str) -> Tensor | None:
        return torch.stack([t.angle(column) for t in one], 1).to(dtype) if column in names else None

    return TruthFrames(
        position=linear(axes) if axes[:2] == ["x", "y"] else None,
        velocity=linear([f"v{axis}" for axis in axes]) if axes else None,
        azimuth=angle("azimuth"),
        heading=angle("heading"),
        body=angle("body"),
        speech=torch.stack([t.nearest("speech") > 0.5 for t in one], 1) if "speech" in names else None,
        known=torch.stack([t.known for t in one], 1),
    )


class _Talker:
    """The rows of one talker before and after each of `wanted` (T,), and how far from one to the other."""

    def __init__(self, table: TrackTable, wanted: Tensor) -> None:
        self.columns = _complete(table)
        self.names = tuple(sorted(self.columns))
        time = self.columns["time"].contiguous()
        last = len(time) - 1
        # a row at the very time, give or take the rounding of files, is the truth, whatever its neighbours
        after = torch.searchsorted(time, wanted.double() - _ROUNDING).clamp_max(last)
        at_row = (wanted - time[after]).abs() <= _ROUNDING
        self.after, self.before = after, torch.where(at_row, after, (after - 1).clamp_min(0))
        self.before = torch.where(wanted > time[-1], after, self.before)
        gap = time[self.after] - time[self.before]
        self.share = ((wanted - time[self.before]) / gap.clamp_min(_ROUNDING)).masked_fill(gap == 0, 0.0)
        near = (wanted >= time[0] - _BEYOND) & (wanted <= time[-1] + _BEYOND)
        self.known = near & (gap <= _LONGEST_GAP)

    def linear(self, name: str) -> Tensor:
        column = self.columns[name]
        return torch.lerp(column[self.before], column[self.after], self.share)

    def angle(self, name: str) -> Tensor:
        before, after = self.columns[name][self.before], self.columns[name][self.after]
        # rows as they are, without the rounding of a wrap
        return torch.where(self.share == 0, before, wrap_angle(before + self.share * wrap_angle(after - before)))

    def nearest(self, name: str) -> Tensor:
        return self.columns[name][torch.where(self.share > 0.5, self.after, self.before)]


def _complete(table: TrackTable) -> dict[str, Tensor]:
    """Return the columns that have any numbers, at the rows that have all of them."""
    columns = {name: column for name, column in table.columns.items() if name != "track" and not column.isnan().all()}
    whole = torch.stack([column.isfinite() for column in columns.values()]).all(0)
    if not whole.any():
        raise InputError(f"{table.path}: a talker has no row without an empty cell")
    return {name: column[whole] for name, column in columns.items()}
