"""The store of a study: claims, what is kept of cells, and files that are not what they were."""

import contextlib
import os
import sqlite3
import subprocess
import sys

import numpy as np
import pytest

from probtrack.errors import InputError, NotFiniteError
from probtrack.evaluation import CellScores, PlannedCell, PlannedScene, Store
from probtrack.evaluation.database import DamagedStoreError
from probtrack.evaluation.processes import started


@pytest.fixture
def path(tmp_path):
    """A store of three cells with two metrics."""
    scenes = [PlannedScene("hall", "ab12", {"t60": 0.3}, (7, 5)), PlannedScene("office", "cd34", {}, (11, 2**55))]
    cells = [PlannedCell(f"A on {name}", name, {"tracker": "A"}, 2) for name in ("hall", "office")]
    cells.append(PlannedCell("B on office", "office", {"tracker": "B"}, 2))
    Store.create(tmp_path / "s.sqlite", {"runs": 2}, scenes, [("rmse", "m"), ("lost", "%")], cells).close()
    return tmp_path / "s.sqlite"


def scores(first=0.25):
    return CellScores(np.array([[first, 0.5], [1.0, 0.0]]), np.ones((2, 2)), 1.5, 8.0)


def changed(path, *query):
    with contextlib.closing(sqlite3.connect(path)) as db, db:
        db.execute(*query)


def test_a_new_store_is_one_file_that_says_what_is_to_be_done(path):
    assert [one.name for one in path.parent.iterdir()] == ["s.sqlite"]
    with Store(path) as store:
        assert store.config == {"runs": 2}
        assert store.seeds("office") == [11, 2**55]
        assert store.fingerprints == {"hall": "ab12", "office": "cd34"}
        assert [(one.key, one.conditions, one.finished) for one in store.cells] == [
            ("A on hall", {"t60": 0.3}, None),
            ("A on office", {}, None),
            ("B on office", {}, None),
        ]
        assert store.progress == (0, 0)


def test_a_store_that_another_process_made_meanwhile_is_left_alone(path):
    before = path.read_bytes()
    Store.create(path, {"runs": 3}, [], [("other", "")], []).close()
    assert path.read_bytes() == before


def test_each_cell_is_claimed_once(path):
    with Store(path, write=True) as store, Store(path, write=True) as other:
        assert [store.claim(), other.claim(), store.claim(), other.claim()] == [1, 2, 3, None]
        assert store.workers == [os.getpid()]


@pytest.mark.parametrize("reaped", [True, False])
def test_what_a_killed_process_claimed_is_to_be_done_again(path, reaped):
    code = (
        f"from probtrack.evaluation import Store; print(Store({str(path)!r}, write=True).claim(), flush=True); input()"
    )
    child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stdin=subprocess.PIPE)
    try:
        assert child.stdout.readline() == b"1\n"
        with Store(path, write=True) as store:
            assert store.workers == [child.pid]
            assert store.claim() == 2
            store.release()
            child.kill()
            if reaped:
                child.wait()
            else:
                os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)  # dead, and nobody has buried it
            assert store.workers == []
            assert store.claim() == 1
    finally:
        child.kill()
        child.communicate()


def test_a_process_with_the_number_of_one_that_ended_is_another(path):
    changed(path, "UPDATE cell SET pid = ?, pid_since = '12345'", (os.getpid(),))
    with Store(path, write=True) as store:
        assert store.workers == []
        assert store.claim() == 1


def test_of_a_number_that_no_process_has_nothing_is_known():
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    assert started(child.pid) is None
    assert started(os.getpid()) == started(os.getpid()) is not None


def test_scores_come_back_as_they_were(path):
    with Store(path, write=True) as store:
        store.save(2, scores())
        rmse, lost = store.scores("rmse"), store.scores("lost")
        cell = store.cells[1]
    assert (rmse.cell.tolist(), rmse.run.tolist()) == ([2, 2], [0, 1])
    assert (rmse.numerator.tolist(), lost.numerator.tolist()) == ([0.25, 0.5], [1.0, 0.0])
    assert lost.denominator.tolist() == [1.0, 1.0]
    assert (cell.seconds, cell.duration) == (1.5, 8.0)
    assert cell.finished is not None


def test_of_two_that_did_a_cell_the_first_is_kept_and_a_failure_does_not_undo_it(path):
    with Store(path, write=True) as store:
        store.save(1, scores(0.25))
        store.save(1, scores(0.75))
        store.give_up(1, "too late")
        assert store.scores("rmse").numerator.tolist() == [0.25, 0.5]
        assert store.progress == (1, 0)


