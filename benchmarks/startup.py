"""Time from typing a command to its end, on the wall clock, with Python's start and all imports.

Each process inherits the one thread of the benchmarks. The first run of each fills the disk cache and does
not count.
"""

import tempfile
from pathlib import Path

from benchmarks import sounds
from benchmarks.pairs import Row, spread
from benchmarks.processes import probtrack


def run(quick: bool = False) -> list[Row]:
    """Measure the help and the tracking of ten seconds, by turns."""
    repeats = 3 if quick else 7
    with tempfile.TemporaryDirectory() as folder:
        audio = sounds.write(Path(folder) / "talker.wav", 10.0)
        track = ("track", str(audio), "--array", str(sounds.ARRAY), "-o", str(audio.with_suffix(".csv")))
        commands = {
            "probtrack --help": (("--help",), 0.5),
            "probtrack track, 10 s of sound": (track, 6.0),
        }
        times: dict[str, list[float]] = {what: [] for what in commands}
        for repeat in range(repeats + 1):
            for what, (arguments, _) in commands.items():
                taken = probtrack(*arguments).seconds
                if repeat:
                    times[what].append(taken)
    return [Row(what, spread(times[what]), target, unit="s") for what, (_, target) in commands.items()]
