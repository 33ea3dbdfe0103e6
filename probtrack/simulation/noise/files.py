"""Recordings of noise: read, checked, and made long enough."""

import functools
import math
from pathlib import Path

import soundfile
import torch
import torchaudio.functional as F
from torch import Tensor

from probtrack.errors import InputError

_FADE = 0.05  # s; over which the end of a recording that is repeated fades into its start
_SHORTEST = 0.5  # s; sounds farther apart than that are taken for independent


def load_noise(path: str | Path, fs: int) -> Tensor:
    """Return a recording (C, L) at `fs` [Hz], float64.

    Raises:
        InputError: for a file that is missing, not sound, silent, not finite, or shorter than half a second.
    """
    try:
        changed = Path(path).stat().st_mtime_ns
    except OSError as error:
        raise InputError(f"{path}: cannot read noise: {error.strerror}") from None
    return _load(str(path), fs, changed)


def stretch(recording: Tensor, size: int, fs: int, generator: torch.Generator) -> Tensor:
    """Return `size` samples of a `recording` (C, L) from a random start.

    One shorter than twice that goes round, its end fading into its start: otherwise there would be few starts.
    """
    if recording.shape[-1] < 2 * size:
        return _around(_loop(recording, fs), size, 1, generator)[:, 0]
    start = _uniform(recording.shape[-1] - size + 1, generator)
    return recording[:, start : start + size]


def independent_stretches(recording: Tensor, size: int, fs: int, count: int, generator: torch.Generator) -> Tensor:
    """Return `count` stretches (count, size) of a `recording` (L,), at random but evenly spread over it.

    Where they do not fit side by side they overlap, each `L / count` later than the one before: what is heard in
    one is heard in the next too, but long after, so that they are as good as independent.

    Raises:
        InputError: where that is less than half a second.
    """
    if len(recording) < count * _SHORTEST * fs:
        raise InputError(
            f"noise must last at least {count * _SHORTEST:g} s to sound independent at {count} microphones, "
            f"got {len(recording) / fs:g} s"
        )
    return _around(_loop(recording[None], fs), size, count, generator)[0]


@functools.lru_cache(maxsize=2)  # a data set draws many stretches of one recording
def _load(path: str, fs: int, changed: int) -> Tensor:  # noqa: ARG001 - a file that has changed is read again
    try:
        content, rate = soundfile.read(path, dtype="float64", always_2d=True)
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: cannot read noise: {' '.join(str(error).split())}") from None
    samples = torch.from_numpy(content).T.contiguous()
    if not samples.isfinite().all():
        raise InputError(f"{path}: noise must be finite, got NaN or infinite samples")
    if not samples.any():
        raise InputError(f"{path}: noise must not be silent")
    if samples.shape[-1] < _SHORTEST * rate:
        raise InputError(f"{path}: noise must last at least {_SHORTEST:g} s, got {samples.shape[-1] / rate:g} s")
    resampled: Tensor = F.resample(samples, rate, fs)
    return resampled


def _loop(recording: Tensor, fs: int) -> Tensor:
    """Return the recording (C, L) without its end, which fades into its start at constant power."""
    fade = round(_FADE * fs)
    angle = (torch.arange(fade, dtype=recording.dtype) + 0.5) * (math.pi / 2 / fade)
    seam = recording[:, :fade] * angle.sin() + recording[:, -fade:] * angle.cos()
    return torch.cat([seam, recording[:, fade:-fade]], -1)


def _around(loop: Tensor, size: int, count: int, generator: torch.Generator) -> Tensor:
    """Return (C, count, size) of a loop (C, L), from starts evenly spread over it."""
    period = loop.shape[-1]
    first = _uniform(period, generator)
    starts = torch.tensor([first + k * period // count for k in range(count)])
    return loop[:, (starts[:, None] + torch.arange(size)) % period]


def _uniform(count: int, generator: torch.Generator) -> int:
    return int(torch.randint(count, (), generator=generator))
