"""Comparisons of studies in words: for a terminal, as Markdown, and as plain values."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from probtrack.evaluation.comparison import Comparison
from probtrack.evaluation.factors import heading, text
from probtrack.evaluation.rendering import decimals, interval_words, markdown, named, number, rich_table

if TYPE_CHECKING:
    from rich.table import Table

_FIGURES = ("first", "second", "difference", "low", "high", "p_value", "adjusted", "pairs", "scenes")
_USUAL = 0.05  # level of significance that most readers look for


def comparison_markdown(comparison: Comparison, first: str, second: str) -> str:
    """Return a comparison as Markdown, with what must be known of it below; `first` and `second` name the sides."""
    lines = [line for row in range(len(comparison.rows)) for line in _lines(comparison, row)]
    return markdown(_headings(comparison), lines, _left(comparison), comparison_notes(comparison, first, second))


def comparison_table(comparison: Comparison) -> "Table":
    """Return a comparison for the terminal."""
    sections = [_lines(comparison, row) for row in range(len(comparison.rows))]
    return rich_table(_headings(comparison), sections, _left(comparison))


def comparison_dict(comparison: Comparison, first: str, second: str) -> dict[str, Any]:
    """Return a comparison as plain values, None where there is no figure."""
    rows = [
        {**row, "metric": metric, "unit": unit}
        | {name: number(getattr(comparison, name)[i, j].item()) for name in _FIGURES}
        for i, row in enumerate(comparison.rows)
        for j, (metric, unit) in enumerate(comparison.metrics.items())
    ]
    sides = {"first": first, "second": second, "alone": comparison.alone}
    return {**sides, "level": comparison.level, "over": comparison.over, "rows": rows}


def comparison_notes(comparison: Comparison, first: str, second: str) -> list[str]:
    """Return what must be known of a comparison, a line each."""
    said = [f"A is {first}", f"B is {second}"]
    for side, runs in zip("AB", comparison.alone, strict=True):
        if runs:
            said.append(f"{runs} runs of {side} have no partner and do not count")
    said.append(f"[low, high]: {interval_words(comparison.level, comparison.over)}")
    flipped = "scenes" if comparison.over == "scenes" else "runs"
    said.append(f"p: of a difference as large if the signs of {flipped} were chance (permutation test)")
    if _several(comparison):
        said.append(f"p Holm: adjusted for the {np.isfinite(comparison.p_value).sum()} tests of this table")
    return said + _limits(comparison)


def _limits(comparison: Comparison) -> list[str]:
    """Return what no difference could show, for lack of scenes or pairs that change sign together."""
    what, units = ("scene", comparison.scenes) if comparison.over == "scenes" else ("pair", comparison.pairs)
    units = units[np.isfinite(comparison.p_value)]
    if not units.size:
        return []
    said = []
    fewest, most = (f"{n} {what}{'' if n == 1 else 's'}" for n in (units.min(), units.max()))
    lowest = 2.0 ** (1 - float(units.min()))
    if lowest > _USUAL:
        other = "; over runs it says nothing of other scenes" * (what == "scene")
        said.append(f"{fewest}: p cannot be below {lowest:g}{other}")
    together = min(1.0, units.size * 2.0 ** (1 - float(units.max())))
    if _several(comparison) and together > _USUAL:
        said.append(f"{most}: p Holm of {units.size} tests cannot be below {together:.2g}")
    return said


def _headings(comparison: Comparison) -> list[str]:
    names = [heading(name) for name in comparison.rows[0]]
    adjusted = ["p Holm"] if _several(comparison) else []
    return [*names, "metric", "A", "B", "A - B", "p", *adjusted, "pairs", "scenes"]


def _lines(comparison: Comparison, row: int) -> list[list[str]]:
    lines = []
    for j, (metric, unit) in enumerate(comparison.metrics.items()):
        everything = np.concatenate([comparison.first[:, j], comparison.second[:, j]])
        digits = decimals(everything, unit)
        labels = [text(value) if j == 0 else "" for value in comparison.rows[row].values()]
        means = [_figure(part[row, j], digits) for part in (comparison.first, comparison.second)]
        p_values = [_p(comparison.p_value[row, j]), *([_p(comparison.adjusted[row, j])] * _several(comparison))]
        counts = [str(comparison.pairs[row, j]), str(comparison.scenes[row, j])]
        difference = _difference(comparison, row, j, digits)
        lines.append([*labels, named(metric, unit), *means, difference, *p_values, *counts])
    return lines


def _difference(comparison: Comparison, row: int, j: int, digits: int) -> str:
    value, low, high = (part[row, j] for part in (comparison.difference, comparison.low, comparison.high))
    if not math.isfinite(value):
        return "-"
    interval = f" [{low:+.{digits}f}, {high:+.{digits}f}]" if math.isfinite(low) else ""
    return f"{value:+.{digits}f}{interval}"


def _figure(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def _p(value: float) -> str:
    return f"{value:.2g}" if math.isfinite(value) else "-"


def _left(comparison: Comparison) -> int:
    return len(comparison.rows[0]) + 1


def _several(comparison: Comparison) -> bool:
    return comparison.p_value.size > 1
