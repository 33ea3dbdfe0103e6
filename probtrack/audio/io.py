"""Multichannel recordings, read in blocks at the rate the tracker works at."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import soundfile
import torch
from torch import Tensor
from torchaudio.transforms import Resample

from probtrack._checks import check_int
from probtrack.errors import InputError, NotFiniteError

_FULL_SCALE = 0.9999  # of the format's largest value: at or beyond it a sample counts as clipped
_FLAT = 1e-7  # a channel whose samples differ by less is constant: below the step of 24-bit audio


class ChannelSurvey(NamedTuple):
    """What a first pass over a recording finds in each channel.

    Attributes:
        low: Smallest sample of each channel (C,).
        high: Largest sample of each channel (C,).
        clipped: Share of samples at full scale, of each channel (C,).
    """

    low: Tensor
    high: Tensor
    clipped: Tensor

    @property
    def flat(self) -> Tensor:
        """Whether each channel is constant or all zero, (C,) bool."""
        return self.high - self.low < _FLAT


@dataclass(frozen=True)
class Recording:
    """A sound file that `open` has checked: what it holds, and its samples block by block.

    Attributes:
        path: The file.
        file_rate: Its sampling rate [Hz].
        num_samples: Samples per channel at that rate.
        channels: Which of the file's channels (0-based) are read, in this order.
        fs: Rate at which `blocks` delivers [Hz].
    """

    path: Path
    file_rate: int
    num_samples: int
    channels: tuple[int, ...]
    fs: int

    @classmethod
    def open(cls, path: str | Path, fs: int = 16_000, channels: Sequence[int] | None = None) -> "Recording":
        """Open `path` for reading at `fs` [Hz]; `channels` (0-based) picks and orders, None takes all.

        Raises:
            InputError: for a file that is missing, unreadable, not audio, empty, or without the channels.
        """
        path = Path(path)
        try:
            with path.open("rb"):
                pass
            info = soundfile.info(str(path))
        except OSError as error:
            raise InputError(f"{path}: cannot read the recording: {error.strerror}") from None
        except soundfile.LibsndfileError as error:
            raise InputError(f"{path}: not a sound file that can be read: {error.error_string}") from None
        except TypeError:  # soundfile asks for the rate and channels of a file named .raw
            raise InputError(f"{path}: raw samples without a header cannot be read: convert them to WAV") from None
        if info.frames == 0:
            raise InputError(f"{path}: the recording is empty (0 samples)")
        picked = tuple(range(info.channels)) if channels is None else tuple(channels)
        absent = [c + 1 for c in picked if not 0 <= c < info.channels]
        if absent:
            raise InputError(f"{path}: no channel {absent[0]}: the file has {info.channels}")
        if not picked:
            raise InputError(f"{path}: no channel is picked")
        return cls(path, info.samplerate, info.frames, picked, check_int(fs, "fs", low=1))

    @property
    def duration(self) -> float:
        """Length [s]."""
        return self.num_samples / self.file_rate

    @property
    def num_output_samples(self) -> int:
        """Samples per channel that `blocks` delivers in all."""
        return math.ceil(self.num_samples * self.fs / self.file_rate)

    def survey(self) -> ChannelSurvey:
        """Read the file once and say what each channel holds.

        Raises:
            NotFiniteError: naming the channel and time of the first NaN or infinite sample.
        """
        low = torch.full((len(self.channels),), math.inf)
        high, clipped, start = -low, torch.zeros_like(low), 0
        for block in self._raw_blocks(self.file_rate):
            smallest, largest = block.amin(1), block.amax(1)  # NaN where a channel has one
            if not (smallest.isfinite() & largest.isfinite()).all():
                sample, channel = (~block.isfinite()).t().nonzero()[0].tolist()
                raise NotFiniteError(
                    f"{self.path}: channel {self.channels[channel] + 1} has a NaN or infinite sample at "
                    f"{(start + sample) / self.file_rate:.3f} s"
                )
            low, high = torch.minimum(low, smallest), torch.maximum(high, largest)
            if max(-smallest.min(), largest.max()) >= _FULL_SCALE:
                clipped += (block.abs() >= _FULL_SCALE).sum(1)
            start += block.shape[1]
        return ChannelSurvey(low, high, clipped / self.num_samples)

    def blocks(self, seconds: float = 1.0) -> Iterator[Tensor]:
        """Yield consecutive blocks (C, n) of about `seconds` at rate `fs`, in constant memory.

        The blocks joined are the resampled file, whatever their length.
        """
        raw = self._raw_blocks(max(1, round(seconds * self.file_rate)))
        return raw if self.fs == self.file_rate else resampled(raw, self.file_rate, self.fs)

    def read(self) -> Tensor:
        """Return the whole recording at rate `fs`, (C, num_output_samples)."""
        return torch.cat(list(self.blocks(10.0)), 1)

    def _raw_blocks(self, length: int) -> Iterator[Tensor]:
        done = 0
        try:
            with soundfile.SoundFile(str(self.path)) as file:
                while done < self.num_samples:
                    # not file.blocks: where a file ends early, it repeats old samples
                    block = file.read(min(length, self.num_samples - done), dtype="float32", always_2d=True)
                    if len(block) == 0:
                        break
                    done += len(block)
                    yield torch.from_numpy(block.T[list(self.channels)].copy())
        except (OSError, soundfile.LibsndfileError) as error:
            raise InputError(f"{self.path}: reading failed part-way: {error}") from None
        if done < self.num_samples:
            raise InputError(
                f"{self.path}: the recording ends after {done / self.file_rate:.3f} s of the {self.duration:.3f} s "
                "that its header promises"
            )


def resampled(blocks: Iterator[Tensor], rate: int, fs: int) -> Iterator[Tensor]:
    """Resample consecutive `blocks` (C, n) from `rate` to `fs` [Hz] as if they were one signal.

    Each block is resampled with enough of its neighbours on both sides for the filter of
    `torchaudio.transforms.Resample`, on input samples that fall on the grid of the output.
    """
    divisor = math.gcd(rate, fs)
    step, step_out = rate // divisor, fs // divisor
    resample = Resample(rate, fs)
    # torchaudio's kernel reaches lowpass_filter_width / rolloff cycles of the lower of the two rates
    reach = math.ceil(resample.lowpass_filter_width * step / (min(step, step_out) * resample.rolloff))
    context = math.ceil(reach / step) * step
    buffer, seen = None, 0  # input kept: at most `context` samples before what is still to be delivered
    for block in blocks:
        buffer = block if buffer is None else torch.cat([buffer, block], 1)
        ready = (buffer.shape[1] - seen - context) // step * step
        if ready > 0:
            yield _between(resample(buffer[:, : seen + ready + context]), seen, ready, step, step_out)
            drop = max(0, seen + ready - context)
            buffer, seen = buffer[:, drop:], seen + ready - drop
    if buffer is not None and buffer.shape[1] > seen:
        yield resample(buffer)[:, seen // step * step_out :]


def _between(output: Tensor, start: int, count: int, step: int, step_out: int) -> Tensor:
    first = start // step * step_out
    return output[:, first : first + count // step * step_out]
