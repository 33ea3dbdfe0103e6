"""The command `probtrack`: finds the sub-command and loads only that, so that help comes at once."""

import importlib
import sys
from collections.abc import Sequence

from probtrack import __version__
from probtrack.errors import InputError

COMMANDS = {
    "simulate": "recordings of talkers in rooms, with their truth",
    "track": "a recording in, a talker's track out",
    "fit": "parameters of models from data",
    "evaluate": "trackers compared over recordings and many runs",
    "study": "tables and pictures of studies",
    "score": "figures of a track against the truth",
    "plot": "a picture of tracks, or of a recording tracked",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv` (the program's own if None); returns its exit code.

    A user's mistake is one line on standard error and code 2; an interruption is code 130.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_help())  # noqa: T201
        return 0
    if arguments[0] == "--version":
        print(f"probtrack {__version__}")  # noqa: T201
        return 0
    command, rest = arguments[0], arguments[1:]
    if command not in COMMANDS:
        known = ", ".join(COMMANDS)
        return _fail("probtrack", f"no command {command!r}: expected one of {known} (see probtrack --help)")
    try:
        return int(importlib.import_module(f"probtrack.cli.{command}").run(rest))
    except (InputError, ImportError) as error:
        return _fail(f"probtrack {command}", str(error))
    except KeyboardInterrupt:
        return 130
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "allocate memory" not in str(error):
            raise  # a defect of ours: its traceback is wanted
        return _fail(
            f"probtrack {command}",
            "not enough memory: fewer particles or workers, or a larger speed of sound?",
        )
    except BrokenPipeError:
        sys.stderr.close()  # the reader of our output left: nothing to say, and nobody to say it to
        return 0
    except OSError as error:  # such as a full disk
        return _fail(f"probtrack {command}", str(error))


def _fail(program: str, message: str) -> int:
    print(f"{program}: error: {' '.join(message.split())}", file=sys.stderr)  # noqa: T201
    return 2


def _help() -> str:
    lines = [f"  {name:<10}{text}" for name, text in COMMANDS.items()]
    return "\n".join(
        [
            "usage: probtrack COMMAND [options]",
            "",
            "Tracks speakers with microphone arrays: who is speaking, where, and which way they face.",
            "",
            "commands:",
            *lines,
            "",
            "options:",
            "  -h, --help  this text; probtrack COMMAND --help says all of a command",
            "  --version   the version",
        ]
    )
