"""Front ends and trackers as settings of plain values, which a configuration file can say."""

from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from probtrack._checks import check_int
from probtrack.audio import FrontEnd
from probtrack.dynamics import Dynamics
from probtrack.errors import InputError
from probtrack.filters import ParticleFilter, Relocation, Resampler
from probtrack.geometry import SPEED_OF_SOUND, MicrophoneArray, Region, shipped_arrays
from probtrack.likelihoods import Likelihood
from probtrack.parameters import read_parameters
from probtrack.trackers import Tracker, lehmann2007
from probtrack.trackers.lehmann2007 import Model


class FrontEndSettings(ABC):
    """What makes a front end once it is known for which array: dataclasses of plain values."""

    @abstractmethod
    def make(self, array: MicrophoneArray, fs: int) -> FrontEnd:
        """Return the front end for `array` at `fs` [Hz]; `InputError` for values that cannot be."""


@dataclass(frozen=True)
class Lehmann2007FrontEnd(FrontEndSettings):
    """The front end of `trackers.lehmann2007`.

    Args:
        frame_length: Samples in a frame.
        hop: Samples between the starts of frames.
        band_low: Lowest frequency used [Hz].
        band_high: Highest frequency used [Hz].
        vad: Voice activity detector: level over a tracked noise floor, or the neural one of silero-vad.
        vad_threshold: Level over the noise floor that the energy detector takes for speech with probability 1/2 [dB].
        vad_slope: Steepness of the energy detector's decision [1/dB].
        speed_of_sound: Speed of sound [m/s].
    """

    frame_length: int = 512
    hop: int = 256
    band_low: float = 300.0
    band_high: float = 3000.0
    vad: Literal["energy", "silero"] = "energy"
    vad_threshold: float = 8.0
    vad_slope: float = 1.0
    speed_of_sound: float = SPEED_OF_SOUND

    def make(self, array: MicrophoneArray, fs: int) -> FrontEnd:
        tracker = lehmann2007(array, Region.around(array), fs=fs, **asdict(self))
        return tracker.front_end


class TrackerSettings(ABC):
    """What makes a tracker: dataclasses of plain values and of models named by their classes."""

    @abstractmethod
    def make(self) -> Tracker:
        """Return the tracker; `InputError` for values that cannot be."""


@dataclass(frozen=True)
class Lehmann2007Settings(TrackerSettings):
    """The tracker of `trackers.lehmann2007`, any part of which may be another.

    Args:
        array: Array file, or the name of one that ships with probtrack.
        low: Lowest corner of the region where talkers can be [m]; that of the array file if not given.
        high: Its highest corner [m].
        model: Motion model, by its name in S1's Table 1, or a model that switches between several.
        num_particles: Particles N.
        keep_out: No mouth is nearer than this to a microphone [m].
        exponent: Exponent of the steered power to begin with.
        front_end: Frames, band and voice activity.
        fs: Working sampling rate [Hz].
        relocation: How a lost talker is found again; not at all if None.
        dynamics: A motion model of one's own in place of `model`.
        likelihood: A likelihood of one's own in place of the steered power's.
        resample: What happens to the cloud after each frame; systematic resampling on N_eff < 0.75 N if None.
        parameters: File of parameters to begin with, such as the `parameters.yaml` of an earlier run: those that it
            names replace what the other arguments say.
    """

    array: str = "lehmann2007"
    low: tuple[float, ...] | None = None
    high: tuple[float, ...] | None = None
    model: Model = "CU-LAN"
    num_particles: int = 75
    keep_out: float = 0.2
    exponent: float = 2.0
    front_end: Lehmann2007FrontEnd = Lehmann2007FrontEnd()
    fs: int = 16_000
    relocation: Relocation | None = None
    dynamics: Dynamics | None = None
    likelihood: Likelihood | None = None
    resample: Resampler | None = None
    parameters: str | None = None

    def make(self) -> Tracker:
        path = shipped_arrays().get(self.array, Path(self.array))
        array = MicrophoneArray.from_yaml(path)
        check_int(self.fs, "fs", low=1)
        made = lehmann2007(
            array,
            self._region(path),
            self.model,
            num_particles=self.num_particles,
            keep_out=self.keep_out,
            exponent=self.exponent,
            fs=self.fs,
            **asdict(self.front_end),
        )
        standard = made.filter
        tracked = ParticleFilter(
            standard.dynamics if self.dynamics is None else self.dynamics,
            standard.likelihood if self.likelihood is None else self.likelihood,
            num_particles=self.num_particles,
            resample=standard.resample if self.resample is None else self.resample,
            origin=array.centre,
            relocation=self.relocation,
        )
        tracker = Tracker(made.front_end, tracked, made.region, fs=self.fs)
        if self.parameters is not None:
            read_parameters(self.parameters, tracker, partly=True)  # an earlier run may have kept some fixed
        return tracker

    def _region(self, path: Path) -> Region:
        if self.low is not None and self.high is not None:
            return Region(self.low, self.high)
        if self.low is not None or self.high is not None:
            raise InputError("low and high must be given together, the corners of the region")
        region = Region.from_yaml(path)
        if region is None:
            raise InputError(f"{path}: has no region: give low and high, the corners of where talkers can be")
        return region
