"""Who works on the cells of a study: this process, or several of this machine."""

import os
import pickle
import signal
import threading
import time
import traceback
from collections.abc import Callable, Generator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import torch

from probtrack.errors import InputError
from probtrack.evaluation.cell import Cell
from probtrack.evaluation.store import CellScores

Claim = Callable[[], tuple[int, Cell] | None]
"""Takes a cell to be done, from then on this process's own, and its number; None if there is none now.

There may be one later, of another process that has ended. Those who work on cells therefore never end: they yield
None when for a while no cell was finished, and the caller, who knows whether all are, closes them.
"""

LOOK = 1.0  # s between two looks whether there is a cell to be done


class Finished(NamedTuple):
    """A cell that was worked on.

    Attributes:
        id: Its number.
        outcome: What came of it; or what went wrong, in one line.
    """

    id: int
    outcome: CellScores | str


def in_this_process(claim: Claim) -> Generator[Finished | None]:
    """Yield cells as they are finished, one after the other."""
    while True:
        claimed = claim()
        if claimed is None:
            time.sleep(LOOK)
            yield None
        else:
            number, cell = claimed
            yield Finished(number, attempt(cell))


def in_processes(claim: Claim, workers: int) -> Generator[Finished | None]:
    """Yield cells as `workers` processes finish them, each on one thread.

    Raises:
        InputError: if a worker is killed, perhaps for want of memory.
    """
    context = get_context("spawn")
    end, lifeline = context.Pipe(duplex=False)  # workers end with it: when it is closed here, and when we are killed
    pool = ProcessPoolExecutor(workers, context, _become_worker, (torch.get_default_dtype(), end))
    try:
        pending: dict[Future[CellScores | str], int] = {}
        while True:
            for number, cell in islice(iter(claim, None), workers - len(pending)):
                # as bytes: torch would send the tensors of metrics as open files, which end with us
                pending[pool.submit(_attempt_pickled, pickle.dumps(cell))] = number
            if not pending:
                time.sleep(LOOK)
            done = wait(pending, LOOK, FIRST_COMPLETED).done
            if not done:
                yield None
            for future in sorted(done, key=lambda one: one.exception() is not None):  # finished cells are kept first
                yield Finished(pending.pop(future), future.result())
    except BrokenProcessPool:
        raise InputError(
            "a worker was killed, perhaps for want of memory: start again, with fewer --workers, to go on"
        ) from None
    finally:
        lifeline.close()
        pool.shutdown(cancel_futures=True)
        end.close()


def attempt(cell: Cell) -> CellScores | str:
    """Return what comes of a cell, or in one line why nothing does: the other cells go on."""
    try:
        return cell.scores()
    except (InputError, OSError) as error:
        what = str(error)
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "allocate memory" not in str(error):
            what = _defect(error)
        else:
            what = f"not enough memory for {len(cell.seeds)} runs"
    except Exception as error:
        what = _defect(error)
    return " ".join(f"{cell.key}: {what}".split())


def _attempt_pickled(cell: bytes) -> CellScores | str:
    return attempt(pickle.loads(cell))


def _defect(error: Exception) -> str:
    """Say what no user's mistake explains, such as a slip in a tracker of one's own, and where it is."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({Path(last.filename).name}, line {last.lineno})"


def _become_worker(dtype: torch.dtype, lifeline: Connection) -> None:
    torch.set_default_dtype(dtype)  # a fresh process has torch's own
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interruption is the parent's to deal with
    threading.Thread(target=_end_with, args=(lifeline,), daemon=True).start()


def _end_with(lifeline: Connection) -> None:
    """End this process at once when `lifeline` does: what it works on is nobody's any more."""
    lifeline.poll(None)
    os._exit(1)
