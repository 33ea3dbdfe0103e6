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
        scenes: Scenes with finished runs in each group (G,); recordings of one origin are one scene.
        runs: Finished runs in each group (G,).
        planned: Runs that each group is to have (G,).
    """

    def __init__(self, cells: Sequence[StoredCell], rows: Sequence[str], columns: Sequence[str]) -> None:
        values = [values_of(cell) for cell in cells]
        (self.rows, row), (self.columns, column) = (_combinations(values, names) for names in (rows, columns))
        self._group = row * len(self.columns) + column
        self._id = np.array([cell.id for cell in cells])  # in order
        self._scene = np.unique([cell.origin for cell in cells], return_inverse=True)[1]
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

        S are scenes, with all their recordings: those at other levels of noise are no new draw of a scene. With
        `over="runs"` it is cells, since what was put together is not to be mixed.
        """
        cells, begins, runs = np.unique(scores.cell, return_index=True, return_counts=True)
        cell = np.searchsorted(self._id, cells)
        known = self._done[cell]  # one that another process has finished since does not count yet
        cell, begins, runs = cell[known], begins[known], runs[known]
        unit = self._scene[cell] if over == "scenes" else cell
        order = np.lexsort((cell, unit, self._group[cell]))
        group, unit, runs, begins = self._group[cell][order], unit[order], runs[order], begins[order]
        # blocks of one group and unit, the place of each in its group, and of each cell's first run in its block
        new = np.append(True, (np.diff(group) != 0) | (np.diff(unit) != 0))[: len(group)]
        block = np.cumsum(new) - 1
        place = (np.arange(new.sum()) - np.searchsorted(group[new], group[new]))[block]
        before = np.cumsum(runs) - runs
        first = before - before[new][block]
        size = (self.planned.size, int(place.max(initial=-1)) + 1, int((first + runs).max(initial=0)))
        within = np.arange(runs.sum()) - np.repeat(before, runs)
        to = np.repeat(np.ravel_multi_index((group, place, first), size) if len(group) else group, runs) + within
        taken = np.repeat(begins, runs) + within
        total, count = np.full(size, np.nan), np.full(size, np.nan)
        total.flat[to] = scores.numerator[taken]
        count.flat[to] = scores.denominator[taken]
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
    """Return `above` / `below`, NaN where there is nothing below."""
    return np.asarray(np.divide(above, below, out=np.full(above.shape, np.nan), where=below > 0))
