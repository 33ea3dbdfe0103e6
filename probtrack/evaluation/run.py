"""A study done, or gone on with: cells are claimed, worked on and kept one by one."""

import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from probtrack._checks import check_int
from probtrack._files import difference
from probtrack.errors import InputError
from probtrack.evaluation.cluster import on_cluster
from probtrack.evaluation.execution import Claims, Finished, in_processes, in_this_process
from probtrack.evaluation.store import Store
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


def evaluate(
    study: Study,
    path: str | Path,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> Progress:
    """Do what is not yet done of a study in the store at `path`, and return how far it is then.

    A store that is there is gone on with; cells that failed are tried again, and those that another process works on
    are left to it. The numbers do not depend on who does the work, or on how often it was stopped.

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
        progress = _begin(study, store)
        on_progress(progress)

        def claims() -> Claims:
            while (number := store.claim()) is not None:
                yield number, cells[number]

        begin = time.monotonic()
        try:
            for one in _worked_on(claims(), workers, scheduler):
                progress = _kept(store, one, progress)
                done, failed = store.progress  # by other processes too
                progress = replace(progress, done=done, failed=failed, seconds=time.monotonic() - begin)
                on_progress(progress)
        finally:
            with suppress(InputError):  # what is wrong with the disk has been said
                store.release()
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
    conditions = {cell.scene: cell.conditions for cell in store.cells}
    there = {"config": store.config, "recordings": conditions}
    here = {"config": study.config, "recordings": {scene.name: scene.conditions for scene in study.scenes}}
    found = difference(there, here)
    fingerprints = store.fingerprints
    changed = next((one.name for one in study.scenes if one.fingerprint != fingerprints.get(one.name)), None)
    return found or (f"the files of recording {changed} are others now" if changed is not None else "")


def _worked_on(claims: Claims, workers: int, scheduler: str | None) -> Iterator[Finished]:
    if scheduler is not None:
        return on_cluster(claims, scheduler)
    return in_this_process(claims) if workers == 1 else in_processes(claims, workers)


def _begin(study: Study, store: Store) -> Progress:
    first = study.metrics[0]
    scores = store.scores(first.name)
    done, failed = store.progress
    sums = float(scores.numerator.sum()), float(scores.denominator.sum())
    return Progress(len(study.cells), done, failed, done, 0.0, first.name, first.unit, *sums)


def _kept(store: Store, one: Finished, progress: Progress) -> Progress:
    """Keep a cell, and return the progress with its figures."""
    if isinstance(one.outcome, str):
        store.give_up(one.id, one.outcome)
        return replace(progress, failure=progress.failure or one.outcome)
    store.save(one.id, one.outcome)
    return replace(
        progress,
        numerator=progress.numerator + float(one.outcome.numerator[0].sum()),
        denominator=progress.denominator + float(one.outcome.denominator[0].sum()),
    )
