"""The cells of a study on a Dask cluster: workers compute, and this process alone writes what comes of it."""

import asyncio
import itertools
import logging
import time
from collections.abc import Generator, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import torch

from probtrack._files import difference
from probtrack.errors import InputError
from probtrack.evaluation.cell import Cell, versions
from probtrack.evaluation.execution import LOOK, Claim, Finished, attempt
from probtrack.evaluation.store import CellScores

_ANSWER = 5.0  # s within which a scheduler must answer
_PATIENCE = 60.0  # s without any worker before it is given up: a cluster may be replacing those it lost
_AHEAD = 2  # cells given out for each thread of a worker, so that none waits for us


def check_scheduler(scheduler: str) -> None:
    """Ask whether there is a Dask scheduler at an address, with workers.

    Raises:
        InputError: if none answers within some seconds, or it has no workers.
        ImportError: without the extra `distributed`.
    """
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise ImportError("--scheduler needs distributed: pip install 'probtrack[distributed]'") from None
    with _quiet():
        if not _workers(scheduler):
            raise InputError(f"{scheduler}: the scheduler has no workers: start some with dask worker {scheduler}")


def on_cluster(claim: Claim, scheduler: str) -> Generator[Finished | None]:
    """Yield cells as the workers of the Dask scheduler at the address `scheduler` finish them.

    Workers need probtrack, the trackers and metrics that the study names, and the recordings under the same paths. A
    cell of a worker that dies goes to another.

    Raises:
        InputError: if the scheduler ends, or has no workers for a minute.
    """
    import distributed

    with _quiet(), distributed.Client(scheduler, timeout=_ANSWER, set_as_default=False) as client:
        try:
            yield from _worked_on(claim, client, scheduler)
        except (CancelledError, OSError, distributed.client.ClosedClientError):
            raise InputError(f"{scheduler}: the scheduler has ended: start again to go on") from None


def _worked_on(claim: Claim, client: Any, scheduler: str) -> Generator[Finished | None]:
    from distributed import wait

    pending: dict[Any, tuple[int, Cell]] = {}
    seen = time.monotonic()
    while True:
        threads = sum(client.nthreads().values())
        seen = time.monotonic() if threads else seen
        if time.monotonic() - seen > _PATIENCE:
            raise InputError(f"{scheduler}: all workers are gone: start again when there are some")
        for number, cell in itertools.islice(iter(claim, None), max(0, _AHEAD * threads - len(pending))):
            future = client.submit(_attempt, cell, torch.get_default_dtype(), versions(), pure=False)
            pending[future] = number, cell
        if not pending:
            time.sleep(LOOK)
            yield None
            continue
        try:
            with client.as_current():
                done = wait(list(pending), timeout=LOOK, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            yield None
            continue
        for future in done:
            number, cell = pending.pop(future)
            yield Finished(number, _outcome(future, cell))


def _attempt(cell: Cell, dtype: torch.dtype, ours: dict[str, str]) -> CellScores | str:
    """Do as `attempt` on a worker, which must give the numbers that the process that asks would."""
    found = difference(ours, versions())
    if found:
        return f"{cell.key}: a worker has other versions: {found}"
    torch.set_default_dtype(dtype)
    return attempt(cell)


def _outcome(future: Any, cell: Cell) -> CellScores | str:
    from distributed import KilledWorker

    try:
        outcome: CellScores | str = future.result()
    except CancelledError:
        raise
    except KilledWorker as error:
        return f"{cell.key}: {error.allowed_failures + 1} workers died of it, perhaps for want of memory"
    except Exception as error:  # such as a tracker that workers cannot import
        return " ".join(f"{cell.key}: a worker cannot do it: {type(error).__name__}: {error}".split())
    return outcome


def _workers(scheduler: str) -> int:
    """Return how many workers a scheduler has, or raise `InputError` if none answers."""
    try:
        with ThreadPoolExecutor(1) as beside:  # notebooks have a loop of their own in this thread
            return beside.submit(asyncio.run, _asked(scheduler)).result()
    except Exception as error:  # whatever a stranger at that address may answer
        what = str(error) if isinstance(error, ValueError) else f"no Dask scheduler answers within {_ANSWER:g} s"
        raise InputError(f"--scheduler {scheduler}: {what}") from None


async def _asked(scheduler: str) -> int:
    """Ask by a bare connection: a client that cannot connect takes another ten seconds to end."""
    from distributed import Security, rpc

    arguments = Security().get_connection_args("client")
    async with rpc(scheduler, timeout=_ANSWER, connection_args=arguments) as remote:
        found = await asyncio.wait_for(remote.identity(n_workers=-1), _ANSWER)
    if found.get("type") != "Scheduler":
        raise ValueError(f"a {found.get('type')} answers, and no scheduler")
    return len(found["workers"])


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the log of Dask to itself: what matters of it is raised."""
    log = logging.getLogger("distributed")
    before = log.level
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        log.setLevel(before)
