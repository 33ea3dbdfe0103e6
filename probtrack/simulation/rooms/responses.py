"""Measured impulse responses: read from a folder of audio files, checked, resampled."""

import csv
import math
import re
from pathlib import Path
from typing import NamedTuple

import soundfile
import torch
from torch import Tensor

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray
from probtrack.simulation.rooms.switching import fast_size

_LEAD = 64  # samples before time zero that a resampled response is given at least: it rings before the direct sound
_FLAT = 0.95  # of the band that resampling keeps as it is
_ONSET = 0.3  # of the peak of a response, where it is taken to begin
_CONTRADICTION = -0.5  # correlation of arrival times with distances, from which on something is mirrored


class Responses(NamedTuple):
    """Impulse responses from K places to M microphones.

    Attributes:
        samples: (K, M, L), from the time of emission.
        positions: (K, 3), of the sources [m].
        microphones: (M, 3) [m].
        fs: Sampling rate [Hz].
    """

    samples: Tensor
    positions: Tensor
    microphones: Tensor
    fs: int

    def checked(self, name: str) -> "Responses":
        """Return the responses, or raise `InputError` where something is not finite, silent or does not fit."""
        count, channels, _ = self.samples.shape
        for what, places, number in (("source", self.positions, count), ("microphone", self.microphones, channels)):
            if places.shape != (number, 3) or not places.isfinite().all():
                raise InputError(
                    f"{name}: {what} positions must be finite, one for each of {number}, got {len(places)}"
                )
        if self.fs <= 0:
            raise InputError(f"{name}: sampling rate must be positive, got {self.fs}")
        if not self.samples.isfinite().all():
            raise InputError(f"{name}: responses must be finite, got NaN or infinite samples")
        silent = ~self.samples.any(-1)
        if silent.any():
            source, microphone = silent.nonzero()[0].tolist()
            raise InputError(f"{name}: the response from place {source + 1} to microphone {microphone + 1} is silent")
        if self._agreement() < _CONTRADICTION:
            raise InputError(
                f"{name}: responses contradict the positions: sound arrives first at the microphones that are farther "
                "away; are channels exchanged, or azimuths counted clockwise (clockwise: true)?"
            )
        return self

    def _agreement(self) -> float:
        """Return the correlation of when sound arrives at each microphone with how far away it is."""
        distance = torch.linalg.vector_norm(self.positions[:, None] - self.microphones, dim=-1)
        size = self.samples.abs()
        arrival = (size > _ONSET * size.amax(-1, keepdim=True)).double().argmax(-1).double()
        later, farther = (x - x.mean(-1, keepdim=True) for x in (arrival, distance))
        scale = (later.square().sum() * farther.square().sum()).sqrt()
        return float((later * farther).sum() / scale) if scale > 0 else 0.0


def load_folder(folder: Path, array: str | None, height: float) -> Responses:
    """Return the responses of a folder: one WAV file a source position, one channel a microphone.

    Args:
        folder: Holds the WAV files, which are sorted by the numbers in their names, one CSV file with a row for each of
            them (columns `x_m`, `y_m` and, if known, `z_m`), and `array.yaml` unless `array` is given.
        array: Array file; None for that in the folder.
        height: Of sources and microphones whose positions have two axes [m].
    """
    files = sorted(folder.glob("*.wav"), key=_numbers)
    if not files:
        raise InputError(f"{folder}: holds no WAV files")
    positions = _with_height(_source_positions(folder), height)
    if len(positions) != len(files):
        raise InputError(f"{folder}: there must be a position for each of {len(files)} WAV files, got {len(positions)}")
    microphones = MicrophoneArray.from_yaml(folder / "array.yaml" if array is None else array).positions
    samples, rates = zip(*(_read(file, len(microphones)) for file in files), strict=True)
    if len(set(rates)) > 1:
        raise InputError(f"{folder}: WAV files must have one sampling rate, got {sorted(set(rates))}")
    longest = max(x.shape[-1] for x in samples)
    padded = torch.stack([torch.nn.functional.pad(x, (0, longest - x.shape[-1])) for x in samples])
    return Responses(padded, positions, _with_height(microphones.double(), height), rates[0])


def resampled(response: Tensor, fs: int, to: int) -> Tensor:
    """Return a response (M, L) at the rate `to` [Hz], with `resampling_lead` samples before time zero.

    The response to the same signal stays the same: at a lower rate a response has fewer samples, and larger ones.
    """
    if fs == to:
        return response
    step, lead = math.gcd(fs, to), resampling_lead(to, fs)
    blocks = fast_size(math.ceil((lead + response.shape[-1] + lead) / (fs // step)))
    spectrum = torch.fft.rfft(torch.nn.functional.pad(response, (lead, 0)), blocks * (fs // step))
    kept = blocks * (min(fs, to) // step) // 2 + 1
    share = torch.linspace(0, 1, kept, dtype=torch.float64)  # of the common band; a sharp edge would ring for long
    edge = torch.cos(torch.pi / 2 * ((share - _FLAT) / (1 - _FLAT)).clamp(min=0)).square()
    # the transforms divide by their sizes, which undoes what fewer samples change
    changed: Tensor = torch.fft.irfft(spectrum[..., :kept] * edge.to(response), blocks * (to // step))
    return changed


def resampling_lead(fs: int, to: int) -> int:
    """Return the samples at the rate `to` [Hz] that a resampled response rings before time zero: a whole time at `fs`.

    >>> resampling_lead(48000, 16000), resampling_lead(16000, 48000), resampling_lead(16000, 16000)
    (64, 192, 0)
    """
    if fs == to:
        return 0
    step = math.gcd(fs, to)
    return math.ceil(_LEAD * step / min(fs, to)) * (to // step)


def _numbers(path: Path) -> tuple[list[int], str]:
    return [int(number) for number in re.findall(r"\d+", path.stem)], path.stem


def _source_positions(folder: Path) -> Tensor:
    tables = sorted(folder.glob("*.csv"))
    if len(tables) != 1:
        raise InputError(f"{folder}: must hold one CSV file of source positions, got {len(tables)}")
    try:
        with tables[0].open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        axes = ("x_m", "y_m", "z_m") if rows and "z_m" in rows[0] else ("x_m", "y_m")
        return torch.tensor([[float(row[axis]) for axis in axes] for row in rows], dtype=torch.float64)
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{tables[0]}: must have columns x_m, y_m and maybe z_m of numbers: {error}") from None


def _with_height(positions: Tensor, height: float) -> Tensor:
    if positions.shape[-1] == 3:
        return positions
    return torch.nn.functional.pad(positions, (0, 1), value=height)


def _read(path: Path, channels: int) -> tuple[Tensor, int]:
    try:
        content, rate = soundfile.read(str(path), dtype="float64", always_2d=True)
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: cannot read responses: {' '.join(str(error).split())}") from None
    if content.shape[1] != channels:
        raise InputError(f"{path}: must have a channel for each of {channels} microphones, got {content.shape[1]}")
    return torch.from_numpy(content).T.contiguous(), int(rate)
