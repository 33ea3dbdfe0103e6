"""Recordings of a study: scene folders, found and looked at before any work."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from probtrack._files import read_yaml
from probtrack.errors import InputError
from probtrack.metrics import Talkers, TrackMetric
from probtrack.simulation import SceneFolder
from probtrack.simulation.data_set import CONFIGURATION, load_data_set, missing_scenes
from probtrack.simulation.scene_folder import ARRAY, SCENE, TRUTH

Value = bool | int | float | str
"""What a condition or a varied setting may be."""


@dataclass(frozen=True)
class Scenes:
    """Recordings that a study file names.

    Args:
        path: Folder of a scene, of a data set, or of several scenes.
        name: What they are called, the folder's own name by default.
        conditions: What tells these recordings from others, such as `{room: office}`. The ratio of signal to noise and
            the reverberation time (`snr_db`, `t60`) of simulated scenes are known.
    """

    path: str
    name: str | None = None
    conditions: dict[str, Value] = field(default_factory=dict)


@dataclass(frozen=True)
class Recording:
    """A recording of a study.

    Attributes:
        name: What it is called.
        folder: Where it is.
        conditions: What is varied between recordings, by name.
        truth: What is known of its talkers at the times of the truth; None without any.
    """

    name: str
    folder: Path
    conditions: dict[str, Value]
    truth: Talkers | None

    def fingerprint(self) -> str:
        """Return what tells its files from others."""
        digest = hashlib.sha256()
        for path in (SceneFolder(self.folder).audio_path, self.folder / ARRAY, self.folder / TRUTH):
            digest.update(path.read_bytes() if path.exists() else b"none")
        return digest.hexdigest()[:16]

    def origin(self) -> str | None:
        """Return what it shares with recordings of the same talkers on the same ways at other levels of noise."""
        path = self.folder / TRUTH
        return hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.exists() else None


def recordings(scenes: Scenes, base: Path) -> Iterator[Recording]:
    """Yield the recordings that `scenes` names, from the folder `base` of the study file.

    Raises:
        InputError: where there are none, a data set is not complete, or a recording cannot be used.
    """
    folder = base / scenes.path
    name = scenes.name or folder.resolve().name
    if _is_scene(folder):
        yield _recording(name, folder, scenes.conditions)
        return
    if (folder / CONFIGURATION).exists():
        data_set = load_data_set(folder / CONFIGURATION)
        missing = missing_scenes(data_set, folder)
        if missing:
            raise InputError(
                f"{folder}: {len(missing)} of {data_set.count} scenes of the data set are missing, the first is "
                f"{missing[0]}: run probtrack simulate again"
            )
    inside = sorted(path for path in folder.iterdir() if _is_scene(path)) if folder.is_dir() else []
    if not inside:
        what = "is no scene and holds none" if folder.is_dir() else "there is no such folder"
        raise InputError(f"{folder}: {what}: a scene is a folder with audio.wav or audio.flac, and array.yaml")
    for path in inside:
        yield _recording(f"{name}/{path.name}", path, scenes.conditions)


def _is_scene(folder: Path) -> bool:
    return SceneFolder(folder).audio_path.is_file()


def _recording(name: str, path: Path, conditions: dict[str, Value]) -> Recording:
    folder = SceneFolder(path)
    array = folder.array
    if folder.region is None:
        raise InputError(f"{path / ARRAY}: says no region, where the talker can be: low and high of x and y [m]")
    channels = len(folder.open_recording().channels)
    if channels != len(array.positions):
        raise InputError(f"{folder.audio_path}: has {channels} channels for {len(array.positions)} microphones")
    tables = folder.truth
    truth = None if tables is None else Talkers.of_tables(tables, tables[0].time)
    return Recording(name, path.resolve(), {**_simulated_conditions(path), **conditions}, truth)


def _simulated_conditions(path: Path) -> dict[str, Value]:
    """Return what the file of a simulated scene says of its level of noise and its room."""
    if not (path / SCENE).exists():
        return {}
    content = read_yaml(path / SCENE, "scene file")
    content = content if isinstance(content, dict) else {}
    room: Any = content.get("room")
    inner = room.get("init_args") if isinstance(room, dict) else None
    known = {"snr_db": content.get("snr_db"), "t60": inner.get("t60") if isinstance(inner, dict) else None}
    return {name: value for name, value in known.items() if value is not None}


def check_truth(one: Recording, judged: Sequence[TrackMetric], start: str) -> None:
    """Raise `InputError` unless the truth of a recording has what metrics and the start need."""
    truth = one.truth
    if start == "truth":
        position = None if truth is None or truth.num_talkers != 1 else truth.position
        if position is None or not position[0].isfinite().all():
            raise InputError(
                f"{one.folder}: start: truth needs one talker in truth.csv, with a position in its first row; "
                "start: anywhere does without"
            )
    for metric in judged:
        lacking = [name for name in metric.needs if truth is None or getattr(truth, name) is None]
        if lacking:
            raise InputError(f"{one.folder}: metric {metric.name} needs truth.csv with {', '.join(lacking)}")
        if metric.needs and metric.one_talker and truth is not None and truth.num_talkers > 1:
            raise InputError(f"{one.folder}: metric {metric.name} is of one talker, truth.csv has {truth.num_talkers}")
