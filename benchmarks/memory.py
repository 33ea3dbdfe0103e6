"""Peak memory of `probtrack track` on a long recording over that on one of a minute, 8 channels at 16 kHz.

The long one is an hour, ten minutes with --quick. Each is tracked once in a process of its own; the figure
is the difference of their peak resident sets.
"""

import tempfile
from pathlib import Path

from benchmarks import sounds
from benchmarks.pairs import Row, spread
from benchmarks.processes import Finished, probtrack


def run(quick: bool = False) -> list[Row]:
    """Track both recordings, the short one again afterwards."""
    minutes = 10 if quick else 60
    with tempfile.TemporaryDirectory() as folder:
        short, long = (sounds.write(Path(folder) / f"{m}.flac", 60.0 * m) for m in (1, minutes))
        before, long_run, after = _track(short), _track(long), _track(short)
    growth = spread([long_run.peak - short_run.peak for short_run in (before, after)])
    return [
        Row(
            f"{minutes} minutes over 1 minute",
            growth,
            50,
            unit="MB",
            ours=f"{long_run.peak:.0f} MB in {long_run.seconds:.0f} s",
            against=f"one minute: {before.peak:.0f} MB",
        )
    ]


def _track(audio: Path) -> Finished:
    return probtrack("track", str(audio), "--array", str(sounds.ARRAY), "-o", str(audio.with_suffix(".csv")))
