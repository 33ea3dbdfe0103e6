"""A study done, or gone on with: cells are claimed, worked on and kept one by one."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from probtrack._checks import check_int
from probtrack._files import difference
from probtrack.errors import InputError
from probtrack.evaluation.execution import Claims, Finished, in_processes, in_this_process, on_cluster
from probtrack.evaluation.store import Store
from probtrack.evaluation.study import Study


@dataclass(frozen=True)
class Progress:
    """How far a study is.

    Attributes:
        cells: All cells.
        done: How many are finished.
        failed: How many could not be done.
        here: How many of the finished ones this call did.
        seconds: How long it has worked [s].
        metric: Name of the first metric.
        unit: Its unit.
        numerator: Sum of its numerators over all finished runs.
        denominator: Sum of its denominators.
        failure: What went wrong first, if anything did.
    """

    cells: int
    done: int
    failed: int
    here: int
    seconds: float
    metric: str
    unit: str
    numerator: float
    denominator: float
    failure: str | None = None

    @property
    def left(self) -> float | None:
        """How long the rest will take at the pace so far [s]; None before there is one."""
        return self.seconds / self.here * (self.cells - self.done - self.failed) if self.here else None


def evaluate(
    study: Study,
    path: str | Path,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> Progress:
    """Do what is not yet done of a study in the store at `path`, and return how far it is then.

    A store that is there is gone on with. The numbers do not depend on who does the work, or on how often it was
    stopped.

    Args:
        study: What is to be done.
        path: The store, made if it is not there.
        workers: Processes of this machine, each on one thread.
        scheduler: Address of a Dask scheduler whose workers do the work instead.
        on_progress: Called at the beginning and after each cell.

    Raises:
        InputError: if the store holds another study or the recordings have changed; if workers die or the disk is
            full. What was finished is kept.
    """
    check_int(workers, "workers", low=1)
    with open_store(study, path) as store:
        store.retry()
        cells = {stored.id: cell for stored, cell in zip(store.cells, study.cells, strict=True)}

        def claims() -> Claims:
            while (number := store.claim()) is not None:
                yield number, cells[number]

        progress = _begin(study, store)
        on_progress(progress)
        begin = time.monotonic()
        for one in _worked_on(claims(), workers, scheduler):
            progress = replace(_kept(store, one, progress), seconds=time.monotonic() - begin)
            on_progress(progress)
        done = sum(cell.finished is not None for cell in store.cells)  # by other processes too
        return replace(progress, done=done)


def open_store(study: Study, path: str | Path) -> Store:
    """Return the store of a study, made if it is not there.

    Raises:
        InputError: if there is one of another study, with the first difference.
    """
    if not Path(path).exists():
        units = [(metric.name, metric.unit) for metric in study.metrics]
        Store.create(path, study.config, study.scenes, units, study.planned).close()
    store = Store(path, write=True)
    there = {"": store.config, "scenes": store.fingerprints}
    here = {"": study.config, "scenes": {scene.name: scene.fingerprint for scene in study.scenes}}
    found = difference(there, here)
    if found:
        store.close()
        raise InputError(f"{path}: holds another study: {found}; another name, or --new, begins anew")
    return store


def _worked_on(claims: Claims, workers: int, scheduler: str | None) -> Iterator[Finished]:
    if scheduler is not None:
        return on_cluster(claims, scheduler)
    return in_this_process(claims) if workers == 1 else in_processes(claims, workers)


def _begin(study: Study, store: Store) -> Progress:
    first = study.metrics[0]
    scores = store.scores(first.name)
    done = sum(cell.finished is not None for cell in store.cells)
    sums = float(scores.numerator.sum()), float(scores.denominator.sum())
    return Progress(len(study.cells), done, 0, 0, 0.0, first.name, first.unit, *sums)


def _kept(store: Store, one: Finished, progress: Progress) -> Progress:
    """Keep a cell, and return how far the study is with it."""
    if one.scores is None:
        assert one.failure is not None
        store.give_up(one.id, one.failure)
        return replace(progress, failed=progress.failed + 1, failure=progress.failure or one.failure)
    store.save(one.id, one.scores)
    return replace(
        progress,
        done=progress.done + 1,
        here=progress.here + 1,
        numerator=progress.numerator + float(one.scores.numerator[0].sum()),
        denominator=progress.denominator + float(one.scores.denominator[0].sum()),
    )
