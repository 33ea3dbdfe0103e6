"""The score of one track file against the truth."""

from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from probtrack.errors import InputError
from probtrack.metrics.functional import azimuth_error, final_error, position_error, root_mean_square, track_lost
from probtrack.track_files import TrackTable

_LONGEST_GAP = 1.0  # s between two rows of the truth over which it is interpolated


@dataclass(frozen=True)
class Score:
    """Figures of one track; None where the files do not have what a figure needs.

    Attributes:
        frames: Frames that have a truth.
        missing: How many of them the track says nothing of; they enter no other figure.
        rmse: Root mean square position error [m] (S1 eq. 7).
        final_error: Mean position error over the last 0.5 s [m], if there is that much.
        lost: Whether that is above 0.1 m (S1 eq. 8).
        azimuth_rmse: Root mean square azimuth error [rad].
        azimuth_median: Median azimuth error [rad].
        azimuth_max: Largest azimuth error [rad].
    """

    frames: int
    missing: int
    rmse: float | None = None
    final_error: float | None = None
    lost: bool | None = None
    azimuth_rmse: float | None = None
    azimuth_median: float | None = None
    azimuth_max: float | None = None

    def as_dict(self) -> dict[str, float | bool | None]:
        """Return the figures by name."""
        return asdict(self)


def score(truth: TrackTable, track: TrackTable) -> Score:
    """Score `track` at its own times against `truth`, interpolated between rows at most 1 s apart.

    Raises:
        InputError: if the two share no time, or neither positions nor azimuths.
    """
    at = _Interpolation(truth.time, track.time)
    figures: dict[str, float | bool] = {}
    frames, missing = 0, 0
    if truth.position is not None and track.position is not None:
        axes = min(truth.position.shape[1], track.position.shape[1])
        error = position_error(track.position[:, :axes], at(truth.position[:, :axes]))
        present, frames, missing = _present(error, at(truth.position[:, :axes])[:, 0], track)
        figures |= _position_figures(present, track.time)
    true_azimuth, azimuth = truth.get("azimuth"), track.get("azimuth")
    if true_azimuth is not None and azimuth is not None:
        direction = at(torch.stack([true_azimuth.cos(), true_azimuth.sin()], -1))
        error = azimuth_error(azimuth, torch.atan2(direction[:, 1], direction[:, 0]))
        present, frames, missing = _present(error, direction[:, 0], track)
        figures["azimuth_rmse"] = float(root_mean_square(present))
        figures["azimuth_median"], figures["azimuth_max"] = float(present.median()), float(present.max())
    if not figures:
        raise InputError(f"{truth.path} and {track.path} share neither positions (x, y) nor azimuths")
    return Score(frames, missing, **figures)  # type: ignore[arg-type]


def _position_figures(error: Tensor, time: Tensor) -> dict[str, float | bool]:
    figures: dict[str, float | bool] = {"rmse": float(root_mean_square(error))}
    dt = float(time.diff().median()) if len(time) > 1 else 1.0
    if len(error) * dt > 0.5:
        figures["final_error"], figures["lost"] = float(final_error(error, dt)), bool(track_lost(error, dt))
    return figures


def _present(error: Tensor, truth: Tensor, track: TrackTable) -> tuple[Tensor, int, int]:
    """Return the errors that are known, how many frames have a truth, and how many of those no estimate."""
    known = error.isfinite()
    frames = int(truth.isfinite().sum())
    if not known.any():
        raise InputError(f"{track.path}: no frame has an estimate at a time that the truth covers")
    return error[known], frames, frames - int(known.sum())


class _Interpolation:
    """Linear interpolation from the times `known` (K,) to `wanted` (T,); NaN outside and in long gaps."""

    def __init__(self, known: Tensor, wanted: Tensor) -> None:
        after = torch.searchsorted(known.contiguous(), wanted.contiguous()).clamp(1, max(1, len(known) - 1))
        self.after = after.clamp_max(len(known) - 1)
        self.before = (after - 1).clamp_min(0)
        gap = known[self.after] - known[self.before]
        self.share = ((wanted - known[self.before]) / gap.clamp_min(1e-9))[:, None]
        # half a microsecond: files round times to one
        self.valid = (wanted >= known[0] - 1e-6) & (wanted <= known[-1] + 1e-6) & (gap <= _LONGEST_GAP)

    def __call__(self, values: Tensor) -> Tensor:
        between = torch.lerp(values[self.before], values[self.after], self.share)
        return between.masked_fill(~self.valid[:, None], torch.nan)
