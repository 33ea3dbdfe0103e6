"""A study's numbers: the same whoever does the work and however often it is stopped, and nothing finished is lost."""

import dataclasses
import multiprocessing
import os
import signal
import time

import numpy as np
import pytest
import torch
from study_processes import descendants, finished, running, wait_until
from study_processes import start as start
from study_scenes import CELLS, STUDY, claimed, failures, numbers, same, write_recordings, write_study

from probtrack.cli.main import main
from probtrack.errors import InputError
from probtrack.evaluation import Store, cell, evaluate, execution, load_study
from probtrack.evaluation.run import _numbered, open_store
from probtrack.metrics import RootMeanSquareError, Talkers
from probtrack.simulation import SceneFolder
from probtrack.trackers import lehmann2007


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    write_recordings(folder)
    return folder


@pytest.fixture(scope="module")
def undisturbed(folder):
    """The numbers of the study in one go."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    assert main(["evaluate", write_study(folder), "-o", str(folder / "undisturbed.sqlite")]) == 0
    torch.set_default_dtype(before)
    return numbers(folder / "undisturbed.sqlite")


@pytest.fixture(autouse=True)
def float32(float64_and_seed):  # noqa: ARG001
    """As commands have it."""
    torch.set_default_dtype(torch.float32)


@pytest.fixture
def study(folder):
    return load_study(write_study(folder))


def test_scores_are_those_of_each_run_tracked_alone(folder, study, undisturbed):
    scene = SceneFolder(folder / "far")
    tracker = lehmann2007(scene.array, scene.region, "CU-TCVE", num_particles=65, resample="stratified")
    (table,) = scene.truth
    seeds = next(one.seeds for one in study.scenes if one.name == "far")
    with torch.inference_mode():
        for run, seed in enumerate(seeds):
            track = tracker(scene.open_recording().read(), int(seed), table.position[0].float())
            estimate = Talkers.of_track(track)
            parts = RootMeanSquareError().parts(estimate, Talkers.of_tables([table], track.time))
            assert undisturbed["rmse", "B(num_particles=65) on far", run] == pytest.approx(
                (float(parts.total), float(parts.count)), rel=1e-4
            )


def test_seeds_differ_between_runs_and_recordings_and_are_shared_by_trackers(study):
    seeds = {one.scene: one.seeds for one in study.cells}
    assert all(one.seeds == seeds[one.scene] for one in study.cells)
    assert len({*seeds["near"], *seeds["far"]}) == 6


def test_another_seed_gives_other_numbers(folder, undisturbed, tmp_path):
    study = load_study(write_study(folder, seed=6))
    write_study(folder)
    evaluate(study, tmp_path / "s.sqlite")
    there = numbers(tmp_path / "s.sqlite")
    assert all(there[key] != undisturbed[key] for key in undisturbed if key[0] == "rmse")


def test_what_is_stored_of_a_cell(folder, undisturbed):
    assert undisturbed
    with Store(folder / "undisturbed.sqlite") as store:
        last = store.cells[-1]
        assert store.metrics == {"rmse": "m", "far_off": "%"}
        assert last.settings == {"tracker": "B", "num_particles": 65}
        assert last.conditions == {"room": "hall"}
        assert last.runs == STUDY["runs"]
        assert last.duration == pytest.approx(0.7)
        assert 0 < last.seconds < 10


def planned(folder, **changes):
    study = load_study(write_study(folder, **changes))
    write_study(folder)
    return study


def reversed_order(names):
    return dict(reversed(names.items())) if isinstance(names, dict) else names[::-1]


@pytest.mark.parametrize("name", ["scenes", "trackers", "vary"])
def test_a_study_file_in_another_order_is_the_same_study_and_its_cells_stay_what_they_are(folder, tmp_path, name):
    both = {**STUDY, "vary": {"num_particles": [40, 65], "exponent": [1.0, 2.0]}, "metrics": ["rmse"], "runs": 1}
    first, second = (planned(folder, **changes) for changes in (both, {**both, name: reversed_order(both[name])}))
    assert [one.key for one in first.cells] != [one.key for one in second.cells]
    with open_store(first, tmp_path / "s.sqlite") as store:
        stored = store.cells
    with open_store(second, tmp_path / "s.sqlite") as store:
        cells = _numbered(second, store)
    assert [(cells[one.id].scene, cells[one.id].settings) for one in stored] == [
        (one.scene, one.settings) for one in first.cells
    ]


def test_runs_worked_on_in_parts_give_the_same_scores(study, monkeypatch):
    whole = study.cells[1].scores()
    monkeypatch.setattr(cell, "_AT_ONCE", 2 * 65)  # two runs of three
    parts = study.cells[1].scores()
    np.testing.assert_array_equal(parts.numerator, whole.numerator)
    np.testing.assert_array_equal(parts.denominator, whole.denominator)


def test_more_runs_than_the_memory_holds_are_refused_before_the_work(study, monkeypatch):
    monkeypatch.setattr(cell, "_FRAMES", 100)  # 44 frames each
    with pytest.raises(InputError, match=r"runs must be at most 2 for a recording of 44 frames, got 3"):
        study.cells[0].scores()


def test_a_call_that_is_interrupted_lets_go_of_its_cells_and_is_gone_on_with(study, undisturbed, tmp_path, monkeypatch):
    todo = iter(range(3))

    def interrupted(one):
        if next(todo, None) is None:
            raise KeyboardInterrupt
        return one.scores()

    with monkeypatch.context() as patched:
        patched.setattr(execution, "attempt", interrupted)
        with pytest.raises(KeyboardInterrupt):
            evaluate(study, tmp_path / "s.sqlite")
    assert finished(tmp_path / "s.sqlite") == 3
    assert claimed(tmp_path / "s.sqlite") == []
    before = []
    last = evaluate(study, tmp_path / "s.sqlite", on_progress=lambda one: before.append(one.before))
    assert (last.done, before) == (CELLS, [3] * (CELLS - 3 + 1))
    assert same(numbers(tmp_path / "s.sqlite"), undisturbed)


def test_a_worker_that_is_killed_ends_the_call_in_one_line_and_costs_its_cell(study, undisturbed, tmp_path):
    killed = []

    def kill_one(progress):
        if progress.done == 2 and not killed:
            killed.append(multiprocessing.active_children()[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    with pytest.raises(InputError, match="a worker was killed, perhaps for want of memory: start again") as error:
        evaluate(study, tmp_path / "s.sqlite", workers=2, on_progress=kill_one)
    assert "\n" not in str(error.value)
    assert claimed(tmp_path / "s.sqlite") == []
    assert finished(tmp_path / "s.sqlite") >= 2
    evaluate(study, tmp_path / "s.sqlite")
    assert same(numbers(tmp_path / "s.sqlite"), undisturbed)


def asleep(*_, **__):
    time.sleep(3600)


def test_ctrl_c_ends_workers_at_once_and_keeps_what_they_finished(study, undisturbed, tmp_path):
    # a cell of hours is running then
    endless = [dataclasses.replace(one, make_tracker=asleep) for one in study.cells[2:]]
    long = dataclasses.replace(study, cells=(*study.cells[:2], *endless))
    begin = []

    def interrupt(progress):
        if progress.done == 2:
            begin.append(time.monotonic())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate(long, tmp_path / "s.sqlite", workers=2, on_progress=interrupt)
    assert time.monotonic() - begin[0] < 3
    assert multiprocessing.active_children() == []
    assert finished(tmp_path / "s.sqlite") == 2
    evaluate(study, tmp_path / "s.sqlite")
    assert same(numbers(tmp_path / "s.sqlite"), undisturbed)


def test_killed_again_and_again_gives_the_same_numbers(start, folder, undisturbed, tmp_path):
    path, study = tmp_path / "s.sqlite", write_study(folder)
    for cells, workers in ((1, 2), (4, 1)):
        process = start("evaluate", study, "-o", str(path), "--workers", str(workers))
        wait_until(lambda cells=cells: finished(path) >= cells)
        time.sleep(0.03 * cells)  # somewhere within the next
        begun = descendants(process.pid)
        process.kill()
        process.join()
        assert len(begun) >= (2 if workers == 2 else 0)
        wait_until(lambda begun=begun: not any(map(running, begun)), 5.0)
        assert len(claimed(path)) <= workers  # what it was working on
    assert finished(path) < CELLS
    assert main(["evaluate", study, "-o", str(path)]) == 0
    assert same(numbers(path), undisturbed)
    assert claimed(path) == []


def test_two_processes_on_one_store_share_the_cells(start, folder, undisturbed, tmp_path):
    path, study = tmp_path / "s.sqlite", write_study(folder)
    two = [start("evaluate", study, "-o", str(path)) for _ in range(2)]
    for process in two:
        process.join()
    assert [process.exitcode for process in two] == [0, 0]
    assert same(numbers(path), undisturbed)
    assert list(tmp_path.glob(".*")) == []


def test_cells_that_fail_leave_the_others_alone_and_are_tried_again(folder, tmp_path, capsys):
    path = tmp_path / "s.sqlite"
    study = write_study(folder, trackers={"A": "lehmann2007", "C": "odd_trackers.failing"})
    try:
        assert main(["evaluate", study, "-o", str(path)]) == 2
        said = capsys.readouterr().err.splitlines()
        assert said[-1].startswith("probtrack evaluate: error: 2 of 8 cells failed, the first: C(num_particles=65)")
        assert finished(path) == 6
        assert len(failures(path)) == 2
        assert main(["evaluate", study, "-o", str(path)]) == 2  # tried again
    finally:
        write_study(folder)
    assert "ZeroDivisionError: division by zero (odd_trackers.py, line " in capsys.readouterr().err


def test_numbers_of_another_precision_are_not_mixed(folder, undisturbed):
    assert undisturbed
    torch.set_default_dtype(torch.float64)
    with pytest.raises(InputError, match=r"holds another study: config.dtype is 'float32' there and 'float64' here"):
        evaluate(load_study(write_study(folder)), folder / "undisturbed.sqlite")
