"""A study of which another process holds cells: they are waited for, and taken over if it ends."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from itertools import chain, count

import numpy as np
import pytest
import torch
from study_scenes import write_recording, write_study

from probtrack.evaluation import CellScores, Store, evaluate, execution, load_study
from probtrack.evaluation.execution import in_processes
from probtrack.evaluation.processes import started


@pytest.fixture
def study(tmp_path, monkeypatch):
    """A study of two cells of one run, which is looked at often."""
    monkeypatch.setattr(execution, "LOOK", 0.01)
    torch.set_default_dtype(torch.float32)
    write_recording(tmp_path / "near", (2.4, 1.1, 1.3), 0.6)
    changes = {"scenes": ["near"], "trackers": {"A": "lehmann2007"}, "vary": {"num_particles": [20, 30]}, "runs": 1}
    return load_study(write_study(tmp_path, **changes))


SCORES = CellScores(np.full((2, 1), 0.25), np.ones((2, 1)), 1.0, 0.6)


def held(study, path, pid, since):
    """Make a store whose first cell a process has claimed."""
    units = [(metric.name, metric.unit) for metric in study.metrics]
    with Store.create(path, study.config, study.scenes, units, study.planned) as store:
        store._db.execute("UPDATE cell SET pid = ?, pid_since = ? WHERE id = 1", (pid, since))


def test_cells_of_a_process_at_work_are_waited_for(study, tmp_path):
    path, seen = tmp_path / "s.sqlite", []
    held(study, path, os.getppid(), started(os.getppid()))

    def fellow(progress):
        seen.append(progress.done)
        if len(seen) == 5:
            with Store(path, write=True) as store:
                store.save(1, SCORES)

    last = evaluate(study, path, on_progress=fellow)
    assert (last.done, last.failed, seen) == (2, 0, [0, 1, 1, 1, 1, 2])


def test_cells_of_a_process_that_ends_meanwhile_are_taken_over(study, tmp_path):
    path, seen = tmp_path / "s.sqlite", []
    held(study, path, os.getppid(), started(os.getppid()))

    def killed(progress):
        seen.append(progress.done)
        if len(seen) == 4:
            with Store(path, write=True) as store:
                store._db.execute("UPDATE cell SET pid_since = 'of one before' WHERE id = 1")

    assert evaluate(study, path, on_progress=killed).done == 2
    assert seen == [0, 1, 1, 1, 2]


def test_what_went_wrong_in_another_process_is_said(study, tmp_path):
    path = tmp_path / "s.sqlite"
    held(study, path, os.getppid(), started(os.getppid()))

    def fellow(progress):
        if progress.done == 1:
            with Store(path, write=True) as store:
                store.give_up(1, "no such file")

    last = evaluate(study, path, on_progress=fellow)
    assert (last.done, last.failed, last.failure) == (1, 1, "no such file")


class Threads(ThreadPoolExecutor):
    """Workers that need not be started."""

    def __init__(self, workers, *_):
        super().__init__(workers)


GO = threading.Event()


class Waiting:
    """A cell that is worked on until another is."""

    def scores(self):
        assert GO.wait(10)
        return SCORES


class Freeing:
    """The other."""

    def scores(self):
        GO.set()
        return SCORES


def test_what_is_to_be_done_while_the_last_cells_run_is_worked_on_by_idle_workers(monkeypatch):
    GO.clear()
    monkeypatch.setattr(execution, "LOOK", 0.01)
    monkeypatch.setattr(execution, "ProcessPoolExecutor", Threads)
    there = chain([(1, Waiting()), None, None, (2, Freeing())], (None for _ in count()))
    work = in_processes(lambda: next(there), 2)
    outcomes = [next(work) for _ in range(6)]
    work.close()
    assert outcomes[0] is None
    assert {one.id for one in outcomes if one is not None} == {1, 2}
