"""Where talkers are, or are said to be: what metrics compare."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from probtrack.track_files import TrackTable
from probtrack.tracks import Track

TIME_ROUNDING = 1.01e-6
"""By how much two times that files round to a microsecond may differ [s]."""

_LONGEST_GAP = 1.0  # s between two rows of a table over which it is interpolated
_EVENT_AXES = (0, 2, 1, 1, 1, 3, 1, 1, 0)  # of each column, after those of the batch


class Talkers(NamedTuple):
    """K talkers at the times of T frames: the truth, or what a tracker says. NaN: nobody there, or not known.

    Truth and estimate are of one type, so that whatever tracks can be compared with whatever is known. The batch of
    the truth may have axes of size 1, shared by all runs.

    Attributes:
        time: (T,) [s].
        position: (T, *batch, K, A) [m].
        azimuth: (T, *batch, K) [rad].
        heading: (T, *batch, K) [rad].
        speech: Whether, or how probably, each talks (T, *batch, K), in [0, 1].
        covariance: Stated covariance of the position (T, *batch, K, A, A) [m^2].
        std_azimuth: Stated circular standard deviation of the azimuth (T, *batch, K) [rad].
        std_heading: Stated circular standard deviation of the heading (T, *batch, K) [rad].
        known: Whether it is known who is there and who is not (T, *batch) bool; None: at all frames.
    """

    time: Tensor
    position: Tensor | None = None
    azimuth: Tensor | None = None
    heading: Tensor | None = None
    speech: Tensor | None = None
    covariance: Tensor | None = None
    std_azimuth: Tensor | None = None
    std_heading: Tensor | None = None
    known: Tensor | None = None

    @property
    def num_frames(self) -> int:
        """Number of frames T."""
        return self.time.shape[0]

    @property
    def num_talkers(self) -> int:
        """Number of talkers K; 0 if there are only times."""
        one = self._shape()
        return one[-1] if one else 0

    @property
    def batch(self) -> tuple[int, ...]:
        """Shape of the batch."""
        return self._shape()[1:-1]

    @property
    def dt(self) -> float:
        """Median time between frames [s]; NaN of fewer than two."""
        return float(self.time.diff().median())

    def as_double(self, num_batch_axes: int) -> "Talkers":
        """Return all columns in float64, with axes of size 1 before those of the batch until there are that many."""

        def stretched(column: Tensor, events: int) -> Tensor:
            more = num_batch_axes - (column.ndim - 1 - events)
            column = column.double() if events else column
            return column.reshape(column.shape[:1] + (1,) * more + column.shape[1:])

        columns = zip(self[1:], _EVENT_AXES[1:], strict=True)
        return Talkers(
            self.time.double(), *(None if column is None else stretched(column, events) for column, events in columns)
        )

    def _shape(self) -> tuple[int, ...]:
        """Return (T, *batch, K)."""
        for column, events in zip(self[1:], _EVENT_AXES[1:], strict=True):
            if column is not None and events:
                return tuple(column.shape[: column.ndim - events + 1])
        return ()

    def between(self, begin: float, end: float) -> "Talkers":
        """Return the frames of `begin` <= time < `end` [s]."""
        inside = (self.time >= begin) & (self.time < end)
        return Talkers._make(None if column is None else column[inside] for column in self)

    @classmethod
    def of_track(cls, track: Track) -> "Talkers":
        """Return the one talker of `track`, with its batch (runs, recordings).

        Of a track that has no covariance, its standard deviations become a diagonal one.
        """
        covariance = torch.diag_embed(track.std.square()) if track.covariance is None else track.covariance

        def of_one(values: Tensor | None) -> Tensor | None:
            return None if values is None else values.double()[..., None]

        return cls(
            track.time.double(),
            track.position.double()[..., None, :],
            of_one(track.azimuth),
            of_one(track.heading),
            of_one(track.speech),
            covariance.double()[..., None, :, :],
            of_one(track.std_azimuth),
            of_one(track.std_heading),
        )

    @classmethod
    def of_tables(cls, tables: Sequence[TrackTable], time: Tensor) -> "Talkers":
        """Return the talkers of `tables`, one each, at the times `time` (T,) [s].

        Tables are interpolated between rows at most 1 s apart; outside, and in longer gaps, a talker is not known.
        Frames that no table covers are not `known`; at a row without a position its talker is known not to be there.
        What not all tables have is left out; of positions with and without a height the plane is kept. Spreads of
        axes (`std_x`, ...) become a diagonal covariance.
        """
        at = [Interpolation(table.time, time.double()) for table in tables]
        positions = [table.position for table in tables]
        position, covariance = None, None
        if all(one is not None for one in positions):
            axes = min(one.shape[1] for one in positions if one is not None)
            position = torch.stack(
                [f(one[:, :axes]) for f, one in zip(at, positions, strict=True) if one is not None], 1
            )
            stds = [[table.get(f"std_{axis}") for axis in "xyz"[:axes]] for table in tables]
            if all(std is not None for row in stds for std in row):
                spread = [f(torch.stack(row, -1)) for f, row in zip(at, stds, strict=True)]  # type: ignore[arg-type]
                covariance = torch.diag_embed(torch.stack(spread, 1).square())
        return cls(
            time.double(),
            position,
            _angles(tables, at, "azimuth"),
            _angles(tables, at, "heading"),
            _column(tables, at, "speech"),
            covariance,
            _column(tables, at, "std_azimuth"),
            None,
            torch.stack([one.valid for one in at]).any(0),
        )


class Interpolation:
    """Linear interpolation from the times `known` (K,) to `wanted` (T,); NaN outside and in long gaps."""

    def __init__(self, known: Tensor, wanted: Tensor) -> None:
        last = len(known) - 1
        after = torch.searchsorted(known.contiguous(), wanted.contiguous()).clamp_max(last)
        before = (after - 1).clamp_min(0)
        # a row at the very time is the truth, whatever its neighbours
        after = torch.where((wanted - known[before]).abs() <= TIME_ROUNDING, before, after)
        self.before = torch.where((wanted - known[after]).abs() <= TIME_ROUNDING, after, before)
        self.after = after
        gap = known[self.after] - known[self.before]
        self.share = ((wanted - known[self.before]) / gap.clamp_min(TIME_ROUNDING))[:, None]
        inside = (wanted >= known[0] - TIME_ROUNDING) & (wanted <= known[-1] + TIME_ROUNDING)
        self.valid = inside & (gap <= _LONGEST_GAP)

    def __call__(self, values: Tensor) -> Tensor:
        """Return `values` (K, J) at the wanted times (T, J)."""
        between = torch.lerp(values[self.before], values[self.after], self.share)
        return between.masked_fill(~self.valid[:, None], torch.nan)


def _angles(tables: Sequence[TrackTable], at: Sequence[Interpolation], name: str) -> Tensor | None:
    """Return a column of angles (T, K) [rad], interpolated the short way round."""
    columns = [table.get(name) for table in tables]
    if any(column is None for column in columns) or not columns:
        return None
    units = [f(torch.stack([c.cos(), c.sin()], -1)) for f, c in zip(at, columns, strict=True) if c is not None]
    return torch.stack([torch.atan2(unit[:, 1], unit[:, 0]) for unit in units], -1)


def _column(tables: Sequence[TrackTable], at: Sequence[Interpolation], name: str) -> Tensor | None:
    columns = [table.get(name) for table in tables]
    if any(column is None for column in columns) or not columns:
        return None
    return torch.cat([f(column[:, None]) for f, column in zip(at, columns, strict=True) if column is not None], -1)
