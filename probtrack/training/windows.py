"""Truncated back-propagation: gradients that reach back over some frames only."""

from typing import Any

import torch
from torch import Tensor

from probtrack._checks import check_int
from probtrack.filters import Belief, Cloud, NoiseStream, ParticleFilter


def run_in_windows(
    tracked: ParticleFilter,
    belief: Belief,
    observations: Any,
    dt: float | Tensor,
    noise: NoiseStream,
    window: int | None,
) -> Cloud:
    """Return the clouds of a sequence, through which gradients reach back to the beginning of a window of frames only.

    In value they are those of `tracked.run`. Gradients of long sequences grow and scatter; those of windows are biased,
    by what earlier frames owe to the parameters, and steady.

    Args:
        tracked: The filter.
        belief: Before the first frame.
        observations: (T, *batch, ...).
        dt: As in `ParticleFilter.run`.
        noise: Random numbers of the runs.
        window: Frames; all if None.

    Raises:
        InputError: for a window of no frame; and as `ParticleFilter.run` does.
    """
    # without any frame, one window of none: the filter says what is wrong
    frames = max(1, len(observations if isinstance(observations, Tensor) else observations[0]))
    width = frames if window is None else check_int(window, "window", low=1)
    pieces = []
    for start in range(0, frames, width):
        here = slice(start, start + width)
        seen = (
            observations[here]
            if isinstance(observations, Tensor)
            else type(observations)(*(x[here] for x in observations))
        )
        steps = dt[here] if isinstance(dt, Tensor) and dt.ndim > 0 else dt
        belief, cloud = tracked.run(belief, seen, steps, noise)
        belief = Belief._make(None if x is None else x.detach() for x in belief)
        pieces.append(cloud)
    columns = zip(*pieces, strict=True)
    return Cloud._make(None if column[0] is None else torch.cat(column) for column in columns)
