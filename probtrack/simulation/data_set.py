"""Many scenes on disk: made by several processes, and gone on with where a run stopped."""

import csv
import dataclasses
import io
import os
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
import yaml

from probtrack._checks import check_int
from probtrack._files import difference, read_yaml
from probtrack._threads import one_thread
from probtrack.errors import InputError
from probtrack.simulation.description import described, from_description, made_with
from probtrack.simulation.files_named import with_files_found
from probtrack.simulation.rooms import ResponseCache
from probtrack.simulation.scene_folder import is_complete, save_scene
from probtrack.simulation.scenes import Scene

CONFIGURATION, INPUTS, MANIFEST = "dataset.yaml", "inputs.yaml", "manifest.csv"
"""Files of a data set, beside its scene folders."""

_COLUMNS = ("folder", "scene", "template", "seed", "snr_db", "num_talkers", "duration")


@dataclass(frozen=True)
class DataSet:
    """Scenes after templates, each at one or several signal-to-noise ratios.

    Scene i follows template i modulo their number, with a seed of its own that `seed` and i determine: data sets of
    different seeds have nothing in common. At several ratios a scene is the same but for the level of its noise.

    Args:
        scenes: Templates; their own seeds are not heeded.
        count: Number of scenes.
        snr_db: Signal-to-noise ratios, each of which every scene is recorded at [dB]; None for the templates' own.
        seed: Of all scenes.
    """

    scenes: tuple[Scene, ...]
    count: int
    snr_db: tuple[float, ...] | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.scenes:
            raise InputError("data set: scenes must hold at least one template")
        check_int(self.count, "data set: count", low=1)
        check_int(self.seed, "data set: seed", low=0)
        if self.snr_db is not None and (not self.snr_db or len({f"{x:g}" for x in self.snr_db}) < len(self.snr_db)):
            raise InputError(f"data set: snr_db must be different ratios, at least one, got {list(self.snr_db)}")

    def recordings(self, index: int) -> dict[str, Scene]:
        """Return the recordings of scene `index`: the name of the folder of each, and its scene."""
        seed = int(
            np.random.SeedSequence(self.seed, spawn_key=(index,)).generate_state(1, np.uint64)[0] >> np.uint64(11)
        )
        scene = dataclasses.replace(self.scenes[index % len(self.scenes)], seed=seed)
        name = f"{index:0{len(str(self.count - 1))}d}"
        if self.snr_db is None:
            return {name: scene}
        return {f"{name}_{snr:+g}dB": dataclasses.replace(scene, snr_db=snr) for snr in self.snr_db}


def load_data_set(path: str | Path) -> DataSet:
    """Return the data set that a YAML file describes; files that it names are found from its folder too."""
    content = with_files_found(read_yaml(path, "data set file"), Path(path).parent)
    return from_description(DataSet, content, path)


def missing_scenes(data_set: DataSet, folder: Path) -> list[int]:
    """Return which scenes of the data set in `folder` are not complete; empty when all are there."""
    return [i for i in range(data_set.count) if not all(is_complete(folder / name) for name in data_set.recordings(i))]


def make_data_set(data_set: DataSet, folder: str | Path, cache: Path | None, workers: int = 1) -> Iterator[int]:
    """Write what is missing of a data set, and yield the number of each scene as it is finished.

    A run that was stopped is gone on with: finished scenes stay as they are. The same files come out whatever the
    number of workers. One run at a time may work on a folder.

    Args:
        data_set: What to make.
        folder: Where; made if it is not there.
        cache: Folder of responses that the workers share; None to keep none.
        workers: Processes, each on one thread.

    Raises:
        InputError: for a folder with another data set or something else in it, a scene that cannot be, or a disk
            that is full. What was finished stays valid.
    """
    folder = Path(folder)
    check_int(workers, "workers", low=1)
    _begin(data_set, folder)
    todo = missing_scenes(data_set, folder)
    try:
        if workers == 1 or len(todo) <= 1:
            for index in todo:
                with one_thread():
                    made = _make(data_set, folder, cache, index)
                yield made
        else:
            yield from _in_parallel(data_set, folder, cache, todo, min(workers, len(todo)))
    finally:
        _write_manifest(data_set, folder)


