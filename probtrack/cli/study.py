"""`probtrack study`: tables, pictures, exports and comparisons of studies, finished or not."""

import json
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from jsonargparse import ArgumentParser, Namespace

from probtrack.cli import flags
from probtrack.errors import InputError
from probtrack.evaluation.store import Store

if TYPE_CHECKING:
    from rich.table import Table


def parser() -> ArgumentParser:
    """Return the command's parser."""
    by = flags.parser("study", "Read studies made by probtrack evaluate, finished or not (docs: Studies).")
    commands = by.add_subcommands(dest="what", required=True)
    for name, (make, _) in _WHAT.items():
        part = make()
        commands.add_subcommand(name, part, help=part.description)
    return by


def run(argv: Sequence[str]) -> int:
    """Run the command; returns its exit code."""
    args = flags.parsed(parser(), argv)
    _WHAT[args.what][1](args[args.what])
    return 0


def _show_parser() -> ArgumentParser:
    by = flags.parser("study show", "Print a table of figures with intervals.")
    by.add_argument("store", type=str, help="store, .sqlite")
    by.add_argument("--rows", type=str, nargs="+", help="factors along rows, by default the settings that vary")
    by.add_argument("--columns", type=str, nargs="+", help="factors along columns, by default the conditions that vary")
    _add_figures(by, "metrics to show, of the study or seconds and real_time_factor; by default all of the study")
    _add_printing(by)
    return by


def _show(args: Namespace) -> None:
    from probtrack.evaluation.rendering import as_dict, as_markdown, notes, rich_tables
    from probtrack.evaluation.tables import tabulate

    _check_printing(args)
    layout = {"rows": args.rows, "columns": args.columns, "metrics": args.metrics}
    with Store(args.store) as store:
        table = tabulate(store, **layout, level=args.level, over=args.over)
    if args.json:
        _print_json(as_dict(table))
    elif args.markdown:
        sys.stdout.write(as_markdown(table) + "\n")
    else:
        _print(lambda width: rich_tables(table, width), notes(table))


def _plot_parser() -> ArgumentParser:
    by = flags.parser("study plot", "Draw a panel for each metric: figures with bands against a factor.")
    by.add_argument("store", type=str, help="store, .sqlite")
    by.add_argument("-o", "--output", type=str, help="picture: .png, .pdf or .svg")
    by.add_argument("--x", type=str, help="factor along the axis, by default the number with most values")
    by.add_argument("--rows", type=str, nargs="+", help="factors of which each combination is a line; by default all")
    by.add_argument("--log-x", action="store_true", help="a logarithmic axis")
    _add_figures(by, "metrics, a panel each, of the study or seconds and real_time_factor; by default all of the study")
    return by


def _plot(args: Namespace) -> None:
    from probtrack.evaluation.pictures import plot_study

    if args.output is None:
        raise InputError("-o is needed: the picture to write")
    layout = {"x": args.x, "rows": args.rows, "metrics": args.metrics, "log_x": args.log_x}
    with Store(args.store) as store:
        progress = plot_study(store, args.output, **layout, level=args.level, over=args.over).progress
    if progress.finished < progress.cells:
        flags.warn("study", f"{args.store}: {progress}")


def _export_parser() -> ArgumentParser:
    by = flags.parser("study export", "Write all runs as a table, one row each; what can be read of a damaged store.")
    by.add_argument("store", type=str, help="store, .sqlite")
    by.add_argument("-o", "--output", type=str, help="table: .csv or .parquet")
    return by


def _export(args: Namespace) -> None:
    from probtrack.evaluation.export import export_runs

    if args.output is None:
        raise InputError("-o is needed: the table to write")
    warning = export_runs(args.store, args.output)
    if warning is not None:
        flags.warn("study", warning)


def _compare_parser() -> ArgumentParser:
    by = flags.parser("study compare", "Compare two studies, or two parts of one, on the same recordings and seeds.")
    by.add_argument("first", type=str, help="store of A, .sqlite")
    by.add_argument("second", type=str, nargs="?", help="store of B; by default that of A")
    by.add_argument("--a", type=str, nargs="+", default=[], help="settings of A as NAME=VALUE, such as tracker=CU-LAN")
    by.add_argument("--b", type=str, nargs="+", default=[], help="settings of B")
    by.add_argument("--by", type=str, nargs="+", default=[], help="factors with a row for each value; by default none")
    _add_figures(by, "metrics to compare, by default those of both studies")
    _add_printing(by)
    return by


def _compare(args: Namespace) -> None:
    from probtrack.evaluation import comparison_rendering as words
    from probtrack.evaluation.comparison import compare
    from probtrack.evaluation.pairing import Side

    _check_printing(args)
    if args.second is None and not (args.a and args.b):
        raise InputError("give a second store, or choose two parts of one: --a tracker=... --b tracker=...")
    second = args.second or args.first
    names = [" ".join([path, *wanted]) for path, wanted in ((args.first, args.a), (second, args.b))]
    with ExitStack() as opened:
        stores = [opened.enter_context(Store(path)) for path in (args.first, second)]
        sides = Side(stores[0], args.a, "--a"), Side(stores[1], args.b, "--b")
        comparison = compare(*sides, by=args.by, metrics=args.metrics, level=args.level, over=args.over)
    if args.json:
        _print_json(words.comparison_dict(comparison, *names))
    elif args.markdown:
        sys.stdout.write(words.comparison_markdown(comparison, *names) + "\n")
    else:
        _print(lambda _: [words.comparison_table(comparison)], words.comparison_notes(comparison, *names))


def _add_figures(by: ArgumentParser, metrics: str) -> None:
    by.add_argument("--metrics", type=str, nargs="+", help=metrics)
    by.add_argument("--level", type=float, default=0.95, help="probability of intervals")
    by.add_argument(
        "--over", choices=("scenes", "runs"), default="scenes", help="what another study would draw anew, for intervals"
    )


def _add_printing(by: ArgumentParser) -> None:
    by.add_argument("--json", action="store_true", help="print JSON instead of a table")
    by.add_argument("--markdown", action="store_true", help="print Markdown instead of a table")


def _check_printing(args: Namespace) -> None:
    if args.json and args.markdown:
        raise InputError("--json or --markdown can be printed, not both")


def _print(tables: Callable[[int | None], list["Table"]], below: list[str]) -> None:
    from rich.console import Console

    width = None if sys.stdout.isatty() else 10_000  # a pipe has no edge to wrap at
    console = Console(width=width)
    for table in tables(console.width if width is None else None):
        console.print(table)
    for line in below:
        console.print(line, markup=False, highlight=False)


def _print_json(content: dict[str, Any]) -> None:
    json.dump(content, sys.stdout, indent=2)
    sys.stdout.write("\n")


_WHAT: dict[str, tuple[Callable[[], ArgumentParser], Callable[[Namespace], None]]] = {
    "show": (_show_parser, _show),
    "plot": (_plot_parser, _plot),
    "export": (_export_parser, _export),
    "compare": (_compare_parser, _compare),
}
