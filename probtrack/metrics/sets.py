"""Distances between sets of talkers and sets of tracks: OSPA and GOSPA."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from probtrack._checks import as_positive
from probtrack.errors import InputError
from probtrack.metrics.association import best_pairs


def ospa(distance: Tensor, *, there: Tensor, said: Tensor, order: float = 1.0, cutoff: float = 1.0) -> Tensor:
    r"""Return the optimal sub-pattern assignment distance (...) of m talkers and n tracks.

    .. math:: \left[\frac{1}{\max(m, n)} \left(\min_\pi \sum_i \min(d_{i\pi(i)}, c)^p + c^p |m - n|\right)\right]^{1/p}

    in [0, c]; 0 of two empty sets.

    Args:
        distance: Of K talkers from L tracks (..., K, L).
        there: Which talkers there are (..., K) bool.
        said: Which tracks there are (..., L) bool.
        order: p >= 1.
        cutoff: c, in the unit of the distances.

    References:
        D. Schuhmacher, B.-T. Vo, B.-N. Vo, "A consistent metric for performance evaluation of multi-object filters",
        IEEE Transactions on Signal Processing 56(8), 2008, eq. (3).
    """
    gain, _ = _gains(distance, there, said, order, cutoff)
    larger = torch.maximum(there.sum(-1), said.sum(-1))
    cost = (cutoff**order * larger - gain.sum(-1)).clamp_min(0.0)  # a pair replaces the c^p of two by the smaller cost
    mean: Tensor = cost / larger.clamp_min(1)
    return mean.pow(1 / order)


def ospa_as_released(
    distance: Tensor, *, there: Tensor, said: Tensor, order: float = 1.0, cutoff: float = 1.0
) -> Tensor:
    """Return OSPA (...) as the scripts released with the LOCATA challenge compute it, to compare with their figures.

    They assign over the flattened matrix of distances, which counts one pair, the nearest, however many there are.
    """
    present = there[..., :, None] & said[..., None, :]
    check_order(order, cutoff)
    nearest = distance.where(present, cutoff).clamp_max(cutoff).flatten(-2)
    nearest = torch.nn.functional.pad(nearest, (0, 1), value=cutoff).amin(-1) ** order
    talkers, tracks = there.sum(-1), said.sum(-1)
    pair = nearest.where((talkers > 0) & (tracks > 0), 0.0)
    cost = pair + cutoff**order * (talkers - tracks).abs()
    mean: Tensor = cost / torch.maximum(talkers, tracks).clamp_min(1)
    return mean.pow(1 / order)


class Gospa(NamedTuple):
    """GOSPA and what it is made of.

    Attributes:
        distance: The metric (...), the sum of the others to the power 1/p.
        localisation: Sum of d^p over pairs (...).
        missed: c^p / 2 for each talker without a track (...).
        false: c^p / 2 for each track without a talker (...).
    """

    distance: Tensor
    localisation: Tensor
    missed: Tensor
    false: Tensor


def gospa(distance: Tensor, *, there: Tensor, said: Tensor, order: float = 2.0, cutoff: float = 1.0) -> Gospa:
    r"""Return the generalised OSPA metric (...) with alpha = 2, and its three parts.

    .. math:: \left[\min_\gamma \sum_{(i,j) \in \gamma} d_{ij}^p + \frac{c^p}{2} (m + n - 2 |\gamma|)\right]^{1/p}

    over one-to-one pairs gamma. It is not divided by the number of talkers, and a pair further apart than c is the same
    as a miss and a false track.

    Args:
        distance: Of K talkers from L tracks (..., K, L).
        there: Which talkers there are (..., K) bool.
        said: Which tracks there are (..., L) bool.
        order: p >= 1.
        cutoff: c, in the unit of the distances.

    References:
        A. S. Rahmathullah, A. F. Garcia-Fernandez, L. Svensson, "Generalized optimal sub-pattern assignment metric",
        20th International Conference on Information Fusion, 2017, proposition 1.
    """
    gain, paired = _gains(distance, there, said, order, cutoff)
    pairs, half = paired.sum(-1), cutoff**order / 2
    localisation = (cutoff**order * pairs - gain.sum(-1)).clamp_min(0.0)
    missed, false = half * (there.sum(-1) - pairs), half * (said.sum(-1) - pairs)
    return Gospa((localisation + missed + false) ** (1 / order), localisation, missed, false)


def _gains(distance: Tensor, there: Tensor, said: Tensor, order: float, cutoff: float) -> tuple[Tensor, Tensor]:
    """Return c^p - d^p of the best pairs (..., K), 0 without one, and which talkers have one: those nearer than c."""
    check_order(order, cutoff)
    present = there[..., :, None] & said[..., None, :]
    gain = (cutoff**order - distance**order).where(present & (distance < cutoff), 0.0)
    track = best_pairs(gain)
    paired = track >= 0
    if gain.shape[-1] == 0:
        return torch.zeros_like(track, dtype=gain.dtype), paired
    return gain.gather(-1, track.clamp_min(0)[..., None])[..., 0].where(paired, 0.0), paired


def check_order(order: float, cutoff: float) -> None:
    """Raise `InputError` unless these make a metric."""
    as_positive(cutoff, "cutoff")
    if not 1 <= order < math.inf:
        raise InputError(f"order must be finite and at least 1, got {order}")
