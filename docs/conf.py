"""Sphinx configuration: MyST pages, API pages from docstrings."""

import re
from typing import Any

from sphinx.application import Sphinx

from probtrack import __version__

project = "probtrack"
author = "the probtrack contributors"
copyright = "the probtrack contributors, MIT licence"
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
exclude_patterns = ["_build"]

html_theme = "furo"
html_title = f"probtrack {__version__}"
html_copy_source = False
html_show_sourcelink = False

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

default_role = "code"  # docstrings write `names` between single backticks
add_module_names = False
autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False  # a forward without a docstring is described by its class, not by torch
autodoc_typehints_format = "short"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
napoleon_custom_sections = ["Shape"]

_MARKUP = re.compile(r"(?<![\w*\\])\*(?=\w)|\|(?=\w+\|)|(?<=\w)\|(?=\s)|(?<![^ ])[A-Z](?=\. )")
"""What reStructuredText would take for markup in prose: (*batch, N), |D|, and the initials that begin a reference."""

_plain: dict[str, list[str]] = {}


def _escape_markup(_app: Sphinx, what: str, name: str, *event: Any) -> None:
    lines: list[str] = event[-1]
    in_math = False
    for i, line in enumerate(lines):
        if line.strip():
            in_math = line.startswith(".. math::") or (in_math and line.startswith(" "))
        if not in_math and not line.lstrip().startswith(">>>"):
            lines[i] = _MARKUP.sub(r"\\\g<0>", line)
    if what in ("attribute", "data", "property"):
        _plain[name] = list(lines)


def _keep_sentences(_app: Sphinx, _what: str, name: str, *event: Any) -> None:
    # napoleon takes what stands before a colon in an attribute's docstring for its type
    if name in _plain:
        event[-1][:] = _plain.pop(name)


def _skip_fields(_app: Sphinx, _what: str, _name: str, member: object, *_: Any) -> bool | None:
    # the fields of a NamedTuple are in the Attributes of its docstring
    return True if type(member).__name__ == "_tuplegetter" else None


def setup(app: Sphinx) -> None:
    """Connect them to what autodoc finds."""
    app.connect("autodoc-process-docstring", _escape_markup, priority=100)  # before napoleon
    app.connect("autodoc-process-docstring", _keep_sentences, priority=900)  # after it
    app.connect("autodoc-skip-member", _skip_fields)
