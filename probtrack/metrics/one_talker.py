"""Errors of one track against one talker, and means over the frames that count."""

import torch
from torch import Tensor

from probtrack.errors import InputError
from probtrack.metrics.functional import azimuth_error, position_error
from probtrack.metrics.metric import Parts
from probtrack.metrics.talkers import Talkers


def position_errors(estimate: Talkers, truth: Talkers) -> Tensor:
    """Return the position errors (T, *batch) [m] of one talker, in the axes that both have.

    NaN where the truth is not known: such frames do not count. Infinite where it is known and the estimate is missing:
    a track that says nothing is never a good one.
    """
    at, truly = column(estimate, "position")[..., 0, :], column(truth, "position")[..., 0, :]
    axes = min(at.shape[-1], truly.shape[-1])
    return _judged(position_error(at[..., :axes], truly[..., :axes]), truly[..., :axes].isfinite().all(-1))


def angle_errors(estimate: Talkers, truth: Talkers, name: str) -> Tensor:
    """Return the errors (T, *batch) [rad] of the azimuth or heading of one talker, NaN and infinite likewise."""
    truly = column(truth, name)[..., 0]
    return _judged(azimuth_error(column(estimate, name)[..., 0], truly), truly.isfinite())


def column(talkers: Talkers, name: str) -> Tensor:
    """Return a column that must be there."""
    values: Tensor | None = getattr(talkers, name)
    if values is None:
        raise InputError(f"talkers must have {name}, got none")
    return values


def sum_over_frames(values: Tensor) -> Parts:
    """Return the sums (*batch) of `values` (T, *batch) over the frames where they are not NaN, and their number."""
    known = ~values.isnan()
    return Parts(values.where(known, 0.0).sum(0), known.sum(0).to(values.dtype))


def one_a_run(figures: Tensor) -> Parts:
    """Return `figures` (*batch), one of each run, as parts of their mean over runs; NaN has nothing to judge."""
    known = ~figures.isnan()
    return Parts(figures.where(known, 0.0), known.to(figures.dtype))


def _judged(error: Tensor, known: Tensor) -> Tensor:
    return error.nan_to_num(nan=torch.inf, posinf=torch.inf).where(known, torch.nan)
