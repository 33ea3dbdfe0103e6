"""Checks of the paths that results go to, made before the work and not after."""

from collections.abc import Sequence
from pathlib import Path

from probtrack.errors import InputError


def check_suffix(path: Path, what: str, suffixes: Sequence[str]) -> str:
    """Return the suffix of `path` in lower case, or raise `InputError` unless it is one of `suffixes`."""
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        raise InputError(f"{path}: {what} ends in {', '.join(suffixes)}, got {suffix or 'no suffix'}")
    return suffix


def check_writable(path: Path) -> None:
    """Raise `InputError` unless a file can be written to `path`; an existing one is left as it is."""
    existed = path.exists()
    try:
        with path.open("ab"):
            pass
    except OSError as error:
        raise InputError(f"{path}: cannot write there: {error.strerror}") from None
    if not existed:
        path.unlink()
