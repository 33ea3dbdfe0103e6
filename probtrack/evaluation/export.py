"""Runs of a study as a table of pandas, one row each (extra `report`)."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from probtrack._files import check_suffix, check_writable
from probtrack.evaluation.database import DamagedStoreError
from probtrack.evaluation.factors import SCENE, Factors, is_number, text
from probtrack.evaluation.salvage import Runs, runs_of, salvage
from probtrack.evaluation.store import Store, StoredCell

if TYPE_CHECKING:
    from pandas import DataFrame

SUFFIXES = (".csv", ".parquet")


def runs_table(store: Store) -> "DataFrame":
    """Return one row for each finished run of a study: its settings, conditions, scene, run, seed, and each metric.

    A metric's value is numerator over denominator, NaN where a run has nothing to judge; a share is not times 100.

    Raises:
        ImportError: without pandas, with the line that installs it.
    """
    return _frame(runs_of(store))


def export_runs(path: str | Path, output: str | Path) -> str | None:
    """Write the runs of the store at `path` to a file, as `runs_table` has them.

    Args:
        path: The store. Of a damaged one what can be read is written.
        output: .csv or .parquet.

    Returns:
        What could not be read, in one line; None if all could.

    Raises:
        ImportError: without pandas, or pyarrow for Parquet, with the line that installs them.
        InputError: for a store of which nothing can be read, and an output that cannot be written.
    """
    suffix = check_suffix(Path(output), "a table of runs", SUFFIXES)
    check_writable(Path(output))
    try:
        with Store(path) as store:
            runs = runs_of(store)
    except DamagedStoreError:
        runs = salvage(path)
    table = _frame(runs)
    try:
        table.to_csv(output, index=False) if suffix == ".csv" else table.to_parquet(output, index=False)
    except ImportError:
        raise ImportError("Parquet needs pyarrow: pip install 'probtrack[report]'") from None
    return runs.warning


def _frame(runs: Runs) -> "DataFrame":
    try:
        from pandas import DataFrame
    except ImportError:
        raise ImportError("tables of runs need pandas: pip install 'probtrack[report]'") from None
    every = Factors.of(runs.cells)
    first = next(iter(runs.scores.values()))
    at = np.searchsorted([cell.id for cell in runs.cells], first.cell)
    columns: dict[str, Any] = {}
    for name in every.settings:
        columns[name] = _column([cell.settings.get(name) for cell in runs.cells])[at]
    for name in every.conditions:
        columns[name] = _column([cell.conditions.get(name) for cell in runs.cells])[at]
    columns |= {SCENE: _column([cell.scene for cell in runs.cells])[at], "run": first.run, "seed": _seeds(runs)}
    table = DataFrame(columns)
    table["seed"] = table["seed"].astype("Int64")  # which knows what is missing, and takes 56 bits
    for name, scores in runs.scores.items():
        undefined = np.full(len(scores.numerator), np.nan)
        known = scores.denominator != 0
        table[name] = np.divide(scores.numerator, scores.denominator, out=undefined, where=known)
    return table


def _column(values: list[Any]) -> Any:
    """Return values as an array of one kind: numbers as they are, anything mixed with names as text."""
    known = [value for value in values if value is not None]
    if known and all(is_number(value) for value in known):
        return np.array([np.nan if value is None else value for value in values])
    if known and all(isinstance(value, bool) for value in known):
        return np.array(values, dtype=object)
    return np.array([None if value is None else text(value) for value in values], dtype=object)


def _seeds(runs: Runs) -> Any:
    def of(cell: StoredCell) -> list[int | None]:
        known = runs.seeds.get(cell.scene, [])
        return [*known] if len(known) == cell.runs else [None] * cell.runs

    return np.array([seed for cell in runs.cells for seed in of(cell)], dtype=object)
