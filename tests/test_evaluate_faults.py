"""probtrack evaluate: one clear line for everything that can be wrong with a study, and nothing finished is lost."""

import os
import shutil
import sqlite3
from contextlib import closing

import pytest
import torch
import yaml
from quick_scenes import write_data_set
from study_processes import start as start
from study_scenes import failures, numbers, write_recording

from probtrack.cli.main import main
from probtrack.evaluation import Store

SMALL = {"scenes": ["near"], "trackers": {"A": "lehmann2007"}, "vary": {"num_particles": [30, 45]}, "runs": 2}


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    write_recording(folder / "near", (2.4, 1.1, 1.3), 0.6)
    return folder / "near"


@pytest.fixture(autouse=True)
def float32(float64_and_seed):  # noqa: ARG001
    """As commands have it."""
    torch.set_default_dtype(torch.float32)


@pytest.fixture
def study(tmp_path, recording, capsys):
    """Run a study with changes, and return its code and the lines it said."""
    shutil.copytree(recording, tmp_path / "near")

    def run(*flags, **changes):
        content = {key: value for key, value in {**SMALL, **changes}.items() if value is not None}
        (tmp_path / "study.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
        code = main(["evaluate", str(tmp_path / "study.yaml"), "-o", str(tmp_path / "s.sqlite"), *flags])
        return code, capsys.readouterr().err.splitlines()

    run.folder, run.store = tmp_path, tmp_path / "s.sqlite"
    return run


def says(outcome, *words):
    """The command ended with 2 and said all of `words` in its one line."""
    code, lines = outcome
    assert code == 2
    assert len(lines) == 1, lines
    assert lines[0].startswith("probtrack evaluate: error: ")
    for word in words:
        assert word in lines[0], lines[0]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"scenes": ["nowhere"]}, "nowhere: there is no such folder: a scene is a folder with audio.wav"),
        ({"scenes": ["empty"]}, "empty: is no scene and holds none"),
        ({"scenes": []}, "scenes must name at least one folder"),
        ({"scenes": ["near", "near"]}, "scenes: must differ, got near twice"),
        ({"scenes": [{"path": "near", "conditions": {"room": [1]}}]}, "conditions"),
        ({"scenes": None}, "scenes"),
        ({"trackers": None}, "trackers"),
        ({"trackers": {}}, "trackers must hold at least one, such as one of lehmann2007"),
        ({"trackers": ["lehmann2007"]}, "trackers must be a mapping of names to what they are, got ['lehmann2007']"),
        ({"trackers": {"A": "kalman"}}, "trackers: A: nothing is called 'kalman': there are lehmann2007, and import"),
        ({"trackers": {"A": "odd_trackers.kalman"}}, "trackers: A: cannot import odd_trackers.kalman"),
        ({"trackers": {"A": "not_a_module.kalman"}}, "trackers: A: cannot import not_a_module.kalman: No module named"),
        ({"trackers": {"A": "odd_trackers.torch"}}, "trackers: A: odd_trackers.torch makes no tracker"),
        ({"trackers": {"A": "odd_trackers.nothing"}}, "A(num_particles=30): must make a Tracker, made a NoneType"),
        ({"trackers": {"A": {"init_args": {}}}}, "trackers: A: must be a name, or have class_path"),
        ({"trackers": {"A": {"class_path": "lehmann2007", "init_args": {"particles": 3}}}},
         "trackers: A: has no setting particles: there are model, parameters, num_particles"),
        ({"trackers": {"A": {"class_path": "lehmann2007", "init_args": {"model": "CU-LAM"}}}},
         "trackers: A: model: expected one of 'CU-RWVE'"),
        ({"trackers": {"A": {"class_path": "lehmann2007", "init_args": {"hop": "long"}}}}, "got long"),
        ({"trackers": {"A": {"class_path": "lehmann2007", "init_args": {"threshold": -3.0}}}},
         "A(num_particles=30): threshold must"),
        ({"vary": {"particles": [3]}}, "trackers: A: has no setting particles: there are model, parameters"),
        ({"vary": {"num_particles": []}}, "vary: num_particles must be a list of values, at least one"),
        ({"vary": {"num_particles": [3, 3]}}, "vary: num_particles: must differ, got 3 twice"),
        ({"vary": {"num_particles": 3}}, "got 3"),
        ({"metrics": ["rmsd"]}, "metrics: nothing is called 'rmsd': there are rmse, track_loss"),
        ({"metrics": "rmse"}, "metrics must be a list, got 'rmse'"),
        ({"metrics": []}, "metrics must name at least one: there are rmse, track_loss"),
        ({"metrics": ["rmse", "rmse"]}, "metrics: must differ, got rmse twice"),
        ({"metrics": ["odd_trackers.Failing"]}, "metrics: odd_trackers.Failing is no TrackMetric"),
        ({"metrics": [{"class_path": "track_loss", "init_args": {"limit": 1}}]}, "nothing is called 'limit'"),
        ({"metrics": [{"class_path": "track_loss", "init_args": {"threshold": -1.0}}]}, "threshold must"),
        ({"runs": 0}, "runs must be"),
        ({"runs": "many"}, "got many"),
        ({"start": "there"}, "start: expected one of 'truth', 'anywhere', got 'there'"),
        ({"seeds": 3}, "nothing is called 'seeds'"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_study_file_is_said_before_the_work(study, changes, words):
    (study.folder / "empty").mkdir()
    says(study(**changes), str(study.folder), words)
    assert not study.store.exists()


@pytest.mark.parametrize(
    ("truth", "changes", "words"),
    [
        (None, {}, "start: truth needs one talker in truth.csv, with a position in its first row"),
        (None, {"start": "anywhere"}, "metric rmse needs truth.csv with position"),
        ("time,azimuth\n0,0.3\n0.4,0.3\n", {"start": "anywhere"}, "metric rmse needs truth.csv with position"),
        ("time,azimuth\n0,0.3\n0.4,0.3\n", {"metrics": ["azimuth_rmse"]}, "start: truth needs"),
        ("time,x,y\n0,,\n0.2,2.4,1.1\n0.4,2.4,1.1\n", {}, "start: truth needs"),
        ("time,track,x,y\n0,1,2.4,1.1\n0,2,1,1\n0.4,1,2.4,1.1\n0.4,2,1,1\n", {"start": "anywhere"},
         "metric rmse is of one talker, truth.csv has 2"),
        ("where,when\n1,2\n", {}, "truth.csv"),
    ],
)  # fmt: skip
def test_a_truth_that_lacks_what_is_needed_is_said(study, truth, changes, words):
    path = study.folder / "near" / "truth.csv"
    path.unlink() if truth is None else path.write_text(truth)
    says(study(**changes), "near", words)


def test_frames_without_a_truth_do_not_count(study):
    (study.folder / "near" / "truth.csv").write_text("time,x,y\n0,2.4,1.1\n0.3,2.4,1.1\n0.6,,\n")
    assert study(metrics=["rmse", "track_loss"])[0] == 0
    assert all(value == (0.0, 0.0) for key, value in numbers(study.store).items() if key[0] == "track_loss")


def test_a_recording_that_cannot_be_used_is_said(study):
    with open(study.folder / "near" / "audio.wav", "r+b") as file:
        file.truncate(10)
    says(study(), "audio.wav")


def test_a_data_set_that_is_half_made_is_said(study, tmp_path):
    (tmp_path / "data").mkdir()
    write_data_set(tmp_path / "data", "count: 3")
    (tmp_path / "data" / "mine.yaml").rename(tmp_path / "data" / "dataset.yaml")
    says(study(scenes=["data"]), "data: 3 of 3 scenes of the data set are missing", "run probtrack simulate again")


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
    study.folder.joinpath("study.yaml").write_text(yaml.safe_dump({**SMALL, "vary": {"num_particles": particles}}))
    arguments = ["evaluate", str(study.folder / "study.yaml"), "-o", str(study.store)]
    # the store begins, and what SQLite writes beside it for each cell has no room after some
    process = start(*arguments, largest_file=80_000, said=str(study.folder / "said"))
    process.join()
    assert process.exitcode == 2
    (line,) = (study.folder / "said").read_text().splitlines()
    assert line.startswith(f"probtrack evaluate: error: {study.store}: ")
    kept = numbers(study.store)
    assert 0 < len(kept) < len(particles) * 4
    assert main(arguments) == 0
    everything = numbers(study.store)
    assert len(everything) == len(particles) * 4
    assert {key: everything[key] for key in kept} == kept
