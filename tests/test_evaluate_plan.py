"""What a study file asks for that cannot be is said in one line before any work; what can be is planned as it says."""

import pytest
import torch
from quick_scenes import write_data_set
from study_command import recording as recording
from study_command import says, written
from study_command import study as study

from probtrack.errors import InputError
from probtrack.evaluation import load_study


@pytest.fixture(autouse=True)
def float32(float64_and_seed):  # noqa: ARG001
    """As commands have it."""
    torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"scenes": ["nowhere"]}, "nowhere: there is no such folder: a scene is a folder with audio.wav"),
        ({"scenes": ["empty"]}, "empty: is no scene and holds none"),
        ({"scenes": []}, "scenes must name at least one folder"),
        ({"scenes": ["near", "near"]}, "scenes: must differ, got near twice"),
        ({"scenes": [{"path": "near", "conditions": {"room": [1]}}]},
         "scenes: near: condition room must be a number, a text, true or false, got [1]"),
        ({"scenes": [{"path": "near", "conditions": {"gain": float("inf")}}]}, "gain must be finite, got inf"),
        ({"scenes": [{"path": "near", "conditions": ["hall"]}]}, "conditions must be values by name, got ['hall']"),
        ({"scenes": [{"path": "near", "name": 3}]}, "scenes: near: name must be text and not empty, got 3"),
        ({"scenes": [3]}, "scenes: must be a folder, or have path and perhaps name and conditions, got 3"),
        ({"scenes": [{"name": "x"}]}, "scenes: must have a path, got {'name': 'x'}"),
        ({"scenes": [{"path": "near", "nam": "x"}]}, "nothing is called 'nam': there are path, name, conditions"),
        ({"scenes": "near"}, "scenes must be a list, got 'near'"),
        ({"scenes": ["near/truth.csv"]}, "near/truth.csv: is a file, expected a folder"),
        ({"scenes": None}, "scenes"),
        ({"trackers": None}, "trackers"),
        ({"trackers": {}}, "trackers must hold at least one, such as one of lehmann2007"),
        ({"trackers": ["lehmann2007"]}, "trackers must be a mapping of names to what they are, got ['lehmann2007']"),
        ({"trackers": {"A": "kalman"}}, "trackers: A: nothing is called 'kalman': there are lehmann2007, and import"),
        ({"trackers": {"A": "odd_trackers.kalman"}}, "trackers: A: cannot import odd_trackers.kalman"),
        ({"trackers": {"A": "not_a_module.kalman"}}, "trackers: A: cannot import not_a_module.kalman: No module named"),
        ({"trackers": {"A": "odd_trackers.torch"}}, "trackers: A: odd_trackers.torch makes no tracker"),
        ({"trackers": {"A": "odd_trackers.nothing"}}, "A(num_particles=30): must make a Tracker, made a NoneType"),
        ({"trackers": {"A": ".."}}, "trackers: A: cannot import ..: "),
        ({"trackers": {"A": "slip.tracker"}}, "trackers: A: cannot import slip.tracker: ZeroDivisionError: division"),
        ({"trackers": {"A": "typo.tracker"}}, "trackers: A: cannot import typo.tracker: SyntaxError: "),
        ({"trackers": {"A": "leaves.tracker"}}, "trackers: A: cannot import leaves.tracker: SystemExit: 3"),
        ({"trackers": {"A": "odd_trackers.broken"}, "vary": {}}, "trackers: A: AttributeError: "),
        ({"trackers": {"A": "odd_trackers.simple"}}, "trackers: A: has no setting num_particles: there are none"),
        ({"trackers": {"A": "builtins.dict"}}, "trackers: A: no signature found for builtin type <class 'dict'>"),
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
        ({"vary": {"threshold": [0.5, float("nan")]}}, "vary: threshold must be finite, got nan"),
        ({"vary": {"threshold": [1, 1.0]}}, "vary: threshold: must differ, got 1.0 twice"),
        ({"trackers": {"A": {"class_path": "lehmann2007", "init_args": {"threshold": float("inf")}}}},
         "trackers: A: threshold must be finite, got inf"),
        ({"vary": {"seed": [3]}}, "vary: nothing else may be called seed, the name of what every table has"),
        ({"vary": {"rmse": [3]}}, "vary: nothing else may be called rmse, the name of a metric"),
        ({"scenes": [{"path": "near", "conditions": {"real_time_factor": 1}}]},
         "conditions: nothing else may be called real_time_factor"),
        ({"scenes": [{"path": "near", "conditions": {"num_particles": 1}}]},
         "conditions: nothing else may be called num_particles, the name of a varied setting"),
        ({"metrics": ["odd_trackers.Misnamed"]}, "metrics: nothing else may be called seconds"),
        ({"metrics": ["odd_trackers.Numbered"]}, "metrics: a name must be text, in one line and not empty, got 3"),
        ({"metrics": [{"class_path": "rmse", "name": " "}]}, "metrics: a name must be text, in one line and not empty"),
        ({"metrics": ["odd_trackers.Nameless"]},
         "metrics: odd_trackers.Nameless has no name: its class, or the study file, must give it one"),
        ({"metrics": ["odd_trackers.Slipped"]}, "odd_trackers.Slipped: ZeroDivisionError: division by zero (odd_"),
        ({"metrics": ["rmsd"]}, "metrics: nothing is called 'rmsd': there are rmse, track_loss"),
        ({"metrics": "rmse"}, "metrics must be a list, got 'rmse'"),
        ({"metrics": []}, "metrics must name at least one: there are rmse, track_loss"),
        ({"metrics": ["rmse", "rmse"]}, "metrics: must differ, got rmse twice"),
        ({"metrics": ["odd_trackers.Failing"]}, "metrics: odd_trackers.Failing is no TrackMetric"),
        ({"metrics": [{"class_path": "track_loss", "init_args": {"limit": 1}}]}, "nothing is called 'limit'"),
        ({"metrics": [{"class_path": "track_loss", "init_args": {"threshold": -1.0}}]}, "threshold must"),
        ({"runs": 0}, "runs must be"),
        ({"runs": "many"}, "got many"),
        ({"runs": 5_000_000}, "near: runs must be at most 110376 for a recording of 38 frames, got 5000000: several"),
        ({"start": "there"}, "start: expected one of 'truth', 'anywhere', got 'there'"),
        ({"seeds": 3}, "nothing is called 'seeds'"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_study_file_is_said_before_the_work(study, monkeypatch, changes, words):
    (study.folder / "empty").mkdir()
    for module, text in (("slip", "1 / 0"), ("typo", "def"), ("leaves", "raise SystemExit(3)")):
        (study.folder / f"{module}.py").write_text(text)
    monkeypatch.syspath_prepend(study.folder)
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
        ("time,x,y\n30,2.4,1.1\n40,2.4,1.1\n", {"start": "anywhere"},
         "truth.csv covers 30 s to 40 s, the recording 0 s to 0.6 s"),
        ("time,x,y\n-9,2.4,1.1\n-1,2.4,1.1\n", {"start": "anywhere"}, "truth.csv covers -9 s to -1 s, the recording"),
        ("time,x,y\n0,,\n0.7,,\n", {"start": "anywhere"}, "needs position in truth.csv, known in no frame"),
        ("time,x,y\n0.3,2.4,1.1\n0.6,2.4,1.1\n", {},
         "start: truth needs the position at the first frame, at 0.016 s, but truth.csv begins at 0.3 s"),
        ("time,x,y\n-0.3,2.4,1.1\n0.6,2.4,1.1\n", {}, "but truth.csv begins at -0.3 s; start: anywhere does without"),
    ],
)  # fmt: skip
def test_a_truth_that_lacks_what_is_needed_is_said(study, truth, changes, words):
    path = study.folder / "near" / "truth.csv"
    path.unlink() if truth is None else path.write_text(truth)
    says(study(**changes), "near", words)


