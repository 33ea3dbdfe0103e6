"""Talkers who walk and speak in a room, as a recording with its truth."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from probtrack._checks import check_int
from probtrack._threads import one_thread
from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray, shipped_arrays
from probtrack.simulation.faults import Faults
from probtrack.simulation.motion import Motion
from probtrack.simulation.noise import Noise, WhiteNoise, at_snr, mixed
from probtrack.simulation.rooms import SPEECH, ResponseCache, Room
from probtrack.simulation.trajectories import Trajectories
from probtrack.simulation.truth import FRAME, Truth
from probtrack.simulation.voices import Speech, Turns, TurnTaking, Voices

_PEAK = 0.9  # of the loudest sample of a recording
_PURPOSES = ("motion", "turns", "voices", "noise", "faults")
_LONGEST = 600.0  # s
_MOST = 40_000_000  # samples of all microphones: a scene is worked out as a whole, in about 3 GB then
_LEVELS = 200.0  # dB


class Recording(NamedTuple):
    """What the microphones heard, and why.

    Attributes:
        audio: (M, S), full scale 1.
        fs: Sampling rate [Hz].
        array: The microphones as they are said to be.
        true_array: As they are: another object only where their positions have errors.
        truth: The talkers at the centre of each frame.
        speech: The dry speech of each talker, with its own truth.
    """

    audio: Tensor
    fs: int
    array: MicrophoneArray
    true_array: MicrophoneArray
    truth: Truth
    speech: list[Speech]


class Heard(NamedTuple):
    """A scene before its noise: what is the same at every signal-to-noise ratio.

    Attributes:
        clean: (M, S), the talkers with their reverberation.
        noise: (M, S), all noises together, of any power.
        recording: The rest, without audio.
    """

    clean: Tensor
    noise: Tensor
    recording: Recording


@dataclass(frozen=True)
class Scene:
    """Talkers in a room; the same scene gives the same recording, bit for bit on one machine.

    The level of all noises together is set by `snr_db`: the mean power of the talkers with their reverberation, over
    all microphones and over the samples at which someone speaks, over the mean power of the noise.

    Args:
        duration: [s].
        room: What the talkers are heard through.
        trajectories: How they move.
        voices: What they sound like.
        turns: Who speaks when.
        num_talkers: Number of talkers.
        array: Name of an array that ships with probtrack, or an array file.
        directivity: A talker is louder in front, or equally loud in all directions.
        snr_db: Signal-to-noise ratio over speech [dB].
        noises: Noises, by their levels relative to each other; none for a clean recording.
        faults: Of the microphones.
        seed: Of everything drawn.
        fs: Sampling rate [Hz].
    """

    duration: float
    room: Room
    trajectories: Trajectories
    voices: Voices
    turns: Turns = field(default_factory=TurnTaking)
    num_talkers: int = 1
    array: str = "lehmann2007"
    directivity: Literal["speech", "omnidirectional"] = "speech"
    snr_db: float = 20.0
    noises: tuple[Noise, ...] = (WhiteNoise(),)
    faults: Faults = field(default_factory=Faults)
    seed: int = 0
    fs: int = 16000

    def __post_init__(self) -> None:
        if not -_LEVELS <= self.snr_db <= _LEVELS:
            raise InputError(f"scene: snr_db must be from {-_LEVELS:g} to {_LEVELS:g}, got {self.snr_db}")
        if not isinstance(self.noises, tuple):
            raise InputError(f"scene: noises must be a list of noises, maybe empty, got {self.noises}")
        for noise in self.noises:
            if not -_LEVELS <= noise.level_db <= _LEVELS:
                raise InputError(f"scene: level_db must be from {-_LEVELS:g} to {_LEVELS:g}, got {noise.level_db}")
        if not FRAME <= self.duration <= _LONGEST:
            raise InputError(f"scene: duration must be {FRAME} to {_LONGEST:g} s, got {self.duration}")
        if self.directivity not in ("speech", "omnidirectional"):
            raise InputError(f"scene: directivity must be speech or omnidirectional, got {self.directivity!r}")
        check_int(self.num_talkers, "scene: num_talkers", low=1)
        check_int(self.seed, "scene: seed", low=0)
        if not 8000 <= check_int(self.fs, "scene: fs", low=8000) <= 96000:
            raise InputError(f"scene: fs must be from 8000 to 96000 Hz, got {self.fs}")

    def load_array(self) -> MicrophoneArray:
        """Return the microphones as they are said to be."""
        array = MicrophoneArray.from_yaml(shipped_arrays().get(self.array, Path(self.array)))
        if array.axes != 3:
            raise InputError(f"{self.array}: a room needs microphones in three dimensions, got {array.axes}")
        written = [[round(x, 6) for x in row] for row in array.positions.tolist()]  # as its file will say them
        return MicrophoneArray(written, array.name)

    def true_array(self) -> MicrophoneArray:
        """Return the microphones where they really are."""
        return self._displaced(self.load_array())

    def motion(self) -> Motion:
        """Return the motion of the talkers, T = duration * fs and batch (K,)."""
        return Motion(*(column[:, 0] for column in self.motions([self.seed], self.fs)))

    def motions(self, seeds: Sequence[int], rate: float) -> Motion:
        """Return the motions of the talkers with each of `seeds` (R,) for the scene's, at `rate` [Hz], batch (R, K)."""
        return self.trajectories.draw(
            [_own_seed(seed, "motion") for seed in seeds],
            num_talkers=self.num_talkers,
            duration=self.duration,
            rate=rate,
            region=self.room.region,
            microphones=self.load_array().positions,
        )

    @one_thread()  # sums over several threads round otherwise: the bits would depend on their number
    def listen(self, cache: ResponseCache | None = None) -> Heard:
        """Work out what the microphones hear, noise apart.

        Args:
            cache: Where the responses of rooms are kept; None to keep none.

        Raises:
            ImportError: without pyroomacoustics, for a simulated room with reverberation.
            InputError: for what cannot be: a talker outside the room, no speech to be found, ...
        """
        array = self.load_array()
        if array.num_microphones * self.duration * self.fs > _MOST:
            longest = _MOST / (array.num_microphones * self.fs)
            raise InputError(
                f"scene: duration must be at most {longest:.0f} s with {array.num_microphones} microphones "
                f"at {self.fs} Hz, got {self.duration}"
            )
        self.room.check_array(array)
        true_array = self._displaced(array)
        self.room.check_array(true_array)
        motion = self.motion()
        schedule = self.turns.draw(self.num_talkers, self.duration, self._generator("turns"))
        if not any(schedule):
            raise InputError(f"scene: turns must have an utterance within the duration of {self.duration} s")
        speech = self.voices.speak(schedule, duration=self.duration, fs=self.fs, seed=self._seed("voices"))
        directivity = SPEECH if self.directivity == "speech" else None
        clean = torch.zeros(array.num_microphones, motion.position.shape[0])
        for k, one in enumerate(speech):
            clean += self.room.render(
                one.samples, motion.talker(k), true_array, self.fs, directivity=directivity, cache=cache
            )
        noise = mixed(self.noises, self.room, true_array, clean.shape[-1], self.fs, self._generator("noise"), cache)
        truth = Truth.of(motion, speech, array.centre, self.fs)
        rest = Recording(clean[:, :0], self.fs, array, true_array, truth, speech)
        return Heard(clean, noise, rest)

    @one_thread()
    def record(self, heard: Heard) -> Recording:
        """Return the recording of what was heard, with the noise at `snr_db`, faults, and a peak of 0.9."""
        active = torch.stack([one.active for one in heard.recording.speech]).any(0)
        audio = heard.clean
        if self.noises:
            audio = audio + at_snr(heard.clean, heard.noise, self.snr_db, active)
        audio = self.faults.apply(audio, self._generator("faults"))
        peak = float(audio.abs().max())
        if not math.isfinite(peak):
            raise InputError("scene: the recording is not finite; is a level too high?")
        return heard.recording._replace(audio=audio * (_PEAK / peak) if peak > 0 else audio)

    def simulate(self, cache: ResponseCache | None = None) -> Recording:
        """Return the recording and its truth; see `listen` for what can be wrong."""
        return self.record(self.listen(cache))

    def _displaced(self, array: MicrophoneArray) -> MicrophoneArray:
        return self.faults.true_array(array, self._generator("faults"), self.room.region)

    def _seed(self, purpose: str) -> int:
        return _own_seed(self.seed, purpose)

    def _generator(self, purpose: str) -> torch.Generator:
        return torch.Generator().manual_seed(self._seed(purpose))


def _own_seed(seed: int, purpose: str) -> int:
    """Return a seed of its own for each purpose, so that a change of one leaves the others as they are."""
    sequence = np.random.SeedSequence(seed, spawn_key=(_PURPOSES.index(purpose),))
    return int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(2))
