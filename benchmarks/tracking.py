"""From a recording to a track file: 8 microphones at 16 kHz, frames of 512 samples every 256.

The command `probtrack track` in this process: its flags, a first pass over the file that looks for dead and
clipped channels, reading, front end, filter and CSV, but neither Python's start nor imports. The figure is
the real-time factor: processor time in seconds for a second of sound.
"""

import tempfile
from functools import partial
from pathlib import Path

from benchmarks import sounds
from benchmarks.pairs import Row, spread, thread_seconds
from probtrack.cli.main import main


def run(quick: bool = False) -> list[Row]:
    """Measure 75 and 1000 particles by turns."""
    seconds, repeats = (10.0, 3) if quick else (30.0, 7)
    targets = {75: 0.03, 1000: 0.09}
    factors: dict[int, list[float]] = {n: [] for n in targets}
    with tempfile.TemporaryDirectory() as folder:
        audio = sounds.write(Path(folder) / "talker.wav", seconds)
        for repeat in range(repeats + 1):
            for n, values in factors.items():
                taken = thread_seconds(partial(_track, audio, n))
                if repeat:  # the first only warms up
                    values.append(taken / seconds)
    return [
        Row(
            f"N = {n}, {seconds:g} s of sound",
            spread(values),
            targets[n],
            ours=f"{seconds * min(values):.3g} s at best",
        )
        for n, values in factors.items()
    ]


def _track(audio: Path, num_particles: int) -> None:
    output = audio.with_suffix(".csv")
    code = main(
        ["track", str(audio), "--array", str(sounds.ARRAY), "--num-particles", str(num_particles), "-o", str(output)]
    )
    if code:
        raise RuntimeError(f"probtrack track ended with code {code}")
