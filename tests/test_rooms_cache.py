"""Responses on disk: found again, never half written, and refused in one clear line."""

import io
import multiprocessing
import os
import resource
import signal
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray
from probtrack.simulation.rooms import SPEECH, ResponseCache, ShoeboxRoom, default_cache

KEY = {"room": [3.5, 3.1, 2.2], "t60": 0.2}
ROOM = ShoeboxRoom((3.5, 3.1, 2.2), 0.1)
NODE = (12, 17, 15)

forks = pytest.mark.filterwarnings(
    "ignore:.*fork:DeprecationWarning"
)  # of one thread, ours: nothing to wait for for ever


def keep_writing(folder, value):
    store = ResponseCache(folder).store(KEY)
    while True:
        for k in range(4):
            store.put((k, 0, 0), torch.full((5, 4, 8000), value))


def write_half(folder):
    """Write one place, and half of another before the process is killed."""

    def half(file, packed):
        file.write(packed.tobytes()[:1000])
        file.flush()
        os.kill(os.getpid(), signal.SIGKILL)

    store = ResponseCache(folder).store(KEY)
    store.put((0, 0, 0), torch.ones(5, 4, 2000))
    np.save = half
    store.put((1, 0, 0), torch.full((5, 4, 2000), 2.0))


def array():
    return MicrophoneArray([[1.35, 0.29, 1.51], [2.15, 0.31, 1.42]])


def start(work, *arguments):
    process = multiprocessing.get_context("fork").Process(target=work, args=arguments, daemon=True)
    process.start()
    return process


def folders(path):
    return {entry.name for entry in path.iterdir() if entry.is_dir()}


def unfinished(path):
    return list(path.rglob(".*.tmp"))


def test_what_was_put_is_got_in_the_precision_of_the_file(tmp_path):
    responses = torch.randn(5, 3, 50) * 10 ** (-torch.arange(50) / 10)
    store = ResponseCache(tmp_path).store(KEY)
    kept = store.put(NODE, responses)
    again = ResponseCache(tmp_path).store(KEY).get(NODE)
    assert torch.equal(kept, again)
    assert again.dtype == torch.float32
    torch.testing.assert_close(again.double(), responses, rtol=2**-11, atol=2**-25 / 256)  # half precision
    assert store.get((17, 12, 15)) is None


def test_one_key_is_one_folder_in_any_order(tmp_path):
    cache = ResponseCache(tmp_path)
    assert cache.store(KEY).folder == cache.store(dict(reversed(KEY.items()))).folder
    assert cache.store(KEY).folder != cache.store({**KEY, "t60": 0.3}).folder


def test_a_folder_says_what_it_holds(tmp_path):
    text = (ResponseCache(tmp_path).store(KEY).folder / "key.yaml").read_text()
    assert "t60: 0.2" in text


def test_everything_that_changes_responses_changes_the_folder(tmp_path, monkeypatch):
    cache, here = ResponseCache(tmp_path), array()
    moved = MicrophoneArray(here.positions + torch.tensor([0.0, 0.0, 1e-4]))
    swapped = here.select([1, 0])
    ROOM.responses(here, 16000, SPEECH, cache)
    others = [
        (replace(ROOM, size=(3.5, 3.1, 2.3)), here, 16000, SPEECH),
        (replace(ROOM, t60=0.11), here, 16000, SPEECH),
        (replace(ROOM, spacing=0.2), here, 16000, SPEECH),
        (replace(ROOM, speed_of_sound=340.0), here, 16000, SPEECH),
        (ROOM, moved, 16000, SPEECH),
        (ROOM, swapped, 16000, SPEECH),
        (ROOM, here, 8000, SPEECH),
        (ROOM, here, 16000, None),
        (ROOM, here, 16000, replace(SPEECH, bands=(*SPEECH.bands[:-1], 8100.0))),
        (ROOM, here, 16000, replace(SPEECH, depth_db=(*SPEECH.depth_db[:-1], 24.5))),
        (ROOM, here, 16000, replace(SPEECH, exponent=(*SPEECH.exponent[:-1], 1.41))),
    ]
    for count, (room, microphones, fs, directivity) in enumerate(others, 2):
        room.responses(microphones, fs, directivity, cache)
        assert len(folders(tmp_path)) == count
    for name, value in (("METHOD", -1), ("COMPLETE", 41.0), ("_version", lambda: "0")):
        with monkeypatch.context() as patch:
            patch.setattr(f"probtrack.simulation.rooms.shoebox.{name}", value)
            ROOM.responses(here, 16000, SPEECH, cache)
        count += 1
        assert len(folders(tmp_path)) == count
    ROOM.responses(MicrophoneArray(here.positions.float(), "other name"), 16000, SPEECH, cache)  # the same in all
    assert len(folders(tmp_path)) == count


