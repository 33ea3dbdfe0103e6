"""Commands as processes of their own, to be killed."""

import multiprocessing
import os
import resource
import signal
import time

import pytest

from probtrack.cli.main import main
from probtrack.errors import InputError
from probtrack.evaluation import Store


@pytest.fixture
def start():
    """Start commands as processes that are forked from one which has all imports done, and nothing else of this one."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["probtrack.evaluation.run", "probtrack.cli.evaluate"])
    begun = []

    def started(*arguments, largest_file=None, said=None):
        begun.append(context.Process(target=command, args=(arguments, largest_file, said)))
        begun[-1].start()
        return begun[-1]

    yield started
    for process in begun:
        process.kill()
        process.join()


def command(arguments, largest_file, said):
    """Run a command, perhaps with a limit to the size of files, and what it says in a file."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where tests run in the background
    if largest_file is not None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # writing more fails then, as on a full disk
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, resource.RLIM_INFINITY))
    if said is not None:
        os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT), 2)
    raise SystemExit(main(arguments))


def wait_until(true, seconds=120.0):
    """Wait for something to become true."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it took too long"
        time.sleep(0.02)


def finished(path):
    """Return how many cells of a store are finished, 0 of none."""
    try:
        with Store(path) as store:
            return store.progress[0]
    except InputError:
        return 0


def running(pid):
    """Whether there is such a process."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def parent(pid):
    """Return the number of the process that began `pid`; None if there is no such process."""
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8") as file:
            return int(file.read().rpartition(")")[2].split()[1])
    except OSError:
        return None


def descendants(pid):
    """Return the numbers of the processes that `pid` began, and that those began."""
    begun = {int(name) for name in os.listdir("/proc") if name.isdigit() and parent(name) == pid}
    return begun.union(*map(descendants, begun))
