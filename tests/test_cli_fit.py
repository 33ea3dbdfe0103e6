"""probtrack fit: what a run leaves, how it goes on after a kill, and what it refuses."""

import csv
import io
import multiprocessing
import os
import pickle
import re
import signal
import sys
from pathlib import Path

import fit_walks
import pytest
import torch
import yaml

from probtrack.cli.main import main
from probtrack.training import physical_values, read_parameters
from probtrack.training.checkpoints import read_checkpoint

LR = "lr_scheduler: {class_path: %s, init_args: {%s}}\n"
PLATEAU = LR % (
    "lightning.pytorch.cli.ReduceLROnPlateau",
    "monitor: val/loss, patience: 0, threshold: 0.5, factor: 0.7",
)

CONFIG = """
model:
  class_path: fit_walks.WalkFit
data:
  class_path: fit_walks.WalkData
trainer:
  max_epochs: 4
"""


def with_model(argument):
    return CONFIG.replace("WalkFit\n", f"WalkFit\n  init_args: {{{argument}}}\n")


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


def one_line(capsys, code, *words):
    said = capsys.readouterr().err
    assert code == 2
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
    assert [(row["epoch"], row["step"]) for row in rows()] == [("1", "3"), ("2", "6"), ("3", "9"), ("4", "12")]
    made = yaml.safe_load(Path("run/parameters.yaml").read_text())
    weights = read_checkpoint("run/checkpoints/best.ckpt")["state_dict"]
    assert made["parameters"]["scale"] == pytest.approx(float(weights["model.log_scale"].exp()), rel=1e-6)
    assert made["made_by"]["val_loss"] == pytest.approx(float(rows()[-1]["val/loss"]))
    assert made["made_by"]["config"]["trainer"] == {"max_epochs": 4}
    assert made["made_by"]["config"]["data"]["init_args"]["count"] == 12
    again = fit_walks.Walk(9.0)
    read_parameters("run/parameters.yaml", again)
    assert physical_values(again)["drift"].tolist() == weights["model.drift"].tolist()


def in_a_process_of_its_own(*arguments):
    """Return how a process ended, which is started without importing anything anew."""
    process = multiprocessing.get_context("fork").Process(target=main, args=(list(arguments),))
    process.start()
    process.join()
    return process.exitcode


def assert_same(one, other):
    """Equal bit for bit, in all depths."""
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, other)
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for name in one:
            assert_same(one[name], other[name])
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    else:
        assert one == other


def test_after_a_kill_a_run_goes_on_to_the_same_result():
    config = write_config(text=CONFIG + PLATEAU)
    assert main(["fit", config, "-o", "whole"]) == 0
    assert in_a_process_of_its_own("fit", config, "-o", "cut", "--data.init_args.killed=2") == -signal.SIGKILL
    assert [row["epoch"] for row in rows("cut")] == ["1", "2"]
    assert not Path("cut/parameters.yaml").exists()
    with Path("cut/metrics.csv").open("a") as file:  # as if it had been killed between the row and the checkpoint
        file.write("3,9" + "," * (len(rows("cut")[0]) - 2) + "\n")
    assert main(["fit", config, "-o", "cut", "--ckpt_path", "last"]) == 0
    for name in ("last", "best"):
        assert_same(*(read_checkpoint(f"{run}/checkpoints/{name}.ckpt") for run in ("whole", "cut")))
    assert rows("whole") == rows("cut")
    assert len({row["learning_rate"] for row in rows("cut")}) > 2


def test_two_processes_take_the_step_of_one():
    flags = ("--trainer.max_epochs=2", "--trainer.accelerator=cpu", "--data.init_args.batch_size")
    assert fit(*flags, "12", out="one") == 0
    two = ("--trainer.strategy=ddp_fork", "--trainer.devices=2")
    assert fit(*flags, "6", *two, out="two") == 0
    one, other = (read_checkpoint(f"{run}/checkpoints/last.ckpt")["state_dict"] for run in ("one", "two"))
    epsilon = torch.finfo(torch.float32).eps
    for name in one:  # Adam divides by the root of the gradient's square: a rounding of it is one of the step
        torch.testing.assert_close(one[name], other[name], rtol=16 * epsilon, atol=16 * epsilon)
    for a, b in zip(rows("one"), rows("two"), strict=True):  # five walks validate: one process repeats one
        assert float(a["val/loss"]) == pytest.approx(float(b["val/loss"]), rel=16 * epsilon)


