"""Tables of studies in words: for a terminal, as Markdown, and as plain values."""

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from probtrack.evaluation.factors import heading, label, text
from probtrack.evaluation.grouping import Numbers
from probtrack.evaluation.tables import StudyTable

if TYPE_CHECKING:
    from rich.table import Table

_NONE = "-"
_PART = "*"  # marks what is not finished


def as_markdown(table: StudyTable) -> str:
    """Return a table as Markdown, with what must be known of it below."""
    everything = range(len(table.columns))
    lines = [line for row in range(len(table.rows)) for line in _lines(table, row, everything)]
    return markdown(_headings(table, everything, ", "), lines, len(_row_names(table)) + 1, notes(table))


def rich_tables(table: StudyTable, width: int | None) -> list["Table"]:
    """Return a table for the terminal, in several below each other if `width` characters do not hold all columns.

    Where columns are parted, those of the same first factor stay together if they can, as in Table 2 of S1.
    """
    pieces = []
    for columns in _fitting(table, width):
        sections = [list(_lines(table, row, columns)) for row in range(len(table.rows))]
        pieces.append(rich_table(_headings(table, columns, "\n"), sections, len(_row_names(table)) + 1))
    return pieces


def rich_table(headings: Sequence[str], sections: Sequence[Sequence[Sequence[str]]], left: int) -> "Table":
    """Return lines in sections as a table for the terminal; the first `left` columns are names, the others figures."""
    from rich.table import Table
    from rich.text import Text  # plain: brackets are intervals and units, not markup

    table = Table()
    for i, words in enumerate(headings):
        table.add_column(Text(words), justify="left" if i < left else "right", no_wrap=i >= left)
    for lines in sections:
        for line in lines:
            table.add_row(*map(Text, line))
        table.add_section()
    return table


def markdown(headings: Sequence[str], lines: Sequence[Sequence[str]], left: int, below: Sequence[str]) -> str:
    """Return lines as a Markdown table with notes below; the first `left` columns are names, the others figures."""
    rule = "|" + "---|" * left + "---:|" * (len(headings) - left)
    table = [_markdown_line(headings), rule, *map(_markdown_line, lines)]
    return "\n".join([*table, "", *(f"- {note}" for note in below)])


def as_dict(table: StudyTable) -> dict[str, Any]:
    """Return a table as plain values: one group for each row and column, None where there is no figure."""

    def figures(i: int, c: int) -> dict[str, Any]:
        parts = zip(table.metrics.items(), table.value[i, c], table.low[i, c], table.high[i, c], strict=True)
        return {
            name: {"value": number(value), "low": number(low), "high": number(high), "unit": unit}
            for (name, unit), value, low, high in parts
        }

    groups = [
        {
            **row,
            **column,
            "scenes": int(table.scenes[i, c]),
            "runs": int(table.runs[i, c]),
            "planned": int(table.planned[i, c]),
            "metrics": figures(i, c),
        }
        for i, row in enumerate(table.rows)
        for c, column in enumerate(table.columns)
    ]
    return {
        "study": str(table.path),
        **table.progress._asdict(),
        "level": table.level,
        "over": table.over,
        "fixed": table.fixed,
        "averaged": table.averaged,
        "groups": groups,
    }


def notes(table: StudyTable) -> list[str]:
    """Return what must be known of a table, a line each."""
    said = [f"{table.path}: {table.progress}"]
    if table.fixed:
        said.append(f"everywhere: {', '.join(label(name, value) for name, value in table.fixed.items())}")
    said += averages(table)
    there = table.runs > 0
    said.append(f"a figure is of {_between(table.scenes[there], 'scene')}, {_between(table.runs[there], 'run')}")
    if (table.runs < table.planned).any():
        said.append(f"{_PART} some of its runs are not finished")
    if np.isfinite(table.low).any():
        said.append(f"[low, high]: {interval_words(table.level, table.over)}")
    if _shows_none_or_all(table):
        said.append(f"a share of 0 or 100 % has the exact (Clopper-Pearson) interval of as many draws as {table.over}")
    if table.over == "scenes" and table.scenes[there].min() == 1:
        said.append("of one scene there is no interval over scenes, but one over runs")
    return said


