"""probtrack evaluate: one clear line for everything that can be wrong with a study, and nothing finished is lost."""

import os
import sqlite3
from contextlib import closing

import pytest
import torch
import yaml
from study_command import SMALL, says
from study_command import recording as recording
from study_command import study as study
from study_processes import start as start
from study_scenes import failures, numbers

from probtrack.cli.main import main
from probtrack.evaluation import Store


def test_frames_without_a_truth_do_not_count(study):
    (study.folder / "near" / "truth.csv").write_text("time,x,y\n0,2.4,1.1\n0.3,2.4,1.1\n0.6,,\n")
    assert study(metrics=["rmse", "track_loss"])[0] == 0
    assert all(value == (0.0, 0.0) for key, value in numbers(study.store).items() if key[0] == "track_loss")


@pytest.fixture(autouse=True)
def float32(float64_and_seed):  # noqa: ARG001
    """As commands have it."""
    torch.set_default_dtype(torch.float32)


def test_a_recording_that_cannot_be_used_is_said(study):
    with open(study.folder / "near" / "audio.wav", "r+b") as file:
        file.truncate(10)
    says(study(), "audio.wav")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"runs": 3}, "config.runs is 2 there and 3 here"),
        ({"vary": {"num_particles": [30, 55]}}, "config.vary.num_particles[1] is 45 there and 55 here"),
        ({"scenes": [{"path": "near", "conditions": {"room": "hall"}}]}, "recordings.near.room is None there"),
        ({"metrics": ["track_loss"]}, "config.metrics is ['rmse', 'track_loss'] there and ['track_loss'] here"),
    ],
)
def test_a_store_of_another_study_is_refused_with_the_difference(study, changes, words):
    assert study()[0] == 0
    before = numbers(study.store)
    says(study(**changes), "s.sqlite: holds another study: ", words, "another name, or --new, begins anew")
    assert numbers(study.store) == before


def test_a_recording_that_changed_is_refused(study):
    assert study()[0] == 0
    with open(study.folder / "near" / "truth.csv", "a") as file:
        file.write("0.7,2.4,1.1\n")
    says(study(), "the files of recording near are others now")


def test_a_file_of_parameters_that_changed_is_refused(study):
    mine = study.folder / "mine.yaml"
    text = "parameters:\n  filter.likelihood.exponent: 1.5\n"
    mine.write_text(text)
    settings = {"class_path": "lehmann2007", "init_args": {"parameters": "mine.yaml"}}
    assert study(trackers={"A": settings}) == (0, [])
    mine.write_text(text + "# another\n")
    says(study(trackers={"A": settings}), "config.files.mine.yaml is ")


def test_new_keeps_the_store_that_was_there(study):
    assert study()[0] == 0
    before = numbers(study.store)
    code, said = study("--new", runs=3)
    assert code == 0
    assert said == [f"probtrack evaluate: warning: the store that was there is now {study.folder / 's.1.sqlite'}"]
    assert numbers(study.folder / "s.1.sqlite") == before
    assert len(numbers(study.store)) == 3 * 2 * 2
    study("--new")
    assert len(numbers(study.folder / "s.2.sqlite")) == 3 * 2 * 2


def test_new_does_not_take_a_store_from_a_process_at_work(study):
    assert study()[0] == 0
    with closing(sqlite3.connect(study.store)) as db, db:
        db.execute("UPDATE cell SET finished = NULL WHERE id = 1")
    with Store(study.store, write=True) as store:
        store.claim()
        says(study("--new"), f"process {os.getpid()} is at work on it")


def test_new_puts_a_damaged_store_aside_too(study):
    study.store.write_bytes(b"not a store" * 100)
    says(study(), "s.sqlite: is damaged, or no study", "probtrack study export")
    code, _ = study("--new")
    assert code == 0
    assert (study.folder / "s.1.sqlite").read_bytes() == b"not a store" * 100


