"""Pictures of studies: a panel a metric against a factor that is a number, in the shape of Figure 6 of S1."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from probtrack._files import check_suffix, check_writable
from probtrack.errors import InputError
from probtrack.evaluation.factors import Factors, heading, in_order, is_number, label, text, values_of
from probtrack.evaluation.rendering import averages, interval_words, named
from probtrack.evaluation.store import Store, StoredCell
from probtrack.evaluation.tables import StudyTable, started, tabulate
from probtrack.metrics.bootstrap import Over

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

SUFFIXES = (".png", ".pdf", ".svg")
_COLOURS = (
    "#1764ab", "#d9572b", "#2e8b57", "#7b4aa0", "#b8860b", "#444444", "#0b8a8f", "#c2327b", "#6aa9dd", "#8c564b",
)  # fmt: skip
_MARKERS = "osD^vP<X>*"
_DASHES: tuple[Any, ...] = ("-", (0, (4, 2)), (0, (1, 1.5)), (0, (5, 1.5, 1, 1.5)))
_MANY = 4  # panels in a row


def check_picture_of_study(path: str | Path) -> None:
    """Raise `InputError` unless a picture can be written to `path`."""
    check_suffix(Path(path), "a picture", SUFFIXES)
    check_writable(Path(path))


def plot_study(
    store: Store,
    output: str | Path,
    *,
    x: str | None = None,
    rows: Sequence[str] | None = None,
    metrics: Sequence[str] | None = None,
    level: float = 0.95,
    over: Over = "scenes",
    log_x: bool = False,
) -> StudyTable:
    """Draw figures of a study with their intervals as bands, and return them.

    Args:
        store: The study, finished or not; a figure of which some runs are not finished is drawn hollow.
        output: Picture file: .png, .pdf or .svg.
        x: Factor along the axis, a number; by default the one with most values.
        rows: Factors of which each combination is a line; all others that vary by default.
        metrics: One panel each; all of the study by default.
        level: Probability of the bands.
        over: What another study would draw anew, see `tabulate`.
        log_x: Whether the axis is logarithmic, for factors such as the number of particles.

    Raises:
        ImportError: without matplotlib, with the line that installs it.
        InputError: for names that are not known, a factor that is no number, a picture that cannot be written.
    """
    check_picture_of_study(output)
    cells = started(store)
    x = _axis(cells, x, rows or (), log_x)
    table = tabulate(store, rows=rows, columns=(x,), metrics=metrics, level=level, over=over)
    figure, panels = _canvas(len(table.metrics))
    for j, axis in enumerate(panels):
        lines = [_draw(axis, table, row, j, style) for row, style in enumerate(_styles(table))]
        _finish(axis, table, j, x, log_x)
    hollow = ["hollow: not all runs finished"] if (table.runs < table.planned).any() else []
    below = [f"bands: {interval_words(level, over)}", *hollow, *averages(table)]
    figure.supxlabel("; ".join(below), fontsize=8, color="0.4", parse_math=False)
    _name_lines(figure, lines)
    figure.savefig(output, dpi=120)
    return table


def _axis(cells: Sequence[StoredCell], wanted: str | None, rows: Sequence[str], log_x: bool) -> str:
    """Return the factor along the axis."""
    every = Factors.of(cells)
    for name in rows:
        every.known(name, "rows")
    names = [n for n in (*every.settings, *every.conditions) if n not in rows] if wanted is None else [wanted]
    values = {every.known(name, "x"): in_order(values_of(cell).get(name) for cell in cells) for name in names}
    numbers = {name: v for name, v in values.items() if all(is_number(one) for one in v)}
    if wanted is not None and not numbers:
        raise InputError(f"x: {wanted} is no number: {', '.join(map(text, values[wanted]))}")
    name = max(numbers, key=lambda one: len(numbers[one]), default="")
    if wanted is None and len(numbers.get(name, ())) < 2:
        raise InputError("x: no factor of the study has several numbers: name one with --x")
    if log_x and numbers[name][0] <= 0:
        raise InputError(f"log_x: values of {name} must be positive, got {numbers[name][0]:g}")
    return name


def _canvas(panels: int) -> tuple["Figure", list["Axes"]]:
    try:
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine
    except ImportError:
        raise ImportError("pictures need matplotlib: pip install 'probtrack[report]'") from None
    across = min(panels, _MANY)
    down = -(-panels // across)
    layout = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.08)
    figure = Figure(figsize=(4.4 * across + 1.8, 3.7 * down), layout=layout)
    axes = figure.subplots(down, across, squeeze=False).ravel()
    for unused in axes[panels:]:
        unused.remove()
    return figure, list(axes[:panels])


def _styles(table: StudyTable) -> list[dict[str, Any]]:
    """Return how each row is drawn: colours and markers by its first factor, dashes by the others."""
    firsts = list(dict.fromkeys(next(iter(row.values()), None) for row in table.rows))
    rests = list(dict.fromkeys(tuple(row.values())[1:] for row in table.rows))
    styles = []
    for row in table.rows:
        values = tuple(row.values())
        i, k = firsts.index(values[0] if values else None), rests.index(values[1:])
        words = ", ".join(label(*factor) for factor in row.items()) or "all"
        styles.append(
            {
                "color": _COLOURS[i % len(_COLOURS)],
                "marker": _MARKERS[i % len(_MARKERS)],
                "ls": _DASHES[k % len(_DASHES)],
                "label": words,
            }
        )
    return styles


def _draw(axis: "Axes", table: StudyTable, row: int, j: int, style: dict[str, Any]) -> "Line2D":
    at = np.array([next(iter(column.values())) for column in table.columns], dtype=float)
    value, low, high = (part[row, :, j] for part in (table.value, table.low, table.high))
    there = np.isfinite(value)
    partial = there & (table.runs < table.planned)[row]
    (line,) = axis.plot(at[there], value[there], ms=4.5, lw=1.3, **style)
    axis.plot(at[partial], value[partial], style["marker"], ms=4.5, mfc="white", mec=style["color"], zorder=3)
    axis.fill_between(at[there], low[there], high[there], color=style["color"], alpha=0.13, lw=0)
    return line


def _name_lines(figure: "Figure", lines: list["Line2D"]) -> None:
    """Add the legend, with names as they are: `_name` is not left out of it, and `$name$` is no formula."""
    legend = figure.legend(lines, ["-"] * len(lines), loc="outside right upper", frameon=False)
    for entry, line in zip(legend.get_texts(), lines, strict=True):
        entry.set(text=str(line.get_label()), parse_math=False)


def _finish(axis: "Axes", table: StudyTable, j: int, x: str, log_x: bool) -> None:
    metric, unit = list(table.metrics.items())[j]
    axis.set_xlabel(heading(x), parse_math=False)
    axis.set_ylabel(named(metric, unit), parse_math=False)
    at = [next(iter(column.values())) for column in table.columns]
    if log_x:
        axis.set_xscale("log")
    if len(at) <= 8:
        axis.set_xticks(at, [f"{value:g}" for value in at])
        axis.minorticks_off()
    if np.nanmin(table.value[:, :, j], initial=0) >= 0:
        axis.set_ylim(bottom=0)
    axis.grid(color="0.9")
    axis.set_axisbelow(True)
