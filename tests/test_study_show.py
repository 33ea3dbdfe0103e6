"""probtrack study show: the table in words, for terminals, pipes, Markdown and JSON, and mistakes in one line."""

import json
import re

import numpy as np
import pytest
from stored_studies import write_study

from probtrack.cli.main import main
from probtrack.evaluation import Store, tabulate
from probtrack.evaluation.factors import label
from probtrack.evaluation.rendering import decimals, rich_tables


def show(capsys, path, *flags):
    assert main(["study", "show", str(path), *flags]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    return said.out


def fails(capsys, words, *arguments):
    assert main(["study", *map(str, arguments)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert re.fullmatch(r"probtrack study: error: .*\n", said.err)
    assert [word for word in words if word not in said.err] == []


@pytest.fixture
def study(tmp_path):
    return write_study(tmp_path / "study.sqlite")


def test_markdown_has_the_shape_of_table_2(study, capsys):
    lines = show(capsys, study, "--markdown", "--over", "runs", "--level", "0.9").splitlines()
    assert lines[0] == "| tracker | metric | SNR 5 dB | SNR 20 dB |"
    assert lines[1] == "|---|---|---:|---:|"
    figure = r"0\.344 \[0\.34\d, 0\.34\d\] \| 0\.301 \[0\.30\d, 0\.30\d\]"
    assert re.fullmatch(rf"\| soft \| rmse \[m\] \| {figure} \|", lines[2])
    assert re.fullmatch(r"\|  \| track_loss \[%\] \| 25\.0 \[\S+, \S+\] \| 25\.0 \[\S+, \S+\] \|", lines[3])
    assert lines[4].startswith("| loud | rmse [m] | 0.144")
    low, high = re.search(r"\[(\d\S+), (\S+)\]", lines[2]).groups()
    assert float(low) < 0.344 < float(high)
    assert lines[-5:] == [
        f"- {study}: 6 of 6 cells finished",
        "- everywhere: T60 0.27 s",
        "- a figure is of 1 to 2 scenes, 4 to 8 runs",
        "- [low, high]: 90 % bootstrap interval, runs drawn anew, of the same scenes",
        "- a share of 0 or 100 % has the exact (Clopper-Pearson) interval of as many draws as runs",
    ]


def test_json_has_the_numbers_of_the_table(study, capsys):
    content = json.loads(show(capsys, study, "--json", "--metrics", "track_loss", "seconds"))
    with Store(study) as store:
        found = tabulate(store)
    group = content["groups"][0]
    assert {name: group[name] for name in ("tracker", "snr_db", "scenes", "runs", "planned")} == {
        "tracker": "soft", "snr_db": 5, "scenes": 2, "runs": 8, "planned": 8,
    }  # fmt: skip
    assert group["metrics"]["track_loss"] == {
        "value": 25.0, "low": found.low[0, 0, 1], "high": found.high[0, 0, 1], "unit": "%",
    }  # fmt: skip
    assert group["metrics"]["seconds"] == {"value": 0.5, "low": None, "high": None, "unit": "s"}
    assert (content["cells"], content["finished"], content["failures"]) == (6, 6, [])


def test_pipe_has_no_edge(tmp_path, capsys):
    path = write_study(tmp_path / "s.sqlite", vary={"num_particles": list(range(1, 30))})
    first = show(capsys, path, "--columns", "num_particles").splitlines()[1]
    assert first.count("num_particles") == 29


def test_columns_that_do_not_fit_come_below_each_other(tmp_path):
    scenes = {f"{snr} {t60}": {"snr_db": snr, "t60": t60} for snr in (5, 10, 15) for t60 in (0.27, 0.34)}
    with Store(write_study(tmp_path / "s.sqlite", scenes=scenes)) as store:
        pieces = rich_tables(tabulate(store, over="runs"), 110)
    heads = [[column.header.plain for column in piece.columns[2:]] for piece in pieces]
    assert [len(head) for head in heads] == [2, 2, 2]
    assert heads[1] == ["SNR 10 dB\nT60 0.27 s", "SNR 10 dB\nT60 0.34 s"]


def test_terminal_narrower_than_a_column_gets_them_one_by_one(study):
    with Store(study) as store:
        assert len(rich_tables(tabulate(store), 20)) == 2


def test_unfinished_groups_are_marked(tmp_path, capsys):
    path = write_study(tmp_path / "s.sqlite", finished=3, failure="no such voice")
    out = show(capsys, path)
    assert re.search(r"soft .* 0\.322\* .* 0\.301 ", out)
    assert re.search(r"loud .* - .* 0\.101 ", out)
    for line in ("3 of 6 cells finished, 1 failed, the first: no such voice", "* some of its runs are not finished"):
        assert line in out
    assert "of one scene there is no interval over scenes" in out


def test_what_is_averaged_over_is_said(study, capsys):
    assert "averaged over SNR [dB]: 5, 20" in show(capsys, study, "--rows", "tracker", "--columns", "t60")


def test_brackets_in_names_are_kept(tmp_path, capsys):
    path = write_study(tmp_path / "s.sqlite", trackers=["soft", "[red]loud[/red]"])
    assert "[red]loud[/red]" in show(capsys, path)
    assert "a\\|b" in show(capsys, write_study(tmp_path / "t.sqlite", trackers=["a|b"]), "--markdown")


@pytest.mark.parametrize(
    ("values", "unit", "digits"),
    [
        ([0.063, 0.359], "m", 3),
        ([0.0004, 0.0007, 0.0009], "m", 5),
        ([5.6, 88.7, 0], "%", 1),
        ([np.nan, 12.34], "", 1),
        ([1234.5], "s", 0),
        ([np.nan], "m", 1),
    ],
)
def test_decimals(values, unit, digits):
    assert decimals(np.array(values), unit) == digits


def test_labels_are_in_the_words_of_the_field():
    factors = [("snr_db", 5.0), ("t60", 0.34), ("t60", None), ("model", "CU-LAN"), ("num_particles", 75)]
    assert [label(*one) for one in factors] == ["SNR 5 dB", "T60 0.34 s", "T60 -", "CU-LAN", "num_particles 75"]


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--rows", "model"], ["rows", "'model'", "tracker, snr_db, t60, scene"]),
        (["--metrics", "rms"], ["'rms'", "rmse, track_loss"]),
        (["--level", "1.5"], ["level", "between 0 and 1", "1.5"]),
        (["--level", "much"], ["--level", "expected float, got much"]),
        (["--json", "--markdown"], ["--json or --markdown", "not both"]),
        (["--rows", "tracker", "snr_db", "tracker"], ["rows must differ, got tracker twice"]),
        (["--columns", "t60", "t60"], ["columns must differ, got t60 twice"]),
        (["--metrics", "rmse", "seconds", "rmse"], ["metrics must differ, got rmse twice"]),
        (["--over", "cells"], ["--over", "cells", "scenes", "runs"]),
    ],
)
def test_wrong_flags(study, capsys, flags, words):
    fails(capsys, words, "show", study, *flags)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, ["no such study"]),
        (b"", ["not a study made by probtrack evaluate"]),
        (b"time,x,y\n" * 99, ["damaged, or no study", "probtrack study export"]),
    ],
)
@pytest.mark.parametrize(
    "what", [["show"], ["plot", "-o", "p.png"], ["compare", "--a", "tracker=x", "--b", "tracker=y"]]
)
def test_file_that_is_no_study(tmp_path, capsys, monkeypatch, content, words, what):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "s.sqlite"
    if content is not None:
        path.write_bytes(content)
    fails(capsys, [str(path), *words], what[0], path, *what[1:])


def test_study_without_finished_cells(tmp_path, capsys):
    path = write_study(tmp_path / "s.sqlite", finished=0)
    fails(capsys, ["nothing to show yet: 0 of 6 cells finished"], "show", path)
    empty = write_study(tmp_path / "t.sqlite", trackers=[])
    fails(capsys, ["0 of 0 cells finished"], "show", empty)


def test_missing_arguments_are_named(capsys):
    fails(capsys, ["required: store"], "show")
    fails(capsys, ["show", "plot", "export", "compare"])
    fails(capsys, ["show", "plot", "export", "compare"], "tell")