def read_manifest(folder: str | Path) -> list[dict[str, str]]:
    """Return the rows of a data set's manifest, one a recording that is complete."""
    path = Path(folder) / MANIFEST
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise InputError(f"{path}: cannot read the manifest of a data set: {error.strerror}") from None
    except (csv.Error, UnicodeDecodeError) as error:
        raise InputError(f"{path}: the manifest of a data set is not CSV: {error}") from None
    if not rows or set(_COLUMNS) - rows[0].keys():
        raise InputError(f"{path}: not the manifest of a data set with columns {', '.join(_COLUMNS)}, or an empty one")
    return rows


def check_data_set_output(data_set: DataSet, folder: Path) -> None:
    """Raise `InputError` where `folder` holds another data set, or something else."""
    path = folder / CONFIGURATION
    try:
        if path.exists():
            there = {"": read_yaml(path, "data set file"), "inputs": read_yaml(folder / INPUTS, "inputs file")}
            found = difference(there, {"": described(data_set), "inputs": _inputs(data_set)})
            if found:
                raise InputError(f"{folder}: holds another data set ({found}): name another folder")
        elif folder.exists() and any(folder.iterdir()):
            raise InputError(f"{folder}: is not empty and holds no data set: name another folder")
    except OSError as error:
        raise InputError(f"{folder}: cannot write the data set: {error.strerror}") from None


def _begin(data_set: DataSet, folder: Path) -> None:
    """Make the folder, or see that it holds this very data set and sweep away what a killed run left unfinished."""
    check_data_set_output(data_set, folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot write the data set: {error.strerror}") from None
    for left in folder.glob(".*.tmp"):
        if left.is_dir():
            shutil.rmtree(left, ignore_errors=True)
        else:
            left.unlink(missing_ok=True)
    if not (folder / CONFIGURATION).exists():
        _put(folder / INPUTS, yaml.safe_dump(_inputs(data_set), sort_keys=False, default_flow_style=None))
        _put(folder / CONFIGURATION, yaml.safe_dump(described(data_set), sort_keys=False, default_flow_style=None))


def _inputs(data_set: DataSet) -> dict[str, object]:
    """Return what the files depend on beside the configuration: versions, and what the array files hold."""
    arrays = {scene.array: scene.load_array().positions.double() for scene in data_set.scenes}
    places = {name: [[round(x, 6) for x in row] for row in rows.tolist()] for name, rows in arrays.items()}
    return {"made_with": made_with(), "arrays": places}


def _make(data_set: DataSet, folder: Path, cache: Path | None, index: int) -> int:
    """Make what is missing of one scene: what is heard is worked out once for all ratios."""
    todo = {name: scene for name, scene in data_set.recordings(index).items() if not is_complete(folder / name)}
    try:
        heard = next(iter(todo.values())).listen(ResponseCache(cache) if cache is not None else None)
        for name, scene in todo.items():
            save_scene(folder / name, scene, scene.record(heard))
    except InputError as error:
        raise InputError(f"scene {index}: {error}") from None
    return index


def _in_parallel(data_set: DataSet, folder: Path, cache: Path | None, todo: list[int], workers: int) -> Iterator[int]:
    begin = (torch.get_default_dtype(),)
    with ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=_become_worker, initargs=begin
    ) as pool:
        try:
            left = iter(todo)  # no more are handed out than are worked on: an interruption waits for these only
            with _interruptions_held():
                pending = {pool.submit(_make, data_set, folder, cache, index) for index in islice(left, workers)}
            while pending:
                made, pending = wait(pending, return_when=FIRST_COMPLETED)
                pending |= {pool.submit(_make, data_set, folder, cache, index) for index in islice(left, len(made))}
                yield from (future.result() for future in made)
        except BrokenProcessPool:
            raise InputError(
                f"{folder}: a worker was killed, perhaps for want of memory: start again with fewer --workers to go on"
            ) from None
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _interruptions_held() -> Iterator[None]:
    """Hold an interruption back: processes started meanwhile never hear one, and this one does afterwards."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


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


def _write_manifest(data_set: DataSet, folder: Path) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for index in range(data_set.count):
        for name, scene in data_set.recordings(index).items():
            if is_complete(folder / name):
                template = index % len(data_set.scenes)
                writer.writerow([name, index, template, scene.seed, scene.snr_db, scene.num_talkers, scene.duration])
    _put(folder / MANIFEST, text.getvalue())


def _put(path: Path, text: str) -> None:
    """Write a file, which is there whole or not at all."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        unfinished.write_text(text, encoding="utf-8")
        unfinished.replace(path)
    except OSError as error:
        unfinished.unlink(missing_ok=True)
        raise InputError(f"{path}: cannot write: {error.strerror}") from None