def test_a_failed_cell_is_not_claimed_until_it_is_retried(path):
    with Store(path, write=True) as store:
        store.give_up(store.claim(), "no such file")
        assert store.progress == (0, 1)
        assert store.cells[0].failure == "no such file"
        assert store.claim() == 2
        store.retry()
        assert store.claim() == 1


def test_a_released_cell_is_claimed_again_and_a_finished_one_is_not(path):
    with Store(path, write=True) as store:
        assert [store.claim(), store.claim()] == [1, 2]
        store.save(1, scores())
        store.release()
        assert [store.claim(), store.claim()] == [2, 3]


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_scores_that_are_not_finite_are_refused_and_nothing_of_them_is_kept(path, bad):
    with Store(path, write=True) as store:
        with pytest.raises(NotFiniteError, match="rmse is not finite in run"):
            store.save(1, scores(bad))
        assert store.progress == (0, 0)
        assert len(store.scores("lost").run) == 0


def test_a_transaction_that_fails_leaves_nothing_and_the_store_usable(path):
    changed(path, "CREATE TRIGGER t BEFORE UPDATE OF finished ON cell BEGIN SELECT RAISE(ABORT, 'full'); END")
    with Store(path, write=True) as store:
        with pytest.raises(InputError, match=r"s.sqlite: full"):
            store.save(1, scores())
        assert len(store.scores("rmse").run) == 0
        assert store.claim() == 1


def test_a_full_store_is_said_in_one_line_and_keeps_what_it_has(path):
    with Store(path, write=True) as store:
        store.save(1, scores())
        ((pages,),) = store._db.execute("PRAGMA page_count")
        store._db.execute(f"PRAGMA max_page_count = {pages}")
        many = CellScores(np.ones((2, 20_000)), np.ones((2, 20_000)), 1.0, 1.0)
        with pytest.raises(InputError, match=r"s.sqlite: database or disk is full$"):
            store.save(2, many)
        assert store.scores("rmse").numerator.tolist() == [0.25, 0.5]
        store.give_up(2, "x")
    with Store(path) as store:
        assert store.progress == (1, 1)


def test_scores_whose_bytes_have_changed_are_not_believed(path):
    with Store(path, write=True) as store:
        store.save(1, scores())
    changed(path, "UPDATE score SET numerator = ? WHERE metric = 1", (np.array([0.2, 0.5]).tobytes(),))
    with Store(path) as store, pytest.raises(InputError, match="is damaged"):
        store.scores("rmse")


@pytest.mark.parametrize(
    "damage",
    [
        "DELETE FROM score WHERE metric = 1 AND cell = 2",
        "UPDATE score SET cell = 3 WHERE metric = 1 AND cell = 2",
        "UPDATE cell SET finished = 1.0 WHERE id = 3",
    ],
)
def test_a_finished_cell_without_its_scores_is_damage(path, damage):
    with Store(path, write=True) as store:
        store.save(1, scores())
        store.save(2, scores())
    changed(path, damage)
    with Store(path) as store, pytest.raises(DamagedStoreError, match="scores are malformed"):
        store.scores("rmse")


def test_scores_of_fewer_runs_than_the_cell_has_are_damage(path):
    short = CellScores(np.ones((2, 1)), np.ones((2, 1)), 1.0, 1.0)
    with Store(path, write=True) as store:
        store.save(1, short)
        with pytest.raises(DamagedStoreError, match="scores are malformed"):
            store.scores("lost")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "not a study made by probtrack evaluate"),
        (b"time,x,y\n" * 200, "is damaged, or no study"),
    ],
)
def test_a_file_that_is_no_store_is_said(tmp_path, content, words):
    (tmp_path / "s.sqlite").write_bytes(content)
    with pytest.raises(InputError, match=words):
        Store(tmp_path / "s.sqlite")


def test_a_store_of_another_version_is_said(path):
    changed(path, "UPDATE meta SET value = '99' WHERE key = 'format'")
    with pytest.raises(InputError, match=r"a study of format 99, this version of probtrack reads format 2"):
        Store(path)


def test_a_missing_file_and_a_folder_are_said(tmp_path):
    with pytest.raises(InputError, match="no such study"):
        Store(tmp_path / "s.sqlite")
    with pytest.raises(InputError, match="is no file"):
        Store(tmp_path)


def test_an_unknown_metric_is_said_with_those_there_are(path):
    with Store(path) as store, pytest.raises(InputError, match="has no metric mse: there are rmse, lost"):
        store.scores("mse")


def test_a_place_where_no_store_can_be_made_is_said(tmp_path):
    with pytest.raises(InputError, match=r"none.s.sqlite: unable to open database file"):
        Store.create(tmp_path / "none" / "s.sqlite", {}, [], [], [])
