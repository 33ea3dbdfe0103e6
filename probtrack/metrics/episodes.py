"""What happens to the pairs of talkers and tracks over time: first detections, breaks and swaps."""

import torch
from torch import Tensor


def detected(track: Tensor, active: Tensor) -> Tensor:
    """Return whether each talker is active and has a track (T, ..., K)."""
    return active & (track >= 0)


def first_detections(track: Tensor, active: Tensor) -> tuple[Tensor, Tensor]:
    """Return where (T, ..., K) a talker has a track for the first time in a period of activity, and where again.

    Args:
        track: Which track belongs to each talker (T, ..., K), -1 for none.
        active: Whether each talks (T, ..., K).
    """
    hit = detected(track, active)
    hits = hit.cumsum(0)
    # hits before the period began: never falls, so that its running maximum is that of the last onset
    before = (hits - hit.long()).where(_onsets(active), 0).cummax(0).values
    return hit & (hits - before == 1), hit & (hits - before > 1)


def latencies(track: Tensor, active: Tensor, time: Tensor) -> Tensor:
    """Return from the onset of a period of activity to its first detection [s] (T, ..., K), NaN at other frames."""
    at = time.reshape(-1, *(1,) * (active.ndim - 1))
    onset = at.where(_onsets(active), -torch.inf).cummax(0).values
    return (at - onset).where(first_detections(track, active)[0], torch.nan)


def fragments(track: Tensor, active: Tensor) -> Tensor:
    """Return where (T, ..., K) a talker is detected again in a period, after a miss or by another track than before."""
    again = first_detections(track, active)[1]
    previous = torch.cat([torch.full_like(track[:1], -1), track[:-1]])
    return again & (track != previous)


def swaps(track: Tensor, active: Tensor) -> Tensor:
    """Return where (T, ..., K) an active talker's track is another than the last one it had, however long ago."""
    hit = detected(track, active)
    frame = torch.arange(len(track), device=track.device).reshape(-1, *(1,) * (track.ndim - 1))
    last = frame.where(hit, -1).cummax(0).values
    last = torch.cat([torch.full_like(last[:1], -1), last[:-1]])
    return hit & (last >= 0) & (track != track.gather(0, last.clamp_min(0)))


def _onsets(active: Tensor) -> Tensor:
    return active & ~torch.cat([torch.zeros_like(active[:1]), active[:-1]])
