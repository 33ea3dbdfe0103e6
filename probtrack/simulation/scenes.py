"""A talker who walks and speaks in a room, as a recording with its truth: a folder on disk."""

import csv
import dataclasses
import math
from pathlib import Path
from typing import Any, NamedTuple

import soundfile
import torch
import yaml
from torch import Tensor

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray, azimuth, shipped_arrays
from probtrack.simulation.paths import smooth_path
from probtrack.simulation.motion import Motion
from probtrack.simulation.rooms import ShoeboxRoom
from probtrack.simulation.voices import load_speech, synthesise_speech

FRAME, HOP = 512, 256
"""Length of the frames that the truth is given for, and the way from one to the next [samples]."""

_PEAK = 0.9  # of the loudest sample in a saved recording


class Truth(NamedTuple):
    """What the talker does at the centre of each frame, T rows.

    Attributes:
        time: (T,) [s].
        position: (T, 3), of the mouth [m].
        azimuth: (T,), seen from the centre of the array [rad].
        heading: (T,), direction of motion [rad].
        speech: (T,) bool.
    """

    time: Tensor
    position: Tensor
    azimuth: Tensor
    heading: Tensor
    speech: Tensor

    def save(self, path: str | Path) -> None:
        """Write the rows as CSV in the columns of a track file."""
        with Path(path).open("w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["time", "track", "x", "y", "z", "azimuth", "heading", "speech"])
            for t, xyz, *angles, speech in zip(*(column.tolist() for column in self), strict=True):
                numbers = [f"{value:.6f}" for value in (*xyz, *angles)]
                writer.writerow([f"{t:.6f}", 1, *numbers, int(speech)])


class Recording(NamedTuple):
    """What the microphones heard, and why.

    Attributes:
        audio: (M, S), full scale 1.
        fs: Sampling rate [Hz].
        truth: The talker at the centre of each frame.
    """

    audio: Tensor
    fs: int
    truth: Truth


@dataclasses.dataclass(frozen=True)
class Scene:
    """One talker on a smooth path in a room; the same scene gives the same recording, bit for bit.

    Args:
        path: Points (K, 3) the mouth passes through [m].
        duration: [s].
        room: Length, width and height [m].
        t60: Reverberation time [s].
        snr_db: Speech, with its reverberation and while it is active, over white sensor noise [dB].
        seed: Of what is said and of the noise.
        speech: Audio file of a voice to use; None for a synthetic one.
        array: Name of an array that ships with probtrack, or an array file.
        fs: Sampling rate [Hz].
        spacing: Way between two points that the reflections are computed for [m].
    """

    path: tuple[tuple[float, float, float], ...]
    duration: float
    room: tuple[float, float, float] = (3.5, 3.1, 2.2)
    t60: float = 0.27
    snr_db: float = 20.0
    seed: int = 0
    speech: str | None = None
    array: str = "lehmann2007"
    fs: int = 16000
    spacing: float = 0.05

    def __post_init__(self) -> None:
        if not math.isfinite(self.snr_db):
            raise InputError(f"scene: snr_db must be finite, got {self.snr_db}")
        if not (math.isfinite(self.duration) and self.duration * self.fs >= FRAME):
            raise InputError(f"scene: duration must be at least {FRAME} samples, got {self.duration} s")

    @classmethod
    def from_yaml(cls, path: str | Path) -> "Scene":
        """Read the `scene.yaml` of a saved scene; an array or speech file is found from its folder too."""
        try:
            content = yaml.safe_load(Path(path).read_text())
            for name in ("array", "speech"):
                beside = Path(path).parent / str(content.get(name))
                if beside.is_file():
                    content[name] = str(beside)
            content["path"] = tuple(tuple(point) for point in content["path"])
            content["room"] = tuple(content["room"])
            return cls(**content)
        except OSError as error:
            raise InputError(f"{path}: cannot read scene: {error.strerror}") from None
        except (yaml.YAMLError, AttributeError, KeyError, TypeError) as error:
            raise InputError(f"{path}: not a scene: {' '.join(str(error).split())}") from None

    def load_array(self) -> MicrophoneArray:
        """Return the microphones of the scene."""
        array = MicrophoneArray.from_yaml(shipped_arrays().get(self.array, Path(self.array)))
        if array.axes != 3:
            raise InputError(f"{self.array}: a room needs microphones in three dimensions, got {array.axes}")
        return array

    def simulate(self) -> Recording:
        """Return the recording, scaled to a peak of 0.9, and its truth.

        Raises:
            ImportError: without pyroomacoustics, unless `t60` is 0.
            InputError: for a path or microphone outside the room, or a speech file that cannot be used.
        """
        generator = torch.Generator().manual_seed(self.seed)
        if self.speech is None:
            speech = synthesise_speech(self.duration, self.fs, generator=generator)
        else:
            speech = load_speech(self.speech, self.fs, self.duration)
        array = self.load_array()
        positions, velocities, heading = smooth_path(self.path, self.duration, self.fs)
        room = ShoeboxRoom(self.room, self.t60)
        audio = room.render(speech.samples, Motion(positions, velocities, heading, heading), array, self.fs)
        audio = add_noise(audio, self.snr_db, speech.active, generator=generator)
        centre = torch.arange(FRAME // 2, audio.shape[-1] - FRAME // 2 + 1, HOP)
        place = positions[centre]
        angle = azimuth(place, array.centre)
        truth = Truth(centre.double() / self.fs, place, angle, heading[centre], speech.active[centre])
        return Recording(audio * (_PEAK / audio.abs().max()), self.fs, truth)

    def save(self, folder: str | Path) -> Recording:
        """Write `audio.wav` (16 bit), `array.yaml`, `truth.csv` and `scene.yaml`; return the recording."""
        recording, folder = self.simulate(), Path(folder)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            pcm = (recording.audio.T * 32767).round().to(torch.int16).numpy()
            soundfile.write(str(folder / "audio.wav"), pcm, self.fs, subtype="PCM_16")
            self.load_array().to_yaml(folder / "array.yaml", ShoeboxRoom(self.room, self.t60).region)
            recording.truth.save(folder / "truth.csv")
            (folder / "scene.yaml").write_text(yaml.safe_dump(self._content(), sort_keys=False))
        except OSError as error:
            raise InputError(f"{folder}: cannot write scene: {error.strerror}") from None
        return recording

    def _content(self) -> dict[str, Any]:
        content = dataclasses.asdict(self) | {"array": "array.yaml"}
        content["path"] = [list(point) for point in self.path]
        content["room"] = list(self.room)
        return content


def demo_scene(seed: int = 0, speech: str | None = None) -> Scene:
    """Return a walk of 8 s among the eight microphones of Lehmann & Johansson 2007, at their height.

    The room is theirs (3.5 x 3.1 x 2.2 m, T60 0.27 s), at 20 dB. Their Figure 3 shows one bent line across the
    array, walked in 7.8 s: so is this one, 2.2 m long; the talker pauses at least twice on the way.
    """
    way = ((0.85, 0.95), (1.55, 1.25), (2.1, 1.7), (2.45, 2.3))
    return Scene(path=tuple((x, y, 1.51) for x, y in way), duration=8.0, seed=seed, speech=speech)


def add_noise(audio: Tensor, snr_db: float, speech: Tensor | None = None, *, generator: torch.Generator) -> Tensor:
    """Return `audio` (M, S) with white Gaussian noise, of the same power at each microphone.

    Args:
        audio: What the microphones hear of the talker, reverberation included.
        snr_db: Ratio of the mean power of `audio`, over all microphones and over the samples where
            `speech` holds, to that of the noise [dB]. Pauses do not count.
        speech: (S,) bool; all samples by default.
        generator: Draws the noise.
    """
    voiced = audio if speech is None else audio[:, speech]
    if voiced.numel() == 0:
        raise InputError("speech must hold somewhere, or the signal-to-noise ratio has no meaning")
    scale = voiced.double().square().mean().sqrt() * 10 ** (-snr_db / 20)
    noise = torch.randn(audio.shape, generator=generator, dtype=torch.float64)
    return (audio + scale * noise).to(audio.dtype)
