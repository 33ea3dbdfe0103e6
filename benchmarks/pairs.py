"""Two contestants measured by turns, and the table of what came out."""

import importlib
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple


class Spread(NamedTuple):
    """Median and range of repeated measurements.

    Attributes:
        median: The middle one.
        low: The smallest.
        high: The largest.
    """

    median: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{_short(self.median)} ({_short(self.low)} to {_short(self.high)})"


@dataclass(frozen=True)
class Row:
    """One line of a table: what was measured, against what, and what it was to be.

    Attributes:
        what: What was measured.
        figure: What the target speaks of: a ratio, a time, a size.
        target: Its bound, None for what is only reported.
        unit: Of figure and target; empty for a ratio.
        at_least: Whether the target is a lower bound.
        ours: What probtrack took, with its unit.
        against: The peer or the floor, and what it took.
    """

    what: str
    figure: Spread | None
    target: float | None
    unit: str = ""
    at_least: bool = False
    ours: str = ""
    against: str = ""

    @property
    def met(self) -> bool | None:
        """Whether the median keeps the target; None without a figure or a target."""
        if self.figure is None or self.target is None:
            return None
        return self.figure.median >= self.target if self.at_least else self.figure.median <= self.target

    def as_dict(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        figure = None if self.figure is None else self.figure._asdict()
        return {**self.__dict__, "figure": figure, "met": self.met}


def spread(values: Sequence[float]) -> Spread:
    """Return median and range of `values`."""
    return Spread(statistics.median(values), min(values), max(values))


def thread_seconds(work: Callable[[], object]) -> float:
    """Return the processor time that `work` takes in this thread [s]: other programs do not add to it."""
    begin = time.thread_time()
    work()
    return time.thread_time() - begin


def paired(ours: Callable[[], object], theirs: Callable[[], object], pairs: int) -> tuple[Spread, Spread, Spread]:
    """Run both by turns and return our times [s], theirs [s] and the ratio ours / theirs of each pair.

    One run of each beforehand warms caches and does not count. A machine that slows down slows both
    halves of a pair.
    """
    ours(), theirs()
    times = [(thread_seconds(ours), thread_seconds(theirs)) for _ in range(pairs)]
    mine, others = zip(*times, strict=True)
    return spread(mine), spread(others), spread([a / b for a, b in times])


def ratio_row(
    what: str,
    ours: Callable[[], object],
    against: str,
    theirs: Callable[[], object],
    *,
    pairs: int,
    target: float | None,
    faster: bool = False,
) -> Row:
    """Return the row of `ours` beside `theirs`.

    Args:
        what: What is measured.
        ours: Our work.
        against: Name of the other one.
        theirs: Its work.
        pairs: How many times each is run.
        target: Largest ratio of times ours / theirs, or with `faster` the smallest of theirs / ours.
        faster: Whether the figure is how many times faster we are.
    """
    mine, others, ratio = paired(ours, theirs, pairs)
    if faster:
        ratio = Spread(1 / ratio.median, 1 / ratio.high, 1 / ratio.low)
    return Row(what, ratio, target, at_least=faster, ours=_ms(mine), against=f"{against}: {_ms(others)}")


def missing_row(what: str, peer: str, target: float | None) -> Row:
    """Return the row of a comparison with a `peer` that is not there."""
    return Row(what, None, target, against=f"{peer}: not installed")


def peer(name: str) -> ModuleType | None:
    """Return the module `name`, or None if it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def markdown(title: str, rows: Sequence[Row]) -> str:
    """Return a Markdown table of `rows`."""
    lines = [
        f"## {title}",
        "",
        "| what | ours | against | figure (min to max) | target | met |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        figure = "-" if row.figure is None else f"{row.figure} {row.unit}".strip()
        bound = "at least" if row.at_least else "at most"
        target = "-" if row.target is None else f"{bound} {_short(row.target)} {row.unit}".strip()
        met = {True: "yes", False: "**no**", None: "-"}[row.met]
        lines.append(f"| {row.what} | {row.ours or '-'} | {row.against or '-'} | {figure} | {target} | {met} |")
    return "\n".join(lines)


def _ms(seconds: Spread) -> str:
    return f"{_short(1e3 * seconds.median)} ms"


def _short(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
