"""Cells of a study in groups, and the scores of their runs as arrays."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probtrack.evaluation.factors import in_order, values_of
from probtrack.evaluation.store import Scores, StoredCell
from probtrack.metrics.bootstrap import Over

Combination = dict[str, Any]
Numbers = NDArray[np.float64]


class Groups:
    """Cells by what they have along the rows and columns of a table, G = L C groups.

    Args:
        cells: All cells of a study by number, finished or not.
        rows: Factors along rows.
        columns: Factors along columns.

    Attributes:
        rows: Different combinations of values along rows, L of them.
        columns: Those along columns, C of them.
        scenes: Recordings with finished runs in each group (G,).
        runs: Finished runs in each group (G,).
        planned: Runs that each group is to have (G,).
    """

    def __init__(self, cells: Sequence[StoredCell], rows: Sequence[str], columns: Sequence[str]) -> None:
        values = [values_of(cell) for cell in cells]
        self.rows, row = _combinations(values, rows)
        self.columns, column = _combinations(values, columns)
        self._group = row * len(self.columns) + column
        self._id = np.array([cell.id for cell in cells])  # in order
        self._scene = np.unique([cell.scene for cell in cells], return_inverse=True)[1]
        runs = np.array([cell.runs for cell in cells])
        self._done = done = np.array([cell.finished is not None for cell in cells])
        self._seconds = np.array([cell.seconds or 0.0 for cell in cells]) * done
        self._heard = np.array([cell.duration or 0.0 for cell in cells]) * runs * done
        self.planned = self._sums(runs)
        self.runs = self._sums(runs * done)
        pairs = np.unique(np.stack([self._group, self._scene])[:, done], axis=1)
        self.scenes = np.bincount(pairs[0], minlength=self.planned.size)

    def seconds(self) -> Numbers:
        """Return what a run takes in each group [s], NaN where none is finished (G,)."""
        return ratio(self._sums(self._seconds), self.runs)

    def real_time_factors(self) -> Numbers:
        """Return what a run takes over the length of its recording, NaN where none is finished (G,)."""
        return ratio(self._sums(self._seconds), self._sums(self._heard))

    def arrays(self, scores: Scores, over: Over) -> tuple[Numbers, Numbers]:
        """Return numerators and denominators (G, S, R), NaN where a group has less than others.

        Of S are recordings; with `over="runs"` it is cells, since what was put together is not to be mixed.
        """
        of_run = np.searchsorted(self._id, scores.cell)
        known = self._done[of_run]  # a cell that another process has finished since does not count yet
        of_run = of_run[known]
        unit = self._scene if over == "scenes" else np.arange(len(self._scene))
        # runs in the order of group, unit, and cell within it; the place of each in its group and unit follows
        order = np.lexsort((of_run, unit[of_run], self._group[of_run]))
        group, within = self._group[of_run][order], unit[of_run][order]
        begins = np.ones(len(order), dtype=bool)
        begins[1:] = (np.diff(group) != 0) | (np.diff(within) != 0)
        block = np.cumsum(begins) - 1
        run = np.arange(len(order)) - np.flatnonzero(begins)[block]
        first = np.searchsorted(group[begins], group[begins])  # number of the first block of its group
        place = (np.arange(len(first)) - first)[block]
        size = (self.planned.size, *(int(n.max(initial=-1)) + 1 for n in (place, run)))
        total, count = np.full(size, np.nan), np.full(size, np.nan)
        total[group, place, run] = scores.numerator[known][order]
        count[group, place, run] = scores.denominator[known][order]
        return total, count

    def _sums(self, of_cells: NDArray[Any]) -> NDArray[Any]:
        sums = np.bincount(self._group, of_cells, len(self.rows) * len(self.columns))
        return sums.astype(of_cells.dtype)


def _combinations(values: list[Combination], names: Sequence[str]) -> tuple[list[Combination], NDArray[np.int64]]:
    """Return the different combinations of the factors `names` in order, and the number of each cell's."""
    rank = {name: {v: i for i, v in enumerate(in_order(one.get(name) for one in values))} for name in names}
    keys = [tuple(rank[name][one.get(name)] for name in names) for one in values]
    different = sorted(set(keys))
    number = {key: i for i, key in enumerate(different)}
    back = {name: list(ranks) for name, ranks in rank.items()}
    combinations = [{name: back[name][i] for name, i in zip(names, key, strict=True)} for key in different]
    return combinations, np.array([number[key] for key in keys], dtype=np.int64)


def ratio(above: NDArray[Any], below: NDArray[Any]) -> Numbers:
    """Return `above` / `below` (G,), NaN where there is nothing below."""
    return np.asarray(np.divide(above, below, out=np.full(len(above), np.nan), where=below > 0))
