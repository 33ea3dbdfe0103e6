"""`python -m benchmarks [NAME ...]`: runs benchmarks and prints a Markdown table of each."""

import argparse
import importlib
import json
from collections.abc import Sequence

import torch

from benchmarks.pairs import markdown

NAMES = (
    "tracking",
    "steered_power",
    "filter",
    "training_step",
    "dynamics",
    "memory",
    "study_cell",
    "study_store",
    "startup",
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmarks that `argv` names, all if it names none; returns 0 whether or not targets are met."""
    by = argparse.ArgumentParser(prog="python -m benchmarks", description="Speed and memory beside peers and floors.")
    by.add_argument("names", nargs="*", metavar="NAME", help=f"one or more of {', '.join(NAMES)}; all by default")
    by.add_argument("--quick", action="store_true", help="fewer repeats, ten minutes of sound rather than an hour")
    by.add_argument("--json", action="store_true", help="print JSON rather than tables")
    args = by.parse_args(argv)
    unknown = [name for name in args.names if name not in NAMES]
    if unknown:
        by.error(f"no benchmark {unknown[0]!r}: expected one of {', '.join(NAMES)}")
    torch.set_num_threads(1)
    results = {}
    for name in args.names or NAMES:
        module = importlib.import_module(f"benchmarks.{name}")
        rows = module.run(args.quick)
        results[name] = [row.as_dict() for row in rows]
        if not args.json:
            summary = " ".join((module.__doc__ or "").split("\n\n")[0].split())
            print(f"{markdown(name, rows)}\n\n{summary}\n", flush=True)
    if args.json:
        print(json.dumps(results, indent=2))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
