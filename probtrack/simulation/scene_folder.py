"""Scenes as folders: written whole or not at all, and read back."""

import io
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import soundfile
import torch
import yaml

from probtrack import audio
from probtrack._files import read_yaml
from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray, Region
from probtrack.simulation.description import described, from_description, made_with
from probtrack.simulation.files_named import with_files_found
from probtrack.simulation.scenes import Recording, Scene
from probtrack.simulation.truth import save_scores
from probtrack.track_files import TrackTable, read_tracks

AUDIO, ARRAY, TRUTH, SCENE = "audio.wav", "array.yaml", "truth.csv", "scene.yaml"
"""Files of a scene folder."""

_TRUE_ARRAY, _SCORES = "true_array.yaml", "voices.csv"
_FILES = (SCENE, AUDIO, ARRAY, TRUTH, _TRUE_ARRAY, _SCORES)


@dataclass(frozen=True)
class SceneFolder:
    """A scene on disk: a recording, its microphones and what is known of its talkers.

    A folder of one's own needs the recording and the array only.

    Args:
        path: The folder.
    """

    path: Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))

    @property
    def audio_path(self) -> Path:
        """File of the recording, `audio.wav` or `audio.flac`."""
        flac = self.path / "audio.flac"
        return flac if flac.exists() else self.path / AUDIO

    def open_recording(self, fs: int = 16_000) -> audio.Recording:
        """Open the recording, to be read at `fs` [Hz]."""
        return audio.Recording.open(self.audio_path, fs)

    @property
    def array(self) -> MicrophoneArray:
        """The microphones as they are said to be."""
        return MicrophoneArray.from_yaml(self.path / ARRAY)

    @property
    def region(self) -> Region | None:
        """Where a talker can be, if the array file says it."""
        return Region.from_yaml(self.path / ARRAY)

    @property
    def truth(self) -> list[TrackTable] | None:
        """The truth of each talker; None where the folder has none."""
        path = self.path / TRUTH
        return read_tracks(path) if path.exists() else None

    @property
    def scene(self) -> Scene:
        """The scene that made it."""
        return load_scene(self.path / SCENE)


def load_scene(path: str | Path) -> Scene:
    """Return the scene that a YAML file describes; files that it names are found from its folder too."""
    content = with_files_found(read_yaml(path, "scene file"), Path(path).parent)
    return from_description(Scene, content, path)


def check_scene_output(folder: str | Path) -> None:
    """Raise `InputError` where `folder` holds something that is not a scene, before any work is done for it."""
    path = Path(folder)
    try:
        ours = any((path / name).exists() for name in (SCENE, TRUTH))
        free = not path.exists() or (path.is_dir() and (ours or not any(path.iterdir())))
    except OSError as error:
        raise InputError(f"{folder}: cannot write the scene: {error.strerror}") from None
    if not free:
        raise InputError(f"{folder}: is there already, and is not a scene: name another folder")


def is_complete(folder: Path) -> bool:
    """Return whether `folder` has all files of a scene, none of them empty."""
    return all((folder / name).is_file() and (folder / name).stat().st_size > 0 for name in _FILES[:4])


def save_scene(folder: str | Path, scene: Scene, recording: Recording) -> None:
    """Write `scene` and what came of it as a folder, which is there whole or not at all.

    Raises:
        InputError: where it cannot be written, as on a full disk, or there is such a folder with something else in it.
    """
    check_scene_output(folder)
    with _whole(Path(folder).resolve()) as target:
        pcm = (recording.audio.T * 32767).round().clamp(-32768, 32767).to(torch.int16).numpy()
        wave = io.BytesIO()  # soundfile would call a full disk a system error
        soundfile.write(wave, pcm, recording.fs, format="WAV", subtype="PCM_16")
        (target / AUDIO).write_bytes(wave.getbuffer())
        recording.array.to_yaml(target / ARRAY, scene.room.region)
        if recording.true_array is not recording.array:
            recording.true_array.to_yaml(target / _TRUE_ARRAY, scene.room.region)
        recording.truth.save(target / TRUTH)
        save_scores(target / _SCORES, recording.speech)
        (target / SCENE).write_text(scene_text(scene), encoding="utf-8")


def scene_text(scene: Scene) -> str:
    """Return the scene file of `scene`, its array beside it."""
    versions = ", ".join(f"{name} {version}" for name, version in made_with().items())
    content = described(scene) | {"array": ARRAY}
    return f"# made with {versions}\n" + yaml.safe_dump(content, sort_keys=False, default_flow_style=None)


@contextmanager
def _whole(folder: Path) -> Iterator[Path]:
    """Give a new folder to write to, which takes the place of `folder` when all is written."""
    unfinished = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    try:
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir(parents=True)
        yield unfinished
        if folder.exists():
            for name in _FILES:  # the description goes first and comes last: without it a folder is not complete
                (folder / name).unlink(missing_ok=True)
            for name in reversed(_FILES):
                if (unfinished / name).exists():
                    (unfinished / name).replace(folder / name)
        else:
            unfinished.rename(folder)
    except (OSError, soundfile.SoundFileError) as error:
        what = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(f"{folder}: cannot write the scene: {' '.join(str(what).split())}") from None
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
