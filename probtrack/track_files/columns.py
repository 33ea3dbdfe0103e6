"""What a table of a track holds: its columns, and the kinds of file it may be in."""

import re
from pathlib import Path
from typing import Any

from probtrack._files import check_suffix

COLUMNS = (
    "time", "track", "x", "y", "z", "std_x", "std_y", "std_z", "azimuth", "std_azimuth", "heading", "speech", "ess",
    "lost", "vx", "vy", "vz", "body",
)  # fmt: skip
"""Columns of a table in their order [s, m, rad]; a file has those that are known, and `time` always.

The last four are of truth: the velocity of the mouth, and where the body faces while the head (`heading`) may turn.

The probabilities of the motion models of a track that switches follow as mode_0, mode_1, and so on.
"""

SUFFIXES = (".csv", ".jsonl", ".parquet")
"""Kinds of file, by suffix."""

Row = dict[str, float | None]

WHOLE = ("track", "lost")
"""Columns of integers."""

_MODE = re.compile(r"mode_\d+")


def is_known(name: str) -> bool:
    """Return whether a table may have a column of that name."""
    return name in COLUMNS or _MODE.fullmatch(name) is not None


def kind_of(path: Path) -> str:
    """Return the suffix of `path`, or raise `InputError` unless it is that of a track file."""
    return check_suffix(path, "a track file", SUFFIXES)


def with_parquet() -> Any:
    """Return pyarrow with its Parquet part, or raise `ImportError` with the line that installs it."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise ImportError("Parquet files need pyarrow: pip install 'probtrack[report]'") from None
    return pyarrow
