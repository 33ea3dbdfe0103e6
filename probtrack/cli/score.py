"""`probtrack score`: figures of tracks against the truth."""

import json
import sys
from collections.abc import Sequence

from jsonargparse import ArgumentParser

from probtrack.cli import flags
from probtrack.metrics import Score, score
from probtrack.track_files import read_track

_HEADINGS = (
    "track", "frames", "missing", "RMSE [m]", "last 0.5 s [m]", "lost", "azimuth RMSE [°]", "median [°]", "max [°]",
)  # fmt: skip


def parser() -> ArgumentParser:
    """Return the command's parser."""
    by = flags.parser("score", "Score tracks of one talker against the truth (RMSE, track loss, azimuth error).")
    by.add_argument("truth", type=str, help="track file with the truth")
    by.add_argument("track", type=str, nargs="+", help="track files to score, one or more runs")
    by.add_argument("--json", action="store_true", help="print JSON, SI units and radians, instead of a table")
    return by


def run(argv: Sequence[str]) -> int:
    """Run the command; returns its exit code."""
    args = flags.parsed(parser(), argv)
    truth = read_track(args.truth)
    scores = {path: score(truth, read_track(path)) for path in args.track}
    if args.json:
        rows = [{"track": path, **one.as_dict()} for path, one in scores.items()]
        json.dump({"truth": args.truth, "tracks": rows, "total": total(list(scores.values()))}, sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        _print_table(scores)
    return 0


def total(scores: Sequence[Score]) -> dict[str, float | None]:
    """Return the mean RMSE and the track loss percentage of S1 eq. (8) over runs, where they are known."""
    errors = [one.rmse for one in scores if one.rmse is not None]
    losses = [one.lost for one in scores if one.lost is not None]
    return {
        "runs": len(scores),
        "mean_rmse": sum(errors) / len(errors) if errors else None,
        "track_loss_percentage": 100 * sum(losses) / len(losses) if losses else None,
    }


def _print_table(scores: dict[str, Score]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(*_HEADINGS)
    for column in table.columns[1:]:
        column.justify = "right"
    for path, one in scores.items():
        lost = None if one.lost is None else "yes" if one.lost else "no"
        angles = (one.azimuth_rmse, one.azimuth_median, one.azimuth_max)
        degrees = [None if angle is None else f"{angle * 57.29577951:.1f}" for angle in angles]
        metres = [None if error is None else f"{error:.3f}" for error in (one.rmse, one.final_error)]
        table.add_row(path, str(one.frames), str(one.missing), *(cell or "-" for cell in (*metres, lost, *degrees)))
    console = Console(width=None if sys.stdout.isatty() else 10_000)  # a pipe has no edge to wrap at
    console.print(table)
    everything = total(list(scores.values()))
    if len(scores) > 1 and everything["mean_rmse"] is not None:
        loss = everything["track_loss_percentage"]
        lost = "" if loss is None else f", track loss {loss:.1f} %"
        console.print(f"{len(scores)} runs: mean RMSE {everything['mean_rmse']:.3f} m{lost}")
