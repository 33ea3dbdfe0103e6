"""Recordings of a study: scene folders, found and looked at before any work."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from probtrack._files import read_yaml
from probtrack.errors import InputError
from probtrack.evaluation.factors import check_values
from probtrack.simulation import SceneFolder
from probtrack.simulation.data_set import CONFIGURATION, load_data_set, missing_scenes
from probtrack.simulation.scene_folder import ARRAY, SCENE, TRUTH
from probtrack.track_files import TrackTable

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

    @classmethod
    def of(cls, entry: Any) -> "Scenes":
        """Return what a study file says: a folder, or a mapping of `path`, `name` and `conditions`."""
        if isinstance(entry, cls):
            made = entry
        else:
            content = {"path": entry} if isinstance(entry, str) else entry
            if not isinstance(content, dict):
                raise InputError(
                    f"scenes: must be a folder, or have path and perhaps name and conditions, got {entry!r}"
                )
            names = [one.name for one in fields(cls)]
            unknown = next((name for name in content if name not in names), None)
            if unknown is not None:
                raise InputError(f"scenes: nothing is called {unknown!r}: there are {', '.join(names)}")
            if content.get("path") is None:
                raise InputError(f"scenes: must have a path, got {entry!r}")
            made = cls(content["path"], content.get("name"), content.get("conditions") or {})
        if not (isinstance(made.path, str) and made.path.strip()):
            raise InputError(f"scenes: path must be that of a folder, got {made.path!r}")
        if made.name is not None and not (isinstance(made.name, str) and made.name.strip()):
            raise InputError(f"scenes: {made.path}: name must be text and not empty, got {made.name!r}")
        if not isinstance(made.conditions, dict):
            raise InputError(f"scenes: {made.path}: conditions must be values by name, got {made.conditions!r}")
        for name, value in made.conditions.items():
            check_values([value], f"scenes: {made.path}: condition {name}")
        return made


@dataclass(frozen=True)
class Recording:
    """A recording of a study.

    Attributes:
        name: What it is called.
        folder: Where it is.
        conditions: What is varied between recordings, by name.
        truth: What is known of each talker; None without any.
    """

    name: str
    folder: Path
    conditions: dict[str, Value]
    truth: list[TrackTable] | None

    def fingerprint(self) -> str:
        """Return what tells its files from others."""
        return fingerprint(self.folder)

    def origin(self) -> str | None:
        """Return what it shares with recordings of the same talkers on the same ways at other levels of noise."""
        path = self.folder / TRUTH
        return hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.exists() else None


def fingerprint(folder: Path) -> str:
    """Return what tells the files of a scene folder from others; what is not there counts too."""
    digest = hashlib.sha256()
    for path in (SceneFolder(folder).audio_path, folder / ARRAY, folder / TRUTH):
        digest.update(path.read_bytes() if path.exists() else b"none")
    return digest.hexdigest()[:16]


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
        if folder.is_file():
            raise InputError(f"{folder}: is a file, expected a folder")
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
    return Recording(name, path.resolve(), {**_simulated_conditions(path), **conditions}, folder.truth)


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
