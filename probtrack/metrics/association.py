"""Which track belongs to which talker: one-to-one pairs, the best of all that there are."""

import itertools
import math
from abc import ABC
from typing import Literal

import torch
from torch import Tensor

from probtrack._checks import as_positive
from probtrack.errors import InputError
from probtrack.metrics.functional import azimuth_error, position_error
from probtrack.metrics.metric import TrackMetric
from probtrack.metrics.one_talker import column
from probtrack.metrics.talkers import Talkers

_MOST_MAPS = 50_000  # ways of pairing that are tried for each frame: 8 talkers with 8 tracks are 40 320
_AT_ONCE = 2**22  # totals of ways held in memory


def best_pairs(gain: Tensor) -> Tensor:
    """Return the column (..., K) of each row of `gain` (..., K, L) in the one-to-one pairs of largest total gain.

    A pair whose gain is not above 0 is never made: its row gets -1. All ways of pairing are tried, for talkers are few.

    >>> best_pairs(torch.tensor([[3.0, 2.0, 0.0], [5.0, 1.0, 0.0]]))
    tensor([1, 0])

    Raises:
        InputError: if there are more than 50 000 ways, as from 9 talkers with 9 tracks on.
    """
    *batch, rows, columns = gain.shape
    if rows > columns:  # each column's row, turned round
        row = best_pairs(gain.mT)
        pairs = torch.full((*batch, rows + 1), -1, device=gain.device)
        order = torch.arange(columns, device=gain.device).expand(row.shape)
        return pairs.scatter(-1, row.where(row >= 0, rows), order)[..., :rows]
    if rows == 0:
        return torch.zeros(*batch, 0, dtype=torch.long, device=gain.device)
    if math.perm(columns, rows) > _MOST_MAPS:
        raise InputError(f"at most 8 talkers can be paired with 8 tracks, got {rows} with {columns}")
    gain = gain.nan_to_num(nan=0.0).clamp_min(0.0).reshape(math.prod(batch), rows * columns)
    ways = torch.tensor(list(itertools.permutations(range(columns), rows)), device=gain.device)
    cells = torch.arange(rows, device=gain.device) * columns + ways
    made = torch.zeros(len(ways), rows * columns, dtype=gain.dtype, device=gain.device).scatter(1, cells, 1.0)
    best = torch.cat([(some @ made.mT).argmax(-1) for some in gain.split(max(1, _AT_ONCE // len(ways)))])
    pairs = ways[best].where(gain.gather(1, cells[best]) > 0, -1)
    return pairs.reshape(*batch, rows)


def associate(distance: Tensor, gate: float, active: Tensor) -> Tensor:
    r"""Return which of L tracks belongs to each of K talkers (..., K), -1 for none, by `distance` (..., K, L).

    Pairs are made within the gate only: as many with talkers who are active as there can be, then as many with the
    others, then with the smallest sum of distances.

    Args:
        distance: Of talkers from tracks; NaN where either is not there.
        gate: Largest distance of a pair, in the same unit.
        active: Whether a talker talks (..., K) bool.
    """
    few = 1 + min(distance.shape[-2:])
    # distances add up to less than one pair is worth, and pairs with silent talkers to less than one with an active one
    worth = torch.where(active, few**2, few)[..., None] - distance / gate
    return best_pairs(worth.where(distance <= gate, 0.0))


class OfSets(TrackMetric, ABC):
    """A metric of any number of tracks and talkers, by distance or by direction.

    Args:
        limit: Distance at which a track is nobody's [m], or angle [rad].
        by: What is compared: positions, or azimuths alone.
    """

    one_talker = False

    def __init__(self, limit: float, by: Literal["position", "azimuth"]) -> None:
        super().__init__()
        if by not in ("position", "azimuth"):
            raise InputError(f"by must be position or azimuth, got {by}")
        as_positive(limit, "limit")
        self.limit, self.by = limit, by
        self.needs, self.wants = (by,), (by,)
        if by == "azimuth":
            self.name = f"{self.name}_azimuth"

    def distance(self, estimate: Talkers, truth: Talkers) -> Tensor:
        """Return the distances (T, *batch, K, L) of talkers from tracks, NaN where either is not there."""
        if self.by == "azimuth":
            return azimuth_error(column(estimate, "azimuth")[..., None, :], column(truth, "azimuth")[..., None])
        at, truly = column(estimate, "position"), column(truth, "position")
        axes = min(at.shape[-1], truly.shape[-1])
        return position_error(at[..., None, :, :axes], truly[..., None, :axes])

    def present(self, talkers: Talkers) -> Tensor:
        """Return whether each is there (T, *batch, K)."""
        values = column(talkers, self.by)
        return values.isfinite() if self.by == "azimuth" else values.isfinite().all(-1)

    def known(self, truth: Talkers) -> Tensor:
        """Return which frames count (T, *batch): where it is not known who is there nothing is right or wrong."""
        present = self.present(truth)
        whole = torch.ones(present.shape[:-1], dtype=torch.bool, device=present.device)
        return whole if truth.known is None else whole & truth.known
