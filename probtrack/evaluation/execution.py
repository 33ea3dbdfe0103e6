"""Who works on the cells of a study: this process, several of this machine, or a Dask cluster."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from multiprocessing import get_context
from typing import NamedTuple

import torch

from probtrack.errors import InputError
from probtrack.evaluation.cell import Cell
from probtrack.evaluation.store import CellScores

Claims = Iterator[tuple[int, Cell]]
"""Cells to be done and their numbers: each is this process's own from when it is taken out."""


class Finished(NamedTuple):
    """A cell that was worked on.

    Attributes:
        id: Its number.
        scores: What came of it; None if it failed.
        failure: What went wrong, in one line.
    """

    id: int
    scores: CellScores | None
    failure: str | None = None


def in_this_process(claims: Claims) -> Iterator[Finished]:
    """Yield cells as they are finished, one after the other."""
    for number, cell in claims:
        yield _finished(number, attempt(cell))


def in_processes(claims: Claims, workers: int) -> Iterator[Finished]:
    """Yield cells as `workers` processes finish them, each on one thread.

    Raises:
        InputError: if a worker is killed, perhaps for want of memory.
    """
    begin = (torch.get_default_dtype(),)
    with ProcessPoolExecutor(workers, get_context("spawn"), initializer=_become_worker, initargs=begin) as pool:
        try:
            pending: dict[Future[CellScores | str], int] = {}
            while True:
                for number, cell in islice(claims, workers - len(pending)):
                    pending[pool.submit(attempt, cell)] = number
                if not pending:
                    return
                for future in wait(pending, return_when=FIRST_COMPLETED).done:
                    yield _finished(pending.pop(future), future.result())
        except BrokenProcessPool:
            raise InputError(
                "a worker was killed, perhaps for want of memory: start again, with fewer --workers, to go on"
            ) from None
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def on_cluster(claims: Claims, scheduler: str) -> Iterator[Finished]:
    """Yield cells as the workers of the Dask scheduler at the address `scheduler` finish them.

    Workers need probtrack, and the recordings under the same paths. A cell of a worker that dies goes to another.

    Raises:
        InputError: if nobody answers at the address within some seconds, there is no worker, or the scheduler ends.
    """
    raise NotImplementedError


def attempt(cell: Cell) -> CellScores | str:
    """Return what comes of a cell, or in one line what a user must know of why nothing does."""
    try:
        return cell.scores()
    except (InputError, OSError) as error:
        return " ".join(str(error).split())
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "allocate memory" not in str(error):
            raise  # a defect of ours: its traceback is wanted
        return f"{cell.key}: not enough memory for {len(cell.seeds)} runs at once"


def _finished(number: int, outcome: CellScores | str) -> Finished:
    return Finished(number, None, outcome) if isinstance(outcome, str) else Finished(number, outcome)


def _become_worker(dtype: torch.dtype) -> None:
    torch.set_default_dtype(dtype)  # a fresh process has torch's own
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interruption is the parent's to deal with
    threading.Thread(target=_end_with_parent, args=(os.getppid(),), daemon=True).start()


def _end_with_parent(parent: int) -> None:
    """End this process once its parent was killed: it would work on unseen, beside a run that goes on."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)
