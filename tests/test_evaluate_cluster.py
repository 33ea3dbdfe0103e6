"""A study on a Dask cluster: the same numbers, whoever of its workers lives, and one line when there is no cluster."""

import contextlib
import os
import socket
import subprocess
import sys
import time

import pytest
import torch
from study_scenes import CELLS, claimed, failures, numbers, same, write_recordings, write_study

from probtrack.cli.main import main
from probtrack.errors import InputError
from probtrack.evaluation import Store, cluster, evaluate, load_study
from probtrack.evaluation.cell import versions

pytest.importorskip("distributed")


@pytest.fixture(autouse=True)
def float32(float64_and_seed):  # noqa: ARG001
    """As commands have it."""
    torch.set_default_dtype(torch.float32)


@pytest.fixture
def study(tmp_path):
    write_recordings(tmp_path)
    return load_study(write_study(tmp_path))


@contextlib.contextmanager
def dask(*arguments):
    """Run a process of Dask."""
    here = os.path.dirname(__file__)
    process = subprocess.Popen(
        [sys.executable, "-m", "dask", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": here},
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


@contextlib.contextmanager
def scheduler():
    address = f"tcp://127.0.0.1:{free_port()}"
    _, _, port = address.rpartition(":")
    with dask("scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard") as process:
        end = time.monotonic() + 60
        while True:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", int(port)), 1):
                break
            assert time.monotonic() < end
            time.sleep(0.05)
        yield address, process


def worker(address):
    return dask("worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1")


def wait_for_workers(address, count):
    from distributed import Client

    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(count, 60)


def test_a_killed_worker_and_then_the_end_of_the_scheduler_lose_nothing(study, tmp_path):
    here, there = tmp_path / "here.sqlite", tmp_path / "there.sqlite"
    evaluate(study, here)
    seen = []
    with scheduler() as (address, process):
        with pytest.raises(InputError, match=f"{address}: the scheduler has no workers: start some with dask worker"):
            evaluate(study, there, scheduler=address)
        assert not there.exists()
        with worker(address) as first, worker(address):
            wait_for_workers(address, 2)

            def kill(progress):
                seen.append(progress.done)
                if progress.done == 2:
                    first.kill()
                elif progress.done == 6:
                    process.kill()

            with pytest.raises(InputError, match=f"{address}: the scheduler has ended: start again to go on"):
                evaluate(study, there, scheduler=address, on_progress=kill)
    assert claimed(there) == []
    assert failures(there) == {}
    assert seen[-1] >= 6  # four and more of them with one worker alone
    with Store(there) as store:
        assert store.progress == (seen[-1], 0)
    evaluate(study, there)
    assert same(numbers(there), numbers(here))
    assert len(numbers(here)) == CELLS * 6


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("tcp://127.0.0.1:{closed}", "no Dask scheduler answers within 2 s"),
        ("tcp://127.0.0.1:{silent}", "no Dask scheduler answers within 2 s"),
        ("127.0.0.1", "missing port number"),
        ("foo://127.0.0.1:1", "unknown address scheme 'foo'"),
    ],
)
def test_an_address_without_a_scheduler_is_said_within_seconds(study, tmp_path, capsys, monkeypatch, address, words):
    assert study
    monkeypatch.setattr(cluster, "_ANSWER", 2.0)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = address.format(closed=free_port(), silent=silent.getsockname()[1])
        begin = time.monotonic()
        code = main(
            ["evaluate", str(tmp_path / "study.yaml"), "-o", str(tmp_path / "s.sqlite"), "--scheduler", address]
        )
        assert time.monotonic() - begin < 15
    said = capsys.readouterr().err.splitlines()
    assert code == 2
    assert len(said) == 1
    assert said[0].startswith(f"probtrack evaluate: error: --scheduler {address}: ")
    assert words in said[0]
    assert not (tmp_path / "s.sqlite").exists()


class Failed:
    """A future of a cell that came to nothing."""

    def __init__(self, error):
        self.error = error

    def result(self):
        raise self.error


def test_a_cell_that_kills_workers_or_that_they_cannot_do_fails_alone(study):
    from distributed import KilledWorker

    killed = cluster._outcome(Failed(KilledWorker("task", None, 3)), study.cells[1])
    assert killed == "A(num_particles=65) on near: 4 workers died of it, perhaps for want of memory"
    unknown = cluster._outcome(Failed(ModuleNotFoundError("No module\nnamed 'mine'")), study.cells[0])
    assert unknown.endswith(" on near: a worker cannot do it: ModuleNotFoundError: No module named 'mine'")


def test_workers_of_other_versions_are_refused(study):
    outcome = cluster._attempt(study.cells[0], torch.float32, {**versions(), "torch": "1.0"})
    assert "a worker has other versions: torch is '1.0' there and " in outcome


def test_without_distributed_the_install_line_is_said(study, tmp_path, monkeypatch, capsys):
    assert study
    monkeypatch.setitem(sys.modules, "distributed", None)
    arguments = [str(tmp_path / "study.yaml"), "-o", str(tmp_path / "s.sqlite"), "--scheduler", "tcp://127.0.0.1:1"]
    assert main(["evaluate", *arguments]) == 2
    assert "pip install 'probtrack[distributed]'" in capsys.readouterr().err
    assert not (tmp_path / "s.sqlite").exists()


class Cluster:
    """A client of a cluster whose worker comes and goes."""

    def __init__(self, threads):
        self.threads = iter(threads)

    def nthreads(self):
        return {"worker": next(self.threads)}


def test_a_cluster_without_workers_for_a_moment_is_waited_for_and_given_up_after_a_minute(monkeypatch):
    monkeypatch.setattr(cluster, "LOOK", 0.001)
    client = Cluster([0, 0, 1])
    work = cluster._worked_on(lambda: None, client, "tcp://there")
    assert [next(work) for _ in range(3)] == [None] * 3
    monkeypatch.setattr(cluster, "_PATIENCE", -1.0)
    with pytest.raises(InputError, match="tcp://there: all workers are gone"):
        next(cluster._worked_on(lambda: None, Cluster([0]), "tcp://there"))