def _shows_none_or_all(table: StudyTable) -> bool:
    """Return whether there is a share of none or all with an interval."""
    shares = [unit == "%" for unit in table.metrics.values()]
    value, low = table.value[..., shares], table.low[..., shares]
    return bool((np.isfinite(low) & ((value == 0) | (value == 100))).any())


def averages(table: StudyTable) -> list[str]:
    """Return what the figures are averages over, a factor each."""
    return [f"averaged over {heading(name)}: {', '.join(map(text, v))}" for name, v in table.averaged.items()]


def interval_words(level: float, over: str) -> str:
    """Return what an interval is."""
    drawn = "scenes drawn anew, and runs within them" if over == "scenes" else "runs drawn anew, of the same scenes"
    return f"{100 * level:g} % bootstrap interval, {drawn}"


def decimals(values: Numbers, unit: str) -> int:
    """Return how many decimals the figures of a metric want: as S1 has them, more where small ones would vanish.

    >>> decimals(np.array([0.063, 0.359]), "m"), decimals(np.array([0.0, 88.7]), "%"), decimals(np.array([12.3]), "")
    (3, 1, 1)
    """
    sizes = np.abs(values[np.isfinite(values) & (values != 0)])
    if unit == "%" or not sizes.size:
        return 1
    most = 3 if unit in ("m", "rad") else 2 - math.floor(math.log10(sizes.max()))
    return int(np.clip(max(most, 1 - math.floor(math.log10(np.median(sizes)))), 0, 6))


def named(metric: str, unit: str) -> str:
    """Return a metric with its unit."""
    return f"{metric} [{unit}]" if unit else metric


def _lines(table: StudyTable, row: int, columns: Sequence[int]) -> Iterator[list[str]]:
    """Yield a line for each metric of a row, the first with the row's factors."""
    labels = [text(table.rows[row][name]) for name in _row_names(table)]
    for j, (metric, unit) in enumerate(table.metrics.items()):
        digits = decimals(table.value[:, :, j], unit)
        cells = [_cell(table, row, column, j, digits) for column in columns]
        yield [*(labels if j == 0 else [""] * len(labels)), named(metric, unit), *cells]


def _cell(table: StudyTable, row: int, column: int, j: int, digits: int) -> str:
    value, low, high = (float(part[row, column, j]) for part in (table.value, table.low, table.high))
    if not math.isfinite(value):
        return _NONE
    part = _PART if table.runs[row, column] < table.planned[row, column] else ""
    interval = f" [{low:.{digits}f}, {high:.{digits}f}]" if math.isfinite(low) else ""
    return f"{value:.{digits}f}{part}{interval}"


def _headings(table: StudyTable, columns: Sequence[int], between: str) -> list[str]:
    above = [between.join(label(*factor) for factor in table.columns[column].items()) or "all" for column in columns]
    return [*(heading(name) for name in _row_names(table)), "metric", *above]


def _row_names(table: StudyTable) -> list[str]:
    return list(table.rows[0])


def _fitting(table: StudyTable, width: int | None) -> list[list[int]]:
    """Return the columns of each of the tables that fit below each other."""
    everything = list(range(len(table.columns)))
    headings = _headings(table, everything, "\n")
    lines = [line for row in range(len(table.rows)) for line in _lines(table, row, everything)]
    wide = [
        max(len(part) for words in column for part in words.split("\n")) + 3
        for column in zip(headings, *lines, strict=True)
    ]
    left = len(headings) - len(everything)
    room = (width or 10**9) - sum(wide[:left]) - 1
    many = max(1, room // max(wide[left:]))
    if many >= len(everything):
        return [everything]
    first = [next(iter(column.values()), None) for column in table.columns]
    together = first.count(first[0])
    many -= many % together if many > together else 0
    return [everything[i : i + many] for i in range(0, len(everything), many)]


def _between(counts: Any, what: str) -> str:
    low, high = int(counts.min()), int(counts.max())
    several = "" if high == 1 else "s"
    return f"{low} {what}{several}" if low == high else f"{low} to {high} {what}{several}"


def number(value: float) -> float | None:
    """Return a figure, None where there is none."""
    return float(value) if math.isfinite(value) else None


def _markdown_line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
