"""Which processes are running."""

import os
from pathlib import Path


def started(pid: int) -> str | None:
    """Return what tells a running process from another that had the same number before; None if there is none."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:  # another user's
        pass
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    except OSError:
        return ""  # no such files on this system: the number alone must do
    state, *rest = text.rpartition(")")[2].split()
    return None if state in "ZX" else rest[18]  # clock ticks from the system's start to the process's, if not killed
