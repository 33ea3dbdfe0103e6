"""README and docs: their Python runs, their commands parse, and what they say of the code is so."""

import ast
import contextlib
import importlib
import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest
import torch

from probtrack.cli import flags
from probtrack.cli.main import COMMANDS
from probtrack.simulation import Scene, save_scene
from probtrack.simulation.rooms import ShoeboxRoom
from probtrack.simulation.trajectories import SmoothPaths
from probtrack.simulation.voices import SyntheticVoices

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "probtrack"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
GROUND = {"errors", "_checks", "_files", "_threads"}  # tools that every room may use


def blocks(page, *languages):
    """Return (line number, text) of the fenced blocks of `page` in one of `languages`."""
    text = page.read_text(encoding="utf-8")
    fence = re.compile(rf"^```(?:{'|'.join(languages)})\n(.*?)^```", re.M | re.S)
    return [(text[: match.start(1)].count("\n"), match[1]) for match in fence.finditer(text)]


def command_lines(page):
    """Return the words of each call of probtrack, of those on one line too, up to a pipe."""
    lines = "\n".join(text for _, text in blocks(page, "console", "bash")).replace("\\\n", " ").splitlines()
    calls = [call for line in lines for call in line.removeprefix("$ ").split(" && ")]
    words = [shlex.split(call, comments=True) for call in calls]
    return [line[: line.index("|")] if "|" in line else line for line in words if line[:1] == ["probtrack"]]


@pytest.fixture(scope="module")
def user_files(tmp_path_factory):
    """A folder with what a user has: a recording, its array file and settings."""
    folder = tmp_path_factory.mktemp("user")
    path = ((0.95, 2.35, 1.51), (0.85, 1.55, 1.51))
    scene = Scene(1.7, ShoeboxRoom((3.5, 3.1, 2.2), 0.0), SmoothPaths((path,)), SyntheticVoices(), seed=1)
    save_scene(folder, scene, scene.simulate())
    (folder / "audio.wav").rename(folder / "recording.wav")
    (folder / "settings.yaml").write_text("array: array.yaml\nnum_particles: 300\n")
    (folder / "fit.yaml").write_text(blocks(ROOT / "docs" / "fitting.md", "yaml")[0][1])
    for _, text in blocks(ROOT / "docs" / "fitting_scenes.md", "yaml"):  # which begin with their names
        (folder / text.split()[1]).write_text(text)
    return folder


@pytest.fixture
def here(user_files, tmp_path, monkeypatch):
    """The working directory of a page, in the precision that users have."""
    shutil.copytree(user_files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    torch.set_default_dtype(torch.float32)
    return tmp_path


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=lambda page: page.name)
def test_python_blocks_run(page):
    namespace = {"__name__": page.stem}
    for line, text in blocks(page, "python"):
        exec(compile("\n" * line + text, str(page), "exec"), namespace)


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("words", [pytest.param(w, id=" ".join(w[1:])) for page in PAGES for w in command_lines(page)])
def test_commands_parse(words, capsys):
    command, rest = words[1], words[2:]
    if command in ("--help", "--version"):
        return
    assert command in COMMANDS
    with contextlib.suppress(SystemExit):  # --print-config prints and exits
        flags.parsed(importlib.import_module(f"probtrack.cli.{command}").parser(), rest)
    assert capsys.readouterr().err == ""


def test_every_command_and_target_is_in_the_docs():
    shown = {words[1] for page in PAGES for words in command_lines(page)}
    assert set(COMMANDS) <= shown
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`make (\w+)", readme)) | set(re.findall(r"^\$ make (\w+)", readme, re.M))
    targets = set(re.findall(r"^(\w+):(?!=)", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
    assert {"demo", "test", "lint", "docs", "bench"} <= named <= targets


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"], ids=lambda page: page.name)
def test_links_between_pages_lead_somewhere(page):
    targets = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    assert [target for target in targets if not (page.parent / target).exists()] == []


def rooms():
    """Return the table of design.md, in its order: room -> (imports from probtrack, libraries)."""
    text = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
    rows = [line.strip("|").split("|") for line in text.splitlines() if re.match(r"\| `\w+(\.py|/)` \|", line)]
    names = [[[room_name(name) for name in re.findall(r"`([^`]+)`", row[i])] for i in (0, 2, 3)] for row in rows]
    return {room: (set(inside), set(outside)) for (room,), inside, outside in names}


def room_name(text):
    return text.strip().removesuffix(".py").rstrip("/")


def imports(room):
    """Return the rooms and the libraries beyond Python's own that the files of `room` import."""
    files = [PACKAGE / f"{room}.py"] if (PACKAGE / f"{room}.py").exists() else (PACKAGE / room).rglob("*.py")
    names = set()
    for node in (node for file in files for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{room}: relative import"
            whole = node.module == "probtrack"
            names |= {f"probtrack.{alias.name}" for alias in node.names} if whole else {node.module}
    inside = {name.split(".")[1] for name in names if name.startswith("probtrack.")}
    outside = {name.split(".")[0] for name in names} - {"probtrack"} - sys.stdlib_module_names
    return inside - {room, "__version__"}, outside


def test_the_table_has_every_room():
    found = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert set(rooms()) == found - {"__init__"}


@pytest.mark.parametrize("room", rooms())
def test_a_room_imports_what_the_table_allows(room):
    allowed, libraries = rooms()[room]
    inside, outside = imports(room)
    assert inside - GROUND <= allowed
    assert outside <= libraries


def test_no_room_imports_from_one_below_it_in_the_table():
    order = list(rooms())
    for i, (room, (allowed, _)) in enumerate(rooms().items()):
        assert allowed <= set(order[:i]), f"{room} is above what it imports"
    assert set(order[: len(GROUND)]) == GROUND