def test_a_class_beside_the_configuration_is_found(tmp_path):
    Path("elsewhere").mkdir()
    Path("elsewhere/walks_of_mine.py").write_text("import fit_walks\n\n\nclass Mine(fit_walks.WalkFit):\n    pass\n")
    config = write_config("elsewhere/fit.yaml", CONFIG.replace("fit_walks.WalkFit", "walks_of_mine.Mine"))
    assert main(["fit", config, "-o", "run", "--trainer.max_epochs=1"]) == 0
    assert str(tmp_path / "elsewhere") not in sys.path


def test_print_config_says_what_would_be_used(capsys):
    with pytest.raises(SystemExit) as stopped:
        fit("--print_config")
    said = yaml.safe_load(capsys.readouterr().out)
    assert stopped.value.code == 0
    assert said["model"]["init_args"]["learning_rate"] == 0.05
    assert (said["trainer"]["gradient_clip_val"], said["early_stopping"]["patience"]) == (1.0, 20)
    assert not Path("run").exists()


def test_a_run_stops_when_validation_no_longer_gains_and_stays_stopped():
    config = write_config(text=CONFIG.replace("max_epochs: 4", "max_epochs: 9"))
    flags = ("--early_stopping.patience=2", "--early_stopping.min_delta=10")
    assert main(["fit", config, "-o", "run", *flags]) == 0
    assert len(rows()) == 3  # the first counts as a gain
    assert main(["fit", config, "-o", "run", *flags, "--ckpt_path=last"]) == 0
    assert len(rows()) == 3
    assert main(["fit", config, "-o", "run", "--early_stopping.patience=4", flags[1], "--ckpt_path=last"]) == 0
    assert len(rows()) == 5


def test_the_parameters_are_those_of_the_lowest_validation_loss():
    assert fit("--model.init_args.learning_rate=1.5", "--trainer.max_epochs=2") == 0
    best = min(rows(), key=lambda row: float(row["val/loss"]))
    assert best["epoch"] == "1"
    made = yaml.safe_load(Path("run/parameters.yaml").read_text())
    assert made["parameters"]["scale"] == pytest.approx(float(best["parameter/scale"]))
    assert (made["made_by"]["epoch"], made["made_by"]["epochs"]) == (1, 2)
    assert made["made_by"]["val_loss"] == pytest.approx(float(best["val/loss"]))


def test_without_validation_the_last_epoch_is_kept(capsys):
    assert fit("--data.init_args.validate=false") == 0
    assert capsys.readouterr().out == "run/parameters.yaml: 4 epochs, no validation\n"
    assert not Path("run/checkpoints/best.ckpt").exists()
    made = yaml.safe_load(Path("run/parameters.yaml").read_text())
    assert made["made_by"]["val_loss"] is None
    assert made["parameters"]["scale"] == pytest.approx(float(rows()[-1]["parameter/scale"]))


def test_nan_names_epoch_batch_and_sequences_and_leaves_the_checkpoint_before(capsys):
    code = fit("--data.init_args.broken=2")
    said = capsys.readouterr().err.splitlines()
    assert code == 2
    assert len(said) == 3  # two epochs, and what went wrong in the third
    assert re.search(
        r"error: the loss is nan in epoch 3, batch \d \(sequences (\d+, )*0(, \d+)*\)\. Try a smaller", said[-1]
    )
    left = read_checkpoint("run/checkpoints/last.ckpt")
    assert left["epoch"] == 1
    assert all(value.isfinite().all() for value in left["state_dict"].values())


class Calls:
    """Pickled, it is a call of `os.mkdir` for whoever loads it."""

    def __reduce__(self):
        return (os.mkdir, ("owned",))


def crafted(path):
    torch.save({"state_dict": {}, "code": Calls()}, path)


def plain_pickle(path):
    Path(path).write_bytes(pickle.dumps(Calls()))


def truncated(path):
    buffer = io.BytesIO()
    torch.save({"state_dict": {"x": torch.zeros(1000)}}, buffer)
    Path(path).write_bytes(buffer.getvalue()[:2000])


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (crafted, "is no checkpoint of tensors and plain values, and nothing else is loaded"),
        (plain_pickle, "nothing else is loaded"),
        (truncated, "the checkpoint is truncated, or it is no checkpoint"),
        (lambda path: Path(path).touch(), "the checkpoint is empty"),
        (lambda path: torch.save([1, 2], path), "is no checkpoint of a fit: it has no state_dict"),
        (lambda _: None, "cannot read the checkpoint: No such file"),
    ],
    ids=["crafted", "pickle", "truncated", "empty", "other content", "missing"],
)
def test_refuses_what_is_no_checkpoint(make, said, capsys):
    make("bad.ckpt")
    one_line(capsys, fit("--ckpt_path", "bad.ckpt"), "bad.ckpt: ", said)
    assert not Path("owned").exists()
    assert not Path("run").exists()


