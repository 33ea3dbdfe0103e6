"""probtrack fit on scenes: the configurations of the docs run, one after the other, and what is wrong is one line."""

import csv
import re
from pathlib import Path

import pytest
import torch
import training_scenes
import yaml

from probtrack.cli.main import main

one_talker = training_scenes.one_talker
PAGE = Path(__file__).parents[1] / "docs" / "fitting_scenes.md"
SMALL = ("--trainer.max_epochs=1", "--model.init_args.warm_up=5")


@pytest.fixture(autouse=True)
def here(one_talker, tmp_path, monkeypatch):
    """A working directory with the two configurations, for the small data set; in the precision that users have."""
    torch.set_default_dtype(torch.float32)
    monkeypatch.chdir(tmp_path)
    for text in re.findall(r"^```yaml\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S):
        content = yaml.safe_load(text)
        content["data"]["init_args"] |= {"train": str(one_talker / "set"), "split": [0.5, 0.5, 0.0], "crop": 40}
        content["model"]["init_args"]["tracker"]["init_args"] |= {"array": str(one_talker / "three.yaml")}
        Path(text.split()[1]).write_text(yaml.safe_dump(content))


def fit(config, out, *flags):
    return main(["fit", config, "-o", out, *SMALL, *flags])


def values(run):
    return yaml.safe_load(Path(run, "parameters.yaml").read_text())["parameters"]


def test_the_second_stage_begins_with_what_the_first_has_learned():
    assert fit("likelihood.yaml", "first") == 0
    first = values("first")
    assert set(first) == {
        "front_end.gcc.weight",
        "front_end.vad.threshold",
        "front_end.vad.slope",
        "filter.likelihood.exponent",
    }
    assert first["filter.likelihood.exponent"] != 2.0
    assert fit("scenes.yaml", "run", "--model.init_args.learning_rate=1e-9") == 0
    run = values("run")
    for name, value in first.items():
        assert run[name] == pytest.approx(value, rel=1e-5), name
    assert {"filter.relocation.share", "filter.dynamics.axis_model.process.rate"} < set(run)
    with Path("run/metrics.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert 0 <= float(row["val/lost"]) <= 1
    assert float(row["val/rmse"]) > 0
    assert fit("scenes.yaml", "run", "--ckpt_path=last", "--trainer.max_epochs=2") == 0
    assert values("run").keys() == run.keys()


def test_observations_train_what_comes_after_the_front_end(tmp_path):
    keep = ("--data.init_args.audio=false", f"--data.init_args.cache={tmp_path / 'kept'}")
    assert fit("likelihood.yaml", "heard", *keep) == 0
    assert values("heard")["front_end.vad.threshold"] == 8.0
    assert values("heard")["filter.likelihood.exponent"] != 2.0


TRACKER = "--model.init_args.tracker.init_args"


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ([f"{TRACKER}.array=none.yaml"], "none.yaml: cannot read array file: No such file"),
        ([f"{TRACKER}.low=[0,0]"], "low and high must be given together"),
        ([f"{TRACKER}.array=klaassen2005"], "0_+20dB: has 3 microphones, the tracker's array has"),
        ([f"{TRACKER}.front_end.hop=128"], "same frame_length, hop and fs"),
        ([f"{TRACKER}.parameters=none.yaml"], "none.yaml: cannot read parameter file"),
        (["--model.init_args.warm_up=40"], "warm_up must be shorter than recordings, got 40 of 40 frames"),
        (["--model.init_args.fixed=[wings]"], "fixed: no parameter begins with 'wings'"),
        ([f"{TRACKER}.modell=CU-LAN"], "modell"),
        (["--model.init_args.others=0"], "others must be an integer of at least 1, got 0"),
    ],
)
def test_refuses_in_one_line(flags, words, capsys):
    assert fit("likelihood.yaml", "run", *flags) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1, said
    assert words in said


def test_refuses_scenes_with_two_talkers(tmp_path_factory, capsys):
    folder = tmp_path_factory.getbasetemp() / "small"
    folder.mkdir(exist_ok=True)
    torch.set_default_dtype(torch.float64)
    scenes = training_scenes._made(folder)
    torch.set_default_dtype(torch.float32)
    assert fit("likelihood.yaml", "run", f"--data.init_args.train={scenes}") == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert "has 2 talkers, this tracker follows one" in said
