"""A study done, or gone on with: cells are claimed, worked on and kept one by one."""

import json
import time
from collections.abc import Callable, Generator
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from probtrack._checks import check_int
from probtrack._files import difference
from probtrack.errors import InputError
from probtrack.evaluation.cell import Cell
from probtrack.evaluation.cluster import check_scheduler, on_cluster
from probtrack.evaluation.execution import Claim, Finished, in_processes, in_this_process
from probtrack.evaluation.store import Store, StoredCell
from probtrack.evaluation.study import Study


@dataclass(frozen=True)
class Progress:
    """How far a study is.

    Attributes:
        cells: All cells.
        done: How many are finished, by whatever process.
        failed: How many could not be done.
        before: How many were finished when this call began.
        seconds: How long it has worked [s].
        metric: Name of the first metric.
        unit: Its unit.
        numerator: Sum of its numerators over the runs that were finished before or by this call.
        denominator: Sum of its denominators.
        failure: What went wrong first in this call, if anything did.
    """

    cells: int
    done: int
    failed: int
    before: int
    seconds: float
    metric: str
    unit: str
    numerator: float
    denominator: float
    failure: str | None = None

    @property
    def left(self) -> float | None:
        """How long the rest will take at the pace so far of all who work on it [s]; None before there is one."""
        here = self.done - self.before
        return self.seconds / here * (self.cells - self.done - self.failed) if here else None

    @property
    def ended(self) -> bool:
        """Whether nothing is left to be done."""
        return self.done + self.failed >= self.cells


def evaluate(
    study: Study,
    path: str | Path,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> Progress:
    """Do what is not yet done of a study in the store at `path`, and return how far it is then.

    A store that is there is gone on with; cells that failed are tried again. Those that another process works on are
    waited for, and taken over if it ends. The numbers do not depend on who does the work, or on how often it was
    stopped.

    Args:
        study: What is to be done.
        path: The store, made if it is not there.
        workers: Processes of this machine, each on one thread.
        scheduler: Address of a Dask scheduler whose workers do the work instead.
        on_progress: Called at the beginning, after each cell, and about each second while none is finished.

    Raises:
        InputError: if the store holds another study or the recordings have changed; if no scheduler answers, in which
            case no store is made; if workers die or the disk is full. What was finished is kept.
    """
    check_int(workers, "workers", low=1)
    if scheduler is not None:
        check_scheduler(scheduler)
    with open_store(study, path) as store:
        store.retry()
        cells = _numbered(study, store)
        progress = _begin(study, store)
        on_progress(progress)

        def claim() -> tuple[int, Cell] | None:
            number = store.claim()
            return None if number is None else (number, cells[number])

        begin = time.monotonic()
        try:
            with closing(_worked_on(claim, workers, scheduler)) as work:
                while not progress.ended:
                    progress = _kept(store, next(work), progress)
                    done, failed = store.progress  # by other processes too
                    progress = replace(progress, done=done, failed=failed, seconds=time.monotonic() - begin)
                    on_progress(progress)
        finally:
            with suppress(InputError):  # what is wrong with the disk has been said
                store.release()
        if progress.failed and progress.failure is None:  # they failed elsewhere
            progress = replace(progress, failure=next((one.failure for one in store.cells if one.failure), None))
        return progress


def open_store(study: Study, path: str | Path) -> Store:
    """Return the store of a study, made if it is not there.

    Raises:
        InputError: if there is one of another study, with the first difference.
    """
    if not Path(path).exists():
        units = [(metric.name, metric.unit) for metric in study.metrics]
        Store.create(path, study.config, study.scenes, units, study.planned).close()
    store = Store(path, write=True)
    try:
        found = _difference(study, store)
    except BaseException:
        store.close()
        raise
    if found:
        store.close()
        raise InputError(f"{path}: holds another study: {found}; another name, or --new, begins anew")
    return store


def _difference(study: Study, store: Store) -> str:
    """Return the first difference between a study and what a store holds, in words; empty if there is none."""
    cells = store.cells
    there = {
        "config": store.config,
        "recordings": {cell.scene: cell.conditions for cell in cells},
        "metrics": store.metrics,
        "runs": {_identity(cell): cell.runs for cell in cells},
    }
    here = {
        "config": study.config,
        "recordings": {scene.name: scene.conditions for scene in study.scenes},
        "metrics": {metric.name: metric.unit for metric in study.metrics},
        "runs": {_identity(cell): len(cell.seeds) for cell in study.cells},
    }
    found = difference(there, here)
    fingerprints = store.fingerprints
    changed = next((one.name for one in study.scenes if one.fingerprint != fingerprints.get(one.name)), None)
    return found or (f"the files of recording {changed} are others now" if changed is not None else "")


def _numbered(study: Study, store: Store) -> dict[int, Cell]:
    """Return a study's cells by their numbers in a store, which may have been planned in another order."""
    cells = {_identity(cell): cell for cell in study.cells}
    return {stored.id: cells[_identity(stored)] for stored in store.cells}


def _identity(cell: Cell | StoredCell) -> str:
    """Return what tells a cell from others, in whatever order a study file names what varies."""
    return f"{json.dumps(cell.settings, sort_keys=True)} on {cell.scene}"


def _worked_on(claim: Claim, workers: int, scheduler: str | None) -> Generator[Finished | None]:
    if scheduler is not None:
        return on_cluster(claim, scheduler)
    return in_this_process(claim) if workers == 1 else in_processes(claim, workers)


def _begin(study: Study, store: Store) -> Progress:
    first = study.metrics[0]
    scores = store.scores(first.name)
    done, failed = store.progress
    sums = float(scores.numerator.sum()), float(scores.denominator.sum())
    return Progress(len(study.cells), done, failed, done, 0.0, first.name, first.unit, *sums)


def _kept(store: Store, one: Finished | None, progress: Progress) -> Progress:
    """Keep a cell, if there is one, and return the progress with its figures."""
    if one is None:
        return progress
    if isinstance(one.outcome, str):
        store.give_up(one.id, one.outcome)
        return replace(progress, failure=progress.failure or one.outcome)
    store.save(one.id, one.outcome)
    return replace(
        progress,
        numerator=progress.numerator + float(one.outcome.numerator[0].sum()),
        denominator=progress.denominator + float(one.outcome.denominator[0].sum()),
    )
