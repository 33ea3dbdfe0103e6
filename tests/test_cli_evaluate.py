"""probtrack evaluate: what it shows as it works, how it is interrupted, and that help comes at once."""

import dataclasses
import io
import os
import pathlib
import pty
import re
import select
import signal
import subprocess
import sys

import pytest
import yaml
from rich.console import Console
from study_processes import finished, wait_until
from study_processes import start as start
from study_scenes import claimed, write_recording

from probtrack.cli import evaluate as command
from probtrack.cli.main import main
from probtrack.evaluation import Progress

PROGRESS = Progress(240, 60, 0, 40, 100.0, "rmse", "m", 3.0, 24.0)


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    write_recording(folder / "near", (2.4, 1.1, 1.3), 0.6)
    content = {"scenes": ["near"], "trackers": {"A": "lehmann2007"}, "vary": {"num_particles": [30, 40, 50]}, "runs": 2}
    (folder / "study.yaml").write_text(yaml.safe_dump(content))
    return str(folder / "study.yaml")


def test_time_left_is_that_of_the_pace_of_all_who_work():
    assert PROGRESS.left == 100.0 / 20 * 180
    assert Progress(240, 40, 2, 40, 3.0, "rmse", "m", 0.0, 0.0).left is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "60 of 240 cells, 20 now in 1 min 40 s, 15 min 00 s left, rmse 0.125 m"),
        ({"seconds": 10_000.0}, "60 of 240 cells, 20 now in 2 h 46 min, 25 h 00 min left, rmse 0.125 m"),
        ({"unit": "%", "metric": "track_loss"}, "15 min 00 s left, track_loss 12.5 %"),
        ({"unit": "", "metric": "nees"}, "nees 0.125"),
        ({"failed": 3}, "60 of 240 cells, 20 now in 1 min 40 s, 3 failed, 14 min 45 s left"),
        ({"done": 40, "denominator": 0.0}, "40 of 240 cells"),
        ({"done": 240}, "240 of 240 cells, 200 now in 1 min 40 s, rmse 0.125 m"),
    ],
)
def test_progress_in_words(changes, words):
    assert words in command.said(dataclasses.replace(PROGRESS, **changes))


def test_on_a_pipe_progress_is_a_line_now_and_then_and_the_end_is_on_standard_output(
    config, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(command, "_EVERY", 0.0)
    assert main(["evaluate", config, "-o", str(tmp_path / "s.sqlite")]) == 0
    said = capsys.readouterr()
    assert [line[:12] for line in said.err.splitlines()] == [f"{n} of 3 cells" for n in (0, 1, 2, 3)]
    assert re.fullmatch(rf"{tmp_path}/s.sqlite: 3 of 3 cells, 3 now in \d+ s, rmse 0\.\d+ m\n", said.out)


def test_a_bar_shows_a_name_as_it_is(monkeypatch):
    shown = io.StringIO()
    monkeypatch.setattr("rich.console.Console", lambda **_: Console(file=shown, force_terminal=True, width=200))
    with command._progress() as show:
        show(dataclasses.replace(PROGRESS, metric="a[/x]"))
    assert "a[/x] 0.125 m" in re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", "", shown.getvalue())


def test_on_a_terminal_a_bar_shows_how_far_it_is(config, tmp_path, start):
    master, slave = pty.openpty()
    process = start("evaluate", config, "-o", str(tmp_path / "s.sqlite"), said=os.ttyname(slave))
    shown = b""
    while process.is_alive() or select.select([master], [], [], 0)[0]:
        if select.select([master], [], [], 0.1)[0]:
            shown += os.read(master, 4096)
    os.close(slave)
    os.close(master)
    text = re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", "", shown.decode())
    assert process.exitcode == 0
    assert "━" in text
    assert re.search(r"[12] of 3 cells, [12] now in \d+ s, \d+ s left, rmse 0\.\d+ m", text)


def test_ctrl_c_ends_with_130_and_keeps_what_is_finished(config, tmp_path, start):
    path = tmp_path / "s.sqlite"
    there = pathlib.Path(config)
    long = yaml.safe_load(there.read_text()) | {"scenes": [str(there.parent / "near")], "runs": 2000}
    (tmp_path / "long.yaml").write_text(yaml.safe_dump(long))
    process = start("evaluate", str(tmp_path / "long.yaml"), "-o", str(path), said=str(tmp_path / "said"))
    wait_until(lambda: finished(path) >= 1)
    os.kill(process.pid, signal.SIGINT)
    process.join(20)
    assert process.exitcode == 130
    assert 1 <= finished(path) < 3
    assert claimed(path) == []
    assert "Traceback" not in (tmp_path / "said").read_text()


def test_help_does_not_wait_for_torch():
    code = (
        "import sys; from probtrack.cli.main import main\ntry: main(['evaluate', '--help'])\nexcept SystemExit: pass\n"
    )
    code += "print([m for m in ('torch', 'torchmetrics', 'matplotlib', 'scipy', 'pandas') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "--scheduler" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]"
