"""How an experiment becomes a command: flags from its `Config`, a user's mistake in one line."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from jsonargparse import auto_cli

from probtrack.errors import InputError

T = TypeVar("T")


def run(main: Callable[[T], Any], config: type[T]) -> None:
    """Fill `config` from the command line and run `main` on it; exit with 2 on what a user did wrong."""
    try:
        main(auto_cli(config, as_positional=False))
    except (InputError, ImportError, OSError) as error:
        print(f"{Path(sys.argv[0]).stem}: error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
