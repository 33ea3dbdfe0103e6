"""Data sets: the same files whatever the workers, gone on with where they stopped, and never mixed with another."""

import dataclasses
import errno
import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest
from quick_scenes import HARD, quick, two_talkers, write_data_set

from probtrack.errors import InputError
from probtrack.simulation import (
    DataSet,
    Faults,
    ResponseCache,
    SceneFolder,
    Truth,
    data_set,
    load_data_set,
    make_data_set,
    read_manifest,
)
from probtrack.simulation import save_scene as save
from probtrack.simulation.estimate import estimate

SHORT = quick(duration=1.65)
ECHO = quick(room=HARD, duration=1.65)


def make(scenes, folder, **options):
    return list(make_data_set(scenes, folder, folder.parent / "cache", **options))


def content(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def files(folder):
    return {
        str(p.relative_to(folder)): p.stat().st_mtime_ns for p in folder.rglob("*") if p.suffix in (".wav", ".yaml")
    }


def complete(folder, scenes):
    """Assert that the folder holds the whole data set and nothing else."""
    names = [name for index in range(scenes.count) for name in scenes.recordings(index)]
    assert [row["folder"] for row in read_manifest(folder)] == names
    assert {path.name for path in folder.iterdir()} == {*names, "manifest.csv", "dataset.yaml", "inputs.yaml"}
    for name in names:
        parts = {path.name for path in (folder / name).iterdir()}
        assert parts == {"audio.wav", "array.yaml", "truth.csv", "scene.yaml", "voices.csv"}


@pytest.mark.slow
def test_the_same_files_with_one_worker_and_with_two(tmp_path):
    scenes = DataSet((ECHO, SHORT), 3, (5.0, 15.0), 7)
    assert make(scenes, tmp_path / "one") == [0, 1, 2]
    assert sorted(make(scenes, tmp_path / "two", workers=2)) == [0, 1, 2]
    assert content(tmp_path / "one") == content(tmp_path / "two")
    complete(tmp_path / "two", scenes)


def test_a_recording_is_the_scene_that_it_says(tmp_path):
    scenes = DataSet((two_talkers(duration=1.65), SHORT), 2, (-3.0, 7.5))
    make(scenes, tmp_path / "set")
    for index, name, snr, talkers in ((0, "0_-3dB", -3.0, 2), (1, "1_+7.5dB", 7.5, 1)):
        scene = SceneFolder(tmp_path / "set" / name).scene
        assert (scene.snr_db, scene.num_talkers) == (snr, talkers)
        assert scene == dataclasses.replace(scenes.recordings(index)[name], array=scene.array)
        save(tmp_path / name, scene, scene.simulate())
        assert content(tmp_path / name) == content(tmp_path / "set" / name)


def test_the_manifest_says_what_was_made(tmp_path):
    scenes = DataSet((SHORT, two_talkers(duration=1.7)), 3, (5.0, 15.0), 7)
    make(scenes, tmp_path / "set")
    rows = read_manifest(tmp_path / "set")
    assert list(rows[0]) == ["folder", "scene", "template", "seed", "snr_db", "num_talkers", "duration"]
    assert [row["folder"] for row in rows] == [f"{i}_+{snr}dB" for i in range(3) for snr in (5, 15)]
    assert [row["template"] for row in rows] == list("001100")
    assert [row["scene"] for row in rows] == list("001122")
    assert [float(row["snr_db"]) for row in rows] == [5.0, 15.0] * 3
    assert [row["num_talkers"] for row in rows] == list("112211")
    for row in rows:
        assert int(row["seed"]) == SceneFolder(tmp_path / "set" / row["folder"]).scene.seed


def test_names_sort_as_numbers_do():
    scenes = DataSet((SHORT,), 11)
    assert [next(iter(scenes.recordings(i))) for i in (0, 9, 10)] == ["00", "09", "10"]
    assert scenes.recordings(3)["03"].snr_db == SHORT.snr_db


def test_seeds_are_different_within_and_between_data_sets():
    made = [DataSet((SHORT,), 500, seed=seed) for seed in range(3)]
    seeds = [next(iter(one.recordings(i).values())).seed for one in made for i in range(500)]
    assert len(set(seeds)) == 1500
    longer = DataSet((SHORT,), 600, seed=1)
    assert longer.recordings(4)["004"].seed == made[1].recordings(4)["004"].seed
    assert max(seeds) > 2**50


def test_what_is_there_is_left_and_the_rest_made(tmp_path):
    scenes = DataSet((SHORT,), 3, (5.0, 15.0))
    folder = tmp_path / "set"
    steps = make_data_set(scenes, folder, None)
    assert next(steps) == 0
    steps.close()
    assert [row["folder"] for row in read_manifest(folder)] == ["0_+5dB", "0_+15dB"]
    make(scenes, folder)
    whole = content(folder)
    (folder / "1_+15dB").rename(tmp_path / "gone")
    (folder / ".2_+5dB.99.tmp").mkdir()
    before = files(folder)
    assert make(scenes, folder) == [1]
    complete(folder, scenes)
    assert content(folder) == whole
    assert {name: when for name, when in files(folder).items() if name in before} == before
    assert make(scenes, folder) == []


PROGRAM = """
import sys
from probtrack.cli.main import main
if __name__ == "__main__":
    sys.exit(main(["simulate", sys.argv[1], "-o", sys.argv[2], "--cache", sys.argv[3], "--workers", sys.argv[4]]))
"""


def started(tmp_path, config, workers):
    (tmp_path / "program.py").write_text(PROGRAM)
    command = [sys.executable, str(tmp_path / "program.py"), config, str(tmp_path / "set"), str(tmp_path / "cache")]
    return subprocess.Popen(
        [*command, str(workers)],
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # ignored where tests run in the background
        start_new_session=True,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for(folder, count):
    end = time.monotonic() + 60
    while len(list(folder.glob("*/scene.yaml"))) < count:
        assert time.monotonic() < end
        time.sleep(0.02)


def workers_of(process):
    """Return the numbers of the workers that a command has begun."""
    columns = ["ps", "-ww", "-o", "pid=,args=", "--ppid", str(process.pid)]
    children = subprocess.run(columns, capture_output=True, text=True).stdout.splitlines()
    return [int(line.split()[0]) for line in children if "spawn_main" in line]


def wait_until_gone(workers):
    end = time.monotonic() + 10
    while any(map(_alive, workers)):
        assert time.monotonic() < end, "a worker lived on"
        time.sleep(0.1)


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT], ids=["killed", "interrupted"])
def test_a_run_that_was_stopped_is_gone_on_with(tmp_path, how):
    config = write_data_set(tmp_path, "count: 12", "snr_db: [5.0, 15.0]")
    scenes, folder = load_data_set(config), tmp_path / "set"
    process = started(tmp_path, config, 2)
    wait_for(folder, 3)
    if how == signal.SIGKILL:
        workers = workers_of(process)
        process.kill()  # alone: its workers must end by themselves
    else:
        os.killpg(process.pid, how)
    said = process.communicate(timeout=20)[1]
    if how == signal.SIGKILL:
        wait_until_gone(workers)
    assert process.returncode == (-9 if how == signal.SIGKILL else 130)
    assert "Traceback" not in said  # of a killed one Python's own warning of leaked semaphores may be left
    done = files(folder)
    count = sum(name.endswith(".wav") and not name.startswith(".") for name in done)
    assert 3 <= count < 24
    if how == signal.SIGINT:
        assert len(read_manifest(folder)) == count
    assert len(make(scenes, folder)) >= 12 - count
    complete(folder, scenes)
    assert {name: when for name, when in files(folder).items() if name in done} == {
        name: when for name, when in done.items() if not name.startswith(".")
    }


