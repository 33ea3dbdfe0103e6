"""Files of stores: what is put beside them, folders that cannot be written, files that are no study, and damage."""

import contextlib
import os
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from stored_studies import save, write_study

from probtrack.errors import InputError
from probtrack.evaluation import PlannedCell, PlannedScene, Store
from probtrack.evaluation.database import DamagedStoreError


@pytest.fixture
def path(tmp_path):
    return write_study(tmp_path / "study.sqlite", finished=2)


def changed(path, query):
    with contextlib.closing(sqlite3.connect(path)) as db, db:
        assert db.execute(query).rowcount == 1


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE meta SET value = replace(value, '{', '[') WHERE key = 'config'",
        "UPDATE meta SET value = '7' WHERE key = 'cells'",
        "DELETE FROM meta WHERE key = 'checksum'",
        "DELETE FROM meta WHERE key = 'config'",
        "UPDATE metric SET unit = 'km' WHERE id = 1",
        "DELETE FROM metric WHERE id = 2",
    ],
)
def test_a_plan_that_has_changed_is_not_opened(path, damage):
    changed(path, damage)
    for write in (False, True):
        with pytest.raises(DamagedStoreError, match="the plan is malformed"):
            Store(path, write=write)


@pytest.mark.parametrize("damage", ["UPDATE seed SET seed = 7", "DELETE FROM seed"])
def test_seeds_that_have_changed_are_not_believed(path, damage):
    changed(path, f"{damage} WHERE scene = 'b' AND run = 2")
    with Store(path) as store:
        assert store.seeds("a") == [100, 101, 102, 103]
        with pytest.raises(DamagedStoreError, match="the plan is malformed"):
            store.seeds("b")


@pytest.mark.parametrize("column", ["finished", "seconds", "duration"])
def test_what_a_cell_took_is_not_believed_if_it_has_changed(path, column):
    changed(path, f"UPDATE cell SET {column} = {column} + 0.5 WHERE id = 2")
    with Store(path) as store, pytest.raises(DamagedStoreError, match="is malformed"):
        _ = store.cells


@pytest.mark.parametrize("tables", [[], ["CREATE TABLE meta (name TEXT)"], ["CREATE TABLE meta (key, value)"]])
def test_a_file_that_is_no_study_is_left_as_it_is(tmp_path, tables):
    path = tmp_path / "s.sqlite"
    path.touch()
    with contextlib.closing(sqlite3.connect(path)) as db:
        for table in tables:
            db.execute(table)
    before = path.read_bytes()
    with pytest.raises(InputError, match=r"s.sqlite: not a study made by probtrack evaluate$"):
        Store(path, write=True)
    assert path.read_bytes() == before


def test_a_copy_of_the_file_alone_has_what_is_finished(path, tmp_path):
    with Store(path, write=True) as store:
        save(store, 3, {"tracker": "soft"}, "b")
        shutil.copy(path, tmp_path / "copy.sqlite")
        with Store(tmp_path / "copy.sqlite") as copy:
            assert copy.progress == (3, 0)
            assert copy.scores("rmse").numerator.tolist() == store.scores("rmse").numerator.tolist()


@contextlib.contextmanager
def as_nobody():
    """Without the rights of the superuser, if this process has them."""
    before = os.geteuid()
    if before == 0:
        os.seteuid(65534)
    try:
        yield
    finally:
        if before == 0:
            os.seteuid(0)


def test_a_store_in_a_folder_that_cannot_be_written_can_be_read(path):
    folder = Path(tempfile.mkdtemp())
    try:
        shutil.copy(path, folder / "s.sqlite")
        folder.chmod(0o555)
        with as_nobody(), Store(folder / "s.sqlite") as store:
            assert store.progress == (2, 0)
            assert [one.name for one in folder.iterdir()] == ["s.sqlite"]
    finally:
        folder.chmod(0o755)
        shutil.rmtree(folder)


def test_what_a_killed_process_left_of_a_new_store_is_removed_and_nothing_else(tmp_path):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    left = [f".s.sqlite.{ended.pid}.tmp{end}" for end in ("", "-wal", "-shm")]
    kept = [f".s.sqlite.{os.getppid()}.tmp", f".other.sqlite.{ended.pid}.tmp", ".s.sqlite.mine.tmp"]
    for name in left + kept:
        (tmp_path / name).touch()
    write_study(tmp_path / "s.sqlite")
    assert sorted(one.name for one in tmp_path.iterdir()) == sorted([*kept, "s.sqlite"])


def test_a_disk_without_links_can_hold_a_store_and_one_that_is_there_is_left_alone(path, tmp_path, monkeypatch):
    def refused(*_):
        raise PermissionError("links are not supported")

    monkeypatch.setattr(os, "link", refused)
    before = path.read_bytes()
    Store.create(path, {}, [PlannedScene("x", "", {}, ())], [("other", "")], [PlannedCell("k", "x", {}, 1)]).close()
    assert path.read_bytes() == before
    write_study(tmp_path / "new.sqlite")
    assert sorted(one.name for one in tmp_path.iterdir()) == ["new.sqlite", "study.sqlite"]
