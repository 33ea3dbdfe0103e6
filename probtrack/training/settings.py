"""Front ends as settings of plain values, which a configuration file can say."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal

from probtrack.audio import FrontEnd
from probtrack.geometry import SPEED_OF_SOUND, MicrophoneArray, Region
from probtrack.trackers import lehmann2007


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
        tracker = lehmann2007(
            array,
            Region.around(array),
            vad=self.vad,
            vad_threshold=self.vad_threshold,
            vad_slope=self.vad_slope,
            fs=fs,
            frame_length=self.frame_length,
            hop=self.hop,
            band_low=self.band_low,
            band_high=self.band_high,
            speed_of_sound=self.speed_of_sound,
        )
        return tracker.front_end