def test_a_store_of_which_bytes_changed_is_not_gone_on_with(study):
    assert study()[0] == 0
    with closing(sqlite3.connect(study.store)) as db, db:
        db.execute("UPDATE score SET numerator = zeroblob(16) WHERE metric = 1 AND cell = 2")
    says(study(), "s.sqlite: is damaged")


def test_a_store_that_was_cut_off_is_said(study):
    assert study()[0] == 0
    os.truncate(study.store, 5000)
    says(study(), "s.sqlite: is damaged")


def test_places_and_names_that_cannot_be_are_said(study, tmp_path, capsys):
    assert study()[0] == 0
    config = str(tmp_path / "study.yaml")
    capsys.readouterr()
    (tmp_path / "folder.sqlite").mkdir()
    for out, words in (
        ("s.csv", "a store ends in .sqlite, got .csv"),
        ("none/s.sqlite", "there is no folder"),
        ("folder.sqlite", "is no file"),
    ):
        says((main(["evaluate", config, "-o", str(tmp_path / out)]), capsys.readouterr().err.splitlines()), words)
    says(study("--workers", "0"), "--workers must be at least 1, got 0")
    says(study("--workers", "2", "--scheduler", "tcp://x:1"), "with --scheduler the cluster has its own")
    says((main(["evaluate", str(tmp_path), "-o", "s.sqlite"]), capsys.readouterr().err.splitlines()), "cannot read")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"trackers": {"A": "odd_trackers.not_finite"}}, "the track is not finite at 0.288 s in the run of seed "),
        ({"metrics": ["rmse", "odd_trackers.NoNumber"]}, "no_number is not finite, nan over 1, in the run of seed "),
    ],
)
def test_a_figure_that_is_not_a_number_fails_its_cell_alone(study, changes, words):
    if "trackers" in changes:
        changes["trackers"]["B"] = "lehmann2007"
    code, (said,) = study(**changes)
    assert code == 2
    with Store(study.store) as store:
        seeds = store.seeds("near")
        assert store.progress == ((2, 2) if "trackers" in changes else (0, 2))
    assert len(failures(study.store)) == 2
    assert f"2 of {4 if 'trackers' in changes else 2} cells failed, the first: A(num_particles=30) on near: " in said
    assert f"{words}{seeds[1]}" in said


def test_a_failed_cell_is_tried_again_and_forgotten_when_it_succeeds(study):
    audio = study.folder / "near" / "audio.wav"
    assert study(runs=1)[0] == 0
    with closing(sqlite3.connect(study.store)) as db, db:
        db.execute("DELETE FROM score WHERE cell = 2")
        db.execute("UPDATE cell SET finished = NULL, failure = 'no disk' WHERE id = 2")
    assert audio.exists()
    assert study(runs=1)[0] == 0
    assert failures(study.store) == {}
    assert len(numbers(study.store)) == 2 * 2


def test_a_disk_that_gets_full_is_one_line_and_loses_nothing_finished(study, start):
    particles = list(range(20, 28))
    changes = {"vary": {"num_particles": particles}, "runs": 200}
    study.folder.joinpath("study.yaml").write_text(yaml.safe_dump({**SMALL, **changes}))
    arguments = ["evaluate", str(study.folder / "study.yaml"), "-o", str(study.store)]
    # the store begins, and has no room for more after some cells
    process = start(*arguments, largest_file=80_000, said=str(study.folder / "said"))
    process.join()
    assert process.exitcode == 2
    (line,) = (study.folder / "said").read_text().splitlines()
    assert line.startswith(f"probtrack evaluate: error: {study.store}: ")
    kept = numbers(study.store)
    assert 0 < len(kept) < len(particles) * 2 * 200
    assert main(arguments) == 0
    everything = numbers(study.store)
    assert len(everything) == len(particles) * 2 * 200
    assert {key: everything[key] for key in kept} == kept