@pytest.mark.slow
def test_a_killed_worker_is_said_in_one_line(tmp_path):
    config = write_data_set(tmp_path, "count: 60")
    process = started(tmp_path, config, 2)
    wait_for(tmp_path / "set", 1)
    os.kill(workers_of(process)[0], signal.SIGKILL)
    said = process.communicate(timeout=60)[1]
    assert process.returncode == 2
    assert len(said.splitlines()) == 1
    assert "a worker was killed" in said
    assert 1 <= len(read_manifest(tmp_path / "set")) < 60


@pytest.mark.parametrize(
    ("changes", "difference"),
    [
        ({"seed": 1}, "seed is 0 there and 1 here"),
        ({"count": 5}, "count is 1 there and 5 here"),
        ({"snr_db": (5.0,)}, "snr_db is None there and .5.0. here"),
        ({"scenes": (dataclasses.replace(SHORT, duration=1.7),)}, r"scenes\[0\].duration is 1.65 there and 1.7 here"),
        ({"scenes": (ECHO,)}, r"scenes\[0\].room.init_args.t60 is 0.0 there and 0.08 here"),
    ],
)
def test_another_data_set_is_not_mixed_in(tmp_path, changes, difference):
    scenes = DataSet((SHORT,), 1)
    make(scenes, tmp_path / "set")
    before = files(tmp_path / "set")
    with pytest.raises(InputError, match=rf"set: holds another data set \({difference}"):
        make(dataclasses.replace(scenes, **changes), tmp_path / "set")
    assert files(tmp_path / "set") == before


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years")
    with pytest.raises(InputError, match="mine: is not empty and holds no data set"):
        make(DataSet((SHORT,), 1), tmp_path / "mine")
    with pytest.raises(InputError, match=r"thesis.txt: cannot write the data set"):
        make(DataSet((SHORT,), 1), tmp_path / "mine" / "thesis.txt")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_a_scene_that_cannot_be_is_named_and_what_was_finished_kept(tmp_path):
    outside = dataclasses.replace(
        SHORT, array="lehmann2007", room=dataclasses.replace(SHORT.room, size=(2.9, 3.1, 2.2))
    )
    with pytest.raises(InputError, match=r"scene 1: lehmann2007: microphone at .* outside the room") as caught:
        make(DataSet((SHORT, outside), 3), tmp_path / "set")
    assert "\n" not in str(caught.value)
    assert [row["folder"] for row in read_manifest(tmp_path / "set")] == ["0"]
    assert {path.name for path in (tmp_path / "set").iterdir()} == {"0", "manifest.csv", "dataset.yaml", "inputs.yaml"}