def test_checkpoint_of_another_model_names_the_parameters_that_differ(capsys):
    assert fit("--trainer.max_epochs=1") == 0
    content = read_checkpoint("run/checkpoints/last.ckpt")
    content["state_dict"]["model.log_gain"] = content["state_dict"].pop("model.log_scale")
    torch.save(content, "other.ckpt")
    capsys.readouterr()
    words = ("missing model.log_scale; unexpected model.log_gain; other shape model.drift (2,) instead of (3,)",)
    one_line(capsys, fit("--ckpt_path=other.ckpt", "--model.init_args.width=3", out="new"), "other.ckpt: ", *words)
    content = read_checkpoint("run/checkpoints/last.ckpt")
    content["optimizer_states"][0]["param_groups"][0]["params"].pop()
    torch.save(content, "fewer.ckpt")
    one_line(
        capsys, fit("--ckpt_path=fewer.ckpt", out="new"), "is of a model with 2 trained parameters, this one has 3"
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (CONFIG.replace("WalkFit", "WalkFitt"), "model: fit_walks.WalkFitt: module 'fit_walks' has no attribute"),
        (CONFIG.replace("fit_walks.WalkFit", "torch.nn.Linear"), "torch.nn.Linear does not correspond to a subclass"),
        (with_model("scal: 2"), "model: fit_walks.WalkFit: Option 'scal' is not accepted"),
        (with_model("scale: much"), "scale: expected float, got much"),
        (with_model("learning_rate: -1"), "learning_rate must be finite and positive, got -1.0"),
        (CONFIG.replace("max_epochs", "max_epoch"), "Group 'trainer' does not accept option 'max_epoch'"),
        (CONFIG.replace("4", "four"), "trainer.max_epochs: expected int, got four"),
        (CONFIG + "  accelerator: abacus\n", "trainer: You selected an invalid accelerator name"),
        (
            CONFIG + LR % ("torch.optim.lr_scheduler.StepLR", ""),
            "lr_scheduler: the following arguments are required: step",
        ),
        (CONFIG + "  limit_val_batches: 0\n" + PLATEAU, "conditioned on metric val/loss which is not available"),
        ("model: {class_path: [", "--config: not YAML: "),
        ("data: {class_path: fit_walks.WalkData}", "the following arguments are required: model"),
    ],
)
def test_refuses_a_configuration_in_one_line(text, words, capsys):
    config = write_config(text=text)
    one_line(capsys, main(["fit", config, "-o", "run"]), words)


def test_refuses_files_that_are_not_there_and_folders_that_are_in_use(capsys):
    one_line(capsys, main(["fit", "none.yaml", "-o", "run"]), "config: File does not exist", "none.yaml")
    Path("mine").mkdir()
    Path("mine/letter.txt").touch()
    one_line(capsys, fit(out="mine"), "mine: is not empty and holds no run: name another folder")
    one_line(capsys, fit(out="mine/letter.txt"), "mine/letter.txt: is not a folder")
    one_line(capsys, fit("--ckpt_path=best"), "run/checkpoints/best.ckpt: there is none")
    assert fit("--trainer.max_epochs=1") == 0
    capsys.readouterr()
    one_line(capsys, fit(), "run: holds a run: name another folder, or go on with it by --ckpt_path last")


def test_what_failed_before_its_first_checkpoint_may_begin_again(capsys):
    one_line(capsys, fit("--data.init_args.broken=0"), "the loss is nan in epoch 1")
    assert fit("--trainer.max_epochs=1", "--ckpt_path=last") == 0
    assert "last.ckpt: there is none: the run begins with its first epoch" in capsys.readouterr().err


def test_on_a_terminal_a_bar_shows_losses_and_parameters(monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "200")
    assert fit("--trainer.max_epochs=2") == 0
    said = re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", capsys.readouterr().err)  # colours and movements of the cursor
    assert re.search(r"Epoch 1/1.* 3/3 .*train/loss: [\d.]+  val/loss: [\d.]+  scale: 1\.\d+", said)
    assert "epoch 1/2" not in said
