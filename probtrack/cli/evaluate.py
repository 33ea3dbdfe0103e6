"""`probtrack evaluate`: a Monte-Carlo study of trackers, begun or gone on with."""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from jsonargparse import ArgumentParser

from probtrack._files import check_suffix
from probtrack.cli import flags
from probtrack.errors import InputError

if TYPE_CHECKING:
    from probtrack.evaluation import Progress

_EVERY = 10.0  # s between two lines of progress where there is no terminal


def parser() -> ArgumentParser:
    """Return the command's parser."""
    by = flags.parser("evaluate", "Compare trackers over recordings and many runs (docs: Studies).")
    by.add_argument("config", type=str, help="study file: scenes, trackers, what varies, metrics, runs")
    by.add_argument("-o", "--out", type=str, required=True, help="store, .sqlite; one that is there is gone on with")
    by.add_argument("--workers", type=int, default=1, help="processes, each on one thread")
    by.add_argument("--scheduler", type=str, help="address of a Dask scheduler, tcp://host:port (extra distributed)")
    by.add_argument("--new", action="store_true", help="begin anew; a store that is there is kept under another name")
    return by


def run(argv: Sequence[str]) -> int:
    """Run the command; returns its exit code."""
    args = flags.parsed(parser(), argv)
    if args.workers < 1:
        raise InputError(f"--workers must be at least 1, got {args.workers}")
    if args.scheduler is not None and args.workers != 1:
        raise InputError("--workers are processes of this machine: with --scheduler the cluster has its own")
    out = Path(args.out)
    check_suffix(out, "a store", (".sqlite",))
    if not out.absolute().parent.is_dir():
        raise InputError(f"{out}: there is no folder {out.absolute().parent}")
    from probtrack.evaluation import evaluate, load_study  # torch and the metrics: not for --help

    study = load_study(args.config)
    if args.new and out.exists():
        flags.warn("evaluate", f"the store that was there is now {put_aside(out)}")
    with _progress() as show:
        last = evaluate(study, out, workers=args.workers, scheduler=args.scheduler, on_progress=show)
    sys.stdout.write(f"{out}: {said(last)}\n")
    if last.failed:
        raise InputError(f"{last.failed} of {last.cells} cells failed, the first: {last.failure}")
    return 0


def put_aside(path: Path) -> Path:
    """Rename a store, with what SQLite keeps beside it, to the first free name with a number.

    Raises:
        InputError: if a process is at work on it, or it cannot be renamed.
    """
    from probtrack.evaluation.database import BESIDE

    _check_idle(path)
    number = next(n for n in range(1, 10**6) if not path.with_name(f"{path.stem}.{n}{path.suffix}").exists())
    other = path.with_name(f"{path.stem}.{number}{path.suffix}")
    path.rename(other)
    for end in BESIDE:
        beside = path.with_name(path.name + end)
        if beside.exists():
            beside.rename(other.with_name(other.name + end))
    return other


def _check_idle(path: Path) -> None:
    from probtrack.evaluation import Store

    try:
        with Store(path) as store:
            at_work = store.workers
    except InputError:
        return  # damaged, or of another version: nobody can be at work on it
    if at_work:
        raise InputError(f"{path}: process {at_work[0]} is at work on it: --new needs it to end first")


def said(progress: "Progress") -> str:
    """Return how far a study is, in words."""
    words = [f"{progress.done} of {progress.cells} cells"]
    if progress.done > progress.before:
        words[0] += f", {progress.done - progress.before} now in {_time(progress.seconds)}"
    if progress.failed:
        words.append(f"{progress.failed} failed")
    if progress.left:
        words.append(f"{_time(progress.left)} left")
    if progress.denominator:
        value = progress.numerator / progress.denominator
        words.append(
            f"{progress.metric} {f'{100 * value:.1f} %' if progress.unit == '%' else f'{value:.3f} {progress.unit}'}"
        )
    return ", ".join(words).rstrip()


def _time(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


@contextmanager
def _progress() -> Iterator[Callable[["Progress"], None]]:
    """Give what shows how far a study is: a bar on a terminal, otherwise a line now and then."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    bar = Bar(
        BarColumn(),
        TextColumn("{task.description}", markup=False),  # a name of the user's may look like it
        console=console,
        disable=not console.is_terminal,
        transient=True,
    )
    last = time.monotonic()
    with bar:
        task = bar.add_task("")

        def show(progress: "Progress") -> None:
            nonlocal last
            bar.update(
                task, total=progress.cells, completed=progress.done + progress.failed, description=said(progress)
            )
            if not console.is_terminal and time.monotonic() - last >= _EVERY:
                last = time.monotonic()
                print(said(progress), file=sys.stderr, flush=True)  # noqa: T201

        yield show