def test_a_full_disk_is_said_and_can_be_gone_on_from(tmp_path, monkeypatch):
    scenes, write = DataSet((SHORT,), 2), Truth.save

    def second(self, path):
        if "/.1." in str(path):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(self, path)

    monkeypatch.setattr(Truth, "save", second)
    with pytest.raises(InputError, match=r"scene 1: .*1: cannot write the scene: No space left on device"):
        make(scenes, tmp_path / "set")
    assert len(read_manifest(tmp_path / "set")) == 1
    monkeypatch.setattr(Truth, "save", write)
    assert make(scenes, tmp_path / "set") == [1]
    complete(tmp_path / "set", scenes)


def test_a_configuration_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(data_set.Path, "write_text", full)
        with pytest.raises(InputError, match=r"inputs.yaml: cannot write: No space left on device"):
            make(DataSet((SHORT,), 1), tmp_path / "set")
    assert list((tmp_path / "set").iterdir()) == []
    make(DataSet((SHORT,), 1), tmp_path / "set")


def test_arrays_beside_the_file_are_found_from_anywhere(tmp_path, monkeypatch):
    config = write_data_set(tmp_path, "count: 1")
    monkeypatch.chdir(tmp_path.parent)
    make(load_data_set(config), tmp_path / "set")
    assert SceneFolder(tmp_path / "set" / "0").array.name == "pair"
    monkeypatch.chdir(tmp_path)
    assert make(load_data_set("mine.yaml"), tmp_path / "set") == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "cannot read the manifest of a data set: No such file"),
        (b"", "not the manifest of a data set"),
        (b"folder,scene\n0,0\n", "not the manifest of a data set with columns folder, scene, template"),
        (b"folder\xff\n1\n", "the manifest of a data set is not CSV"),
    ],
)
def test_what_is_no_manifest_is_said(tmp_path, text, message):
    if text is not None:
        (tmp_path / "manifest.csv").write_bytes(text)
    with pytest.raises(InputError, match=f"manifest.csv: {message}") as caught:
        read_manifest(tmp_path)
    assert "\n" not in str(caught.value)


def test_rejects_no_workers(tmp_path):
    with pytest.raises(InputError, match="workers must be an integer of at least 1, got 0"):
        make(DataSet((SHORT,), 1), tmp_path / "set", workers=0)
    assert not (tmp_path / "set").exists()


def test_other_inputs_are_refused_when_gone_on_with(tmp_path, monkeypatch):
    config = write_data_set(tmp_path, "count: 1")
    make(load_data_set(config), tmp_path / "set")
    with monkeypatch.context() as patched:
        patched.setattr(data_set, "made_with", lambda: {"torch": "0.1"})
        with pytest.raises(InputError, match=r"inputs.made_with.* is .* there and .* here"):
            make(load_data_set(config), tmp_path / "set")
    array = tmp_path / "pair.yaml"
    array.write_text(array.read_text().replace("0.4", "0.41"))
    with pytest.raises(InputError, match=r"inputs.arrays.* is 0.4 there and 0.41 here"):
        make(load_data_set(config), tmp_path / "set")


def test_a_scene_that_lost_a_file_is_made_again(tmp_path):
    scenes = DataSet((SHORT,), 2)
    make(scenes, tmp_path / "set")
    before = (tmp_path / "set" / "1" / "audio.wav").read_bytes()
    (tmp_path / "set" / "1" / "audio.wav").write_bytes(b"")
    (tmp_path / "set" / "0" / "truth.csv").unlink()
    assert make(scenes, tmp_path / "set") == [0, 1]
    assert (tmp_path / "set" / "1" / "audio.wav").read_bytes() == before
    complete(tmp_path / "set", scenes)


def _alive(process):
    try:
        state = pathlib.Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"


def test_an_estimate_knows_that_displaced_microphones_share_no_responses(tmp_path):
    pytest.importorskip("pyroomacoustics")
    hard = quick(room=HARD)
    exact, moved = (
        estimate(DataSet((dataclasses.replace(hard, faults=Faults(position_std=std)),), 4), tmp_path, cache)
        for std, cache in ((0.0, ResponseCache(tmp_path / "a")), (0.01, ResponseCache(tmp_path / "b")))
    )
    assert moved.responses == 4 * exact.responses > 0
    assert moved.response_bytes == 4 * exact.response_bytes