@pytest.mark.parametrize(("begin", "end"), [(2, 3), (-3, -1)])
def test_a_metric_that_looks_beside_the_recording_is_said(study, begin, end):
    beside = {"class_path": "largest_jump", "init_args": {"begin": begin, "end": end}}
    says(study(metrics=[beside]), f"largest_jump looks from {begin} s to {end} s, where the recording, 0 s to 0.6 s")


def test_a_recording_shorter_than_a_frame_is_said(study):
    long = {"class_path": "lehmann2007", "init_args": {"frame_length": 16_384, "hop": 8192}}
    says(study(trackers={"A": long}), "audio.wav: is shorter than a frame: 9600 of 16384 samples at 16000 Hz")


def test_a_tracker_without_settings_needs_none(study):
    assert study(trackers={"A": "odd_trackers.simple", "B": "odd_trackers.open_ended"}, vary=None) == (0, [])


def test_a_data_set_that_is_half_made_is_said(study, tmp_path):
    (tmp_path / "data").mkdir()
    write_data_set(tmp_path / "data", "count: 3")
    (tmp_path / "data" / "mine.yaml").rename(tmp_path / "data" / "dataset.yaml")
    says(study(scenes=["data"]), "data: 3 of 3 scenes of the data set are missing", "run probtrack simulate again")


def test_a_word_is_no_file_whatever_lies_beside_the_study(study):
    for name in ("learned", "notes.txt"):
        (study.folder / name).write_text("beside")
    made = {
        word: {"class_path": "odd_trackers.worded", "init_args": {"words": word}} for word in ("learned", "notes.txt")
    }
    planned = load_study(written(study, trackers=made, vary=None))
    assert [one.arguments["words"] for one in planned.cells] == ["learned", str((study.folder / "notes.txt").resolve())]
    assert [*planned.config["files"]] == ["notes.txt"]


def test_a_cell_refuses_files_that_are_not_those_of_the_plan(study):
    (study.folder / "notes.txt").write_text("planned")
    settings = {"class_path": "odd_trackers.worded", "init_args": {"words": "notes.txt"}}
    (cell,) = load_study(written(study, trackers={"A": settings}, vary=None, runs=1)).cells
    before = cell.scores()
    (study.folder / "notes.txt").write_text("changed")
    with pytest.raises(InputError, match=r"^\S+/notes.txt: is another file than when the study was planned$"):
        cell.scores()
    (study.folder / "notes.txt").write_text("planned")
    truth = study.folder / "near" / "truth.csv"
    as_it_was = truth.read_text()
    truth.write_text(as_it_was + "0.7,2.4,1.1\n")
    with pytest.raises(InputError, match=r"^\S+/near: the files of this recording are others than when the study was"):
        cell.scores()
    truth.write_text(as_it_was)
    assert (cell.scores().numerator == before.numerator).all()