def read_all(store):
    """Return the values of the files there are, each of which must hold one throughout."""
    there = [responses for k in range(4) if (responses := store.get((k, 0, 0))) is not None]
    assert all(responses.shape == (5, 4, 8000) and responses.min() == responses.max() for responses in there)
    return {float(responses.max()) for responses in there}


@forks
def test_processes_may_write_and_read_at_once_and_be_killed(tmp_path):
    store, seen, late = ResponseCache(tmp_path).store(KEY), set(), time.monotonic() + 60
    writers = [start(keep_writing, tmp_path, value) for value in (1.0, 2.0)]
    try:
        while seen != {1.0, 2.0}:
            seen |= read_all(store)
            assert time.monotonic() < late
        for _ in range(40):
            assert read_all(store) <= {1.0, 2.0}
        writers[0].kill()
        for _ in range(40):
            assert len(read_all(store)) > 0
    finally:
        for writer in writers:
            writer.kill()
            writer.join()
    assert [(store.get((k, 0, 0)) is None) for k in range(4)] == [False] * 4


def test_threads_may_write_one_place_at_once(tmp_path):
    store, failed = ResponseCache(tmp_path).store(KEY), []

    def write(value):
        for _ in range(30):
            try:
                store.put(NODE, torch.full((2, 2, 5000), value))
            except InputError as error:
                failed.append(error)

    threads = [threading.Thread(target=write, args=(float(value),)) for value in range(1, 5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    low, high = store.get(NODE).aminmax()
    assert not failed
    assert low == high
    assert not unfinished(tmp_path)


@forks
def test_a_writer_killed_half_way_leaves_a_store_that_works(tmp_path):
    writer = start(write_half, tmp_path)
    writer.join(60)
    assert writer.exitcode == -signal.SIGKILL
    (left,) = unfinished(tmp_path)
    store = ResponseCache(tmp_path).store(KEY)
    assert store.get((1, 0, 0)) is None
    assert float(store.get((0, 0, 0)).mean()) == 1.0
    store.put((1, 0, 0), torch.full((5, 4, 2000), 3.0))
    assert float(store.get((1, 0, 0)).mean()) == 3.0
    assert left.exists()  # it may be another process's, at work
    os.utime(left, (time.time() - 7200,) * 2)
    ResponseCache(tmp_path).store(KEY)
    assert not left.exists()


def test_the_mark_of_a_killed_writer_is_swept_too(tmp_path):
    left = tmp_path / ".FORMAT.1.tmp"
    left.touch()
    os.utime(left, (time.time() - 7200,) * 2)
    ResponseCache(tmp_path)
    assert not left.exists()


def saved(values):
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


@pytest.mark.parametrize(
    "damage", ["empty", "header", "data", "text", "zip", "flipped", "float64", "flat", "nan", "folder"]
)
def test_what_cannot_be_read_is_computed_anew(tmp_path, damage):
    pytest.importorskip("pyroomacoustics")
    cache = ResponseCache(tmp_path)
    first = ROOM.responses(array(), 16000, SPEECH, cache)(NODE)
    (path,) = tmp_path.rglob("12_17_15.npy")
    whole = path.read_bytes()
    path.unlink()
    if damage == "folder":
        path.mkdir()
    else:
        path.write_bytes(
            {
                "empty": b"",
                "header": whole[:40],
                "data": whole[:-1],
                "text": b"hello",
                "zip": b"PK\3\4" + whole[4:],
                "flipped": whole[:20] + b"(" + whole[21:],
                "float64": saved(np.ones((5, 2, 9))),
                "flat": saved(np.ones(9, np.float16)),
                "nan": saved(np.full((5, 2, 9), np.nan, np.float16)),
            }[damage]
        )
    assert cache.store(KEY).get(NODE) is None
    responses = ROOM.responses(array(), 16000, SPEECH, cache)
    if damage == "folder":
        with pytest.raises(InputError, match="cannot write the cache of responses: Is a directory"):
            responses(NODE)
        return
    assert torch.equal(responses(NODE), first)
    assert path.read_bytes() == whole


def test_another_format_is_one_clear_line(tmp_path):
    (tmp_path / "FORMAT").write_text("7\nand more")
    with pytest.raises(InputError, match=r"has format '7.*, this version of probtrack reads 1: delete the folder") as e:
        ResponseCache(tmp_path)
    assert "\n" not in str(e.value)


def test_a_folder_that_cannot_be_made_is_one_clear_line(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="file: cannot use the cache of responses: File exists"):
        ResponseCache(tmp_path / "file")
    with pytest.raises(InputError, match="inside: cannot use the cache of responses: Not a directory"):
        ResponseCache(tmp_path / "file" / "inside")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_leave_to_write_is_one_clear_line(tmp_path):
    cache = ResponseCache(tmp_path)
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="cannot write the cache of responses: Permission denied"):
        cache.store(KEY)


def test_a_cache_that_cannot_be_written_can_be_read(tmp_path, monkeypatch):
    ResponseCache(tmp_path).store(KEY).put(NODE, torch.ones(1, 2, 3))

    def refused(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("probtrack.simulation.rooms.cache._write", refused)
    store = ResponseCache(tmp_path).store(KEY)
    assert torch.equal(store.get(NODE), torch.ones(1, 2, 3).float())
    with pytest.raises(InputError, match="cannot write the cache of responses: Permission denied"):
        ResponseCache(tmp_path).store({"t60": 1})


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(28, "No space left on device"), "No space left on device"),
        (OSError("9 requested and 5 written"), "9 req"),
    ],
)
def test_a_full_disk_is_one_clear_line(tmp_path, monkeypatch, error, said):
    def full(file, _):
        file.write(b"12345")
        raise error

    store = ResponseCache(tmp_path).store(KEY)
    monkeypatch.setattr(np, "save", full)
    with pytest.raises(InputError, match=rf"12_17_15.npy: cannot write the cache of responses: {said}"):
        store.put(NODE, torch.ones(1, 2, 3))
    assert not unfinished(tmp_path)
    assert store.get(NODE) is None


def test_a_disk_that_takes_no_more_is_one_clear_line(tmp_path):
    """The system itself refuses: files may not grow beyond 4096 bytes."""
    store, (soft, hard) = ResponseCache(tmp_path).store(KEY), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(InputError, match=r"cannot write the cache of responses: \w+") as error:
            store.put(NODE, torch.ones(5, 4, 20000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "None" not in str(error.value)
    assert not unfinished(tmp_path)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 300.0])
def test_what_the_file_cannot_hold_is_never_kept(tmp_path, value):
    store = ResponseCache(tmp_path).store(KEY)
    with pytest.raises(AssertionError, match="not finite, or too loud"):
        store.put(NODE, torch.full((1, 2, 3), value))
    assert store.get(NODE) is None


def test_default_place_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("PROBTRACK_CACHE", str(tmp_path / "named"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert default_cache() == tmp_path / "named"
    monkeypatch.delenv("PROBTRACK_CACHE")
    assert default_cache() == tmp_path / "xdg" / "probtrack" / "responses"
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    assert default_cache() == tmp_path / ".cache" / "probtrack" / "responses"
    monkeypatch.setenv("PROBTRACK_CACHE", "~/mine")
    assert default_cache() == tmp_path / "mine"
