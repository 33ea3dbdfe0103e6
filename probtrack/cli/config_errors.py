"""What jsonargparse says of a configuration with classes in it, in one line."""

import re

_NOISE = re.compile(
    r"^(Does not validate against any of the Union subtypes|Subtypes: .*|Errors:|- Expected a <class 'NoneType'>"
    r"|Given value type: .*|Given value: (?:\{|\[|Namespace).*)$"
)
_WORDS = (
    (r'Parser key "([^"]+)":', r"\1:"),
    (r"Problem with given class_path '([^']+)':", r"\1:"),
    (r"Type typing\.Callable\S*.*? expects a function or a callable class:", ""),
    (r"Expected a <class '([\w.]+)'>", r"expected \1"),
    (r"\. Got value: Namespace.*$", ""),
    (r"\.? (?:Got|Given) value: ", ", got "),
    (r"^Problems parsing config: ", "--config: not YAML: "),
)


def in_one_line(message: str) -> str:
    r"""Return an error of jsonargparse as the path to what is wrong and what that is.

    Of a value that may be one of several things the objections of each are kept, but for that it may be nothing.

    >>> in_one_line("Parser key \"model\":\n  Problem with given class_path 'a.B':\n    Option 'c' is not accepted")
    "model: a.B: Option 'c' is not accepted"
    """
    lines = [line.strip() for line in message.splitlines()]
    kept = [line for line in lines if not _NOISE.match(line)]
    objections = sum(line.startswith("- ") for line in kept)
    words = [line.removeprefix("- ") if objections == 1 else re.sub("^- ", "; ", line) for line in kept]
    line = " ".join(" ".join(words).split())
    for pattern, instead in _WORDS:
        line = re.sub(pattern, instead, line)
    return " ".join(line.split()).replace(": ;", ":").replace(" ;", ";")
