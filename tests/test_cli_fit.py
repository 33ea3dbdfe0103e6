"""probtrack fit: what a run leaves, how it goes on after a kill, and what it refuses."""

import csv
import re
from pathlib import Path

import fit_walks
import pytest
import torch
import yaml

from probtrack.cli.main import main
from probtrack.training import physical_values, read_parameters
from probtrack.training.checkpoints import read_checkpoint

CONFIG = """
model:
  class_path: fit_walks.WalkFit
data:
  class_path: fit_walks.WalkData
trainer:
  max_epochs: 4
"""


@pytest.fixture(autouse=True)
def precision(tmp_path, monkeypatch):
    """In the precision that users have, and in a working directory that shows what is left there."""
    torch.set_default_dtype(torch.float32)
    monkeypatch.chdir(tmp_path)


def write_config(path="fit.yaml", text=CONFIG):
    Path(path).write_text(text)
    return str(path)


def fit(*flags, out="run"):
    return main(["fit", write_config(), "-o", out, *flags])


def rows(run="run"):
    with Path(run, "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def one_line(capsys, *words):
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1, said
    assert said.startswith("probtrack fit: error: ")
    assert all(word in said for word in words), said


def test_a_run_leaves_its_parameters_tables_and_checkpoints_and_nothing_elsewhere(tmp_path, capsys):
    assert fit() == 0
    said = capsys.readouterr()
    assert re.fullmatch(r"run/parameters.yaml: 4 epochs, validation loss [\d.]+ of epoch 4\n", said.out)
    assert len(said.err.splitlines()) == 4
    assert re.match(r"epoch 1/4: train/loss [\d.]+, val/loss [\d.]+, scale 1.\d+, drift_range 0.\d+", said.err)
    left = {str(path.relative_to("run")) for path in Path("run").rglob("*") if path.is_file()}
    assert {name for name in left if "tensorboard/" not in name} == {
        "config.yaml",
        "metrics.csv",
        "parameters.yaml",
        "checkpoints/best.ckpt",
        "checkpoints/last.ckpt",
    }
    assert any("tfevents" in name for name in left)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fit.yaml", "run"]
    assert [row["step"] for row in rows()] == ["3", "6", "9", "12"]
    made = yaml.safe_load(Path("run/parameters.yaml").read_text())
    weights = read_checkpoint("run/checkpoints/best.ckpt")["state_dict"]
    assert made["parameters"]["scale"] == pytest.approx(float(weights["model.log_scale"].exp()), rel=1e-6)
    assert made["made_by"]["val_loss"] == pytest.approx(float(rows()[-1]["val/loss"]))
    assert made["made_by"]["config"]["trainer"] == {"max_epochs": 4}
    assert made["made_by"]["config"]["data"]["init_args"]["count"] == 12
    again = fit_walks.Walk(9.0)
    read_parameters("run/parameters.yaml", again)
    assert physical_values(again)["drift"].tolist() == weights["model.drift"].tolist()
