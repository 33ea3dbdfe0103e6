"""The score of one track file against the truth."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from probtrack.errors import InputError
from probtrack.metrics.functional import (
    azimuth_error,
    final_error,
    frames_within,
    position_error,
    root_mean_square,
    track_lost,
)
from probtrack.metrics.talkers import TIME_ROUNDING, Interpolation
from probtrack.track_files import TrackTable

_Figures = Callable[[Tensor, Tensor], dict[str, float | bool]]


@dataclass(frozen=True)
class Score:
    """Figures of one track; None where the files do not have what a figure needs.

    Attributes:
        frames: Frames that have a truth, of position or azimuth.
        missing: How many of them have no estimate of the position, or of the azimuth if those are more; they
            enter no other figure.
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
    at = Interpolation(truth.time, track.time)
    figures: dict[str, float | bool] = {}
    frames, missing = 0, 0
    for error, covered, figures_of in _errors(truth, track, at):
        known = error.isfinite()
        frames = max(frames, int(covered.sum()))
        missing = max(missing, int((covered & ~known).sum()))
        if known.any():
            figures |= figures_of(error[known], track.time)
    if not figures:
        raise InputError(f"{track.path}: no frame has an estimate at a time that the truth {truth.path} covers")
    return Score(frames, missing, **figures)  # type: ignore[arg-type]


def _errors(truth: TrackTable, track: TrackTable, at: Interpolation) -> Iterator[tuple[Tensor, Tensor, _Figures]]:
    """Yield the errors (T,) that both tables allow, where there is a truth, and what makes figures of them."""
    true_azimuth, azimuth = truth.get("azimuth"), track.get("azimuth")
    have_positions = truth.position is not None and track.position is not None
    if not have_positions and (true_azimuth is None or azimuth is None):
        raise InputError(f"{truth.path} and {track.path} share neither positions (x, y) nor azimuths")
    if truth.position is not None and track.position is not None:
        axes = min(truth.position.shape[1], track.position.shape[1])
        place = at(truth.position[:, :axes])
        yield position_error(track.position[:, :axes], place), place.isfinite().all(-1), _position_figures
    if true_azimuth is not None and azimuth is not None:
        direction = at(torch.stack([true_azimuth.cos(), true_azimuth.sin()], -1))
        angle = torch.atan2(direction[:, 1], direction[:, 0])
        yield azimuth_error(azimuth, angle), angle.isfinite(), _azimuth_figures


def _position_figures(error: Tensor, time: Tensor) -> dict[str, float | bool]:
    figures: dict[str, float | bool] = {"rmse": float(root_mean_square(error))}
    # files round times to a microsecond: a hair more, so that 0.5 s of frames of 1/30 s are 15 and not 16
    dt = float(time.diff().median()) + 2 * TIME_ROUNDING if len(time) > 1 else 0.0
    if dt > 0 and len(error) >= frames_within(0.5, dt):
        figures["final_error"], figures["lost"] = float(final_error(error, dt)), bool(track_lost(error, dt))
    return figures


def _azimuth_figures(error: Tensor, _: Tensor) -> dict[str, float | bool]:
    return {
        "azimuth_rmse": float(root_mean_square(error)),
        "azimuth_median": float(error.quantile(0.5)),
        "azimuth_max": float(error.max()),
    }
