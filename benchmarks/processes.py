"""Commands of probtrack in processes of their own."""

import subprocess
import sys
import time
from typing import NamedTuple

_MAIN = """
import sys
from probtrack.cli.main import main
code = main(sys.argv[1:])
for line in open("/proc/self/status"):
    if line.startswith("VmHWM:"):
        print(line.split()[1], file=sys.stderr)
sys.exit(code)
"""


class Finished(NamedTuple):
    """What a process took.

    Attributes:
        seconds: From its start to its end, by the clock on the wall.
        peak: Largest resident set [MB] (Linux; VmHWM of its own address space: rusage would count the parent's).
    """

    seconds: float
    peak: float


def probtrack(*arguments: str) -> Finished:
    """Run the command `probtrack` with `arguments` to its end in a new Python."""
    begin = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", _MAIN, *arguments], capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - begin
    if done.returncode:
        raise RuntimeError(f"probtrack {' '.join(arguments)} failed: {done.stderr}")
    return Finished(seconds, int(done.stderr.split()[-1]) / 1000)
