"""Files: paths that results go to, checked before the work and not after, and YAML."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

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


def read_yaml(path: str | Path, what: str) -> Any:
    """Return the content of a YAML file, or raise `InputError`."""
    try:
        return yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot read {what}: {error.strerror}") from None
    except (yaml.YAMLError, ValueError) as error:  # ValueError: not UTF-8, or a date that cannot be
        raise InputError(f"{path}: {what} is not YAML: {' '.join(str(error).split())}") from None


def difference(there: object, here: object, name: str = "") -> str:
    """Return the first place where two descriptions differ, in words; empty where they are the same."""
    if isinstance(there, dict) and isinstance(here, dict):
        for key in [*there, *(key for key in here if key not in there)]:
            found = difference(there.get(key), here.get(key), f"{name}.{key}".strip("."))
            if found:
                return found
        return ""
    if isinstance(there, list) and isinstance(here, list) and len(there) == len(here):
        pairs = enumerate(zip(there, here, strict=True))
        return next((found for i, (a, b) in pairs if (found := difference(a, b, f"{name}[{i}]"))), "")
    return "" if there == here else f"{name} is {there!r} there and {here!r} here"
