"""What is wrong with real arrays: gains, places, dead channels, converters that saturate."""

from dataclasses import dataclass

import torch
from torch import Tensor

from probtrack._checks import as_non_negative, check_int
from probtrack.errors import InputError, NotFiniteError, ShapeError
from probtrack.geometry import MicrophoneArray, Region

_HISS_DB = -60.0  # of a dead channel, relative to the mean power of the recording
_KINDS = 3  # of random numbers


@dataclass(frozen=True)
class Faults:
    """Faults of a microphone array, all off unless given.

    Each fault has random numbers of its own: one that is turned on does not change another.

    Args:
        gain_std_db: Standard deviation of each microphone's gain, normal and independent [dB].
        position_std: Standard deviation of each coordinate of a microphone's true place about the stated one,
            normal and independent [m].
        dead_channels: Numbers of the microphones, from 1, that give white noise only, 60 dB below the mean power
            of the recording: what is left where a capsule is broken but its amplifier is not.
        clipping_db: How far below the peak of the recording, over all channels, the converters saturate [dB];
            None where they do not.
    """

    gain_std_db: float = 0.0
    position_std: float = 0.0
    dead_channels: tuple[int, ...] = ()
    clipping_db: float | None = None

    def __post_init__(self) -> None:
        as_non_negative(self.gain_std_db, "gain_std_db")
        as_non_negative(self.position_std, "position_std")
        for channel in self.dead_channels:
            check_int(channel, "dead_channels", low=1)
        if self.clipping_db is not None:
            as_non_negative(self.clipping_db, "clipping_db")

    def true_array(
        self, array: MicrophoneArray, generator: torch.Generator, region: Region | None = None
    ) -> MicrophoneArray:
        """Return where the microphones of the stated `array` really are, by `position_std`.

        Those that would be outside `region`, the room, are put at its nearest point.
        """
        self._check_channels(array.num_microphones)
        error = torch.randn(
            array.positions.shape, generator=self._generators(generator)[0], dtype=torch.float64
        )  # the same in any precision
        moved = (array.positions + self.position_std * error).to(array.positions)
        if self.position_std == 0:
            return array
        if region is not None:
            low, high = moved.new_tensor(region.low), moved.new_tensor(region.high)
            moved = moved.clamp(low[: array.axes], high[: array.axes])
        return MicrophoneArray(moved, array.name)

    def apply(self, audio: Tensor, generator: torch.Generator) -> Tensor:
        """Return what a recording (M, S) becomes: gains first, then dead channels, converters last.

        Raises:
            InputError: for a dead channel that is not there, all channels dead, or audio that is not finite.
        """
        self._check(audio)
        _, gains, hiss = self._generators(generator)
        faulty = audio
        if self.gain_std_db > 0:
            level = self.gain_std_db * torch.randn(len(audio), 1, generator=gains, dtype=torch.float64)
            faulty = faulty * (10 ** (level / 20)).to(audio)
        if self.dead_channels:
            noise = torch.randn(audio.shape, generator=hiss, dtype=torch.float64)
            scale = faulty.double().square().mean().sqrt() * 10 ** (_HISS_DB / 20)
            dead = torch.zeros(len(audio), 1, dtype=torch.bool)
            dead[[channel - 1 for channel in self.dead_channels]] = True
            faulty = torch.where(dead, (noise * scale).to(audio), faulty)
        if self.clipping_db is not None:
            limit = float(faulty.abs().max()) * 10 ** (-self.clipping_db / 20)
            faulty = faulty.clamp(-limit, limit)
        return faulty

    def _check(self, audio: Tensor) -> None:
        if audio.ndim != 2:
            raise ShapeError(f"audio must have shape (M, S), got {tuple(audio.shape)}")
        if not audio.isfinite().all():
            raise NotFiniteError("audio must be finite, got NaN or infinite samples")
        self._check_channels(len(audio))

    def _check_channels(self, count: int) -> None:
        absent = [channel for channel in self.dead_channels if channel > count]
        if absent:
            raise InputError(f"dead_channels must be from 1 to {count}, got {absent[0]}")
        if len(set(self.dead_channels)) == count:
            raise InputError(f"dead_channels must leave a microphone alive, got all {count}")

    @staticmethod
    def _generators(generator: torch.Generator) -> list[torch.Generator]:
        """Return one generator a fault; the given one moves on by the same numbers whatever is wrong."""
        seeds = torch.randint(2**62, (_KINDS,), generator=generator).tolist()
        return [torch.Generator().manual_seed(seed) for seed in seeds]
