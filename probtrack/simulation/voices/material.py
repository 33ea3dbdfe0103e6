"""Speech of real talkers, ready to be cut: found in a folder, decoded, levelled and freed of its pauses."""

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import soundfile
import torch
import torchaudio.functional as F
from torch import Tensor
from torch.nn.functional import pad

from probtrack.errors import InputError
from probtrack.simulation.voices.activity import speech_activity
from probtrack.simulation.voices.base import at_level

SUFFIXES = frozenset(
    [".wav", ".flac", ".ogg", ".oga", ".opus", ".mp3", ".aiff", ".aif", ".au", ".caf", ".w64", ".rf64", ".sph"]
)

_MARGIN = 0.04  # s around what is found to be speech, for soft onsets and ends
_SHORTEST = 0.1  # s; shorter sounds are clicks


def find_talkers(folder: str) -> dict[str, Path]:
    """Return the audio file, or the folder of them, of each talker by name.

    A file is one talker. In a folder each audio file is a talker, or if there is none each folder.
    """
    root = Path(folder)
    if root.is_file():
        return {root.stem: root}
    if not root.is_dir():
        raise InputError(f"{folder}: no such file or folder of speech")
    entries = sorted(entry for entry in root.iterdir() if not entry.name.startswith("."))
    audio = [entry for entry in entries if _is_audio(entry)]
    files = {entry.stem: entry for entry in audio}
    if len(files) < len(audio):
        raise InputError(f"{folder}: audio files must differ in more than their suffix")
    talkers = files or {entry.name: entry for entry in entries if entry.is_dir()}
    if not talkers:
        raise InputError(f"{folder}: holds no audio files and no folders of talkers")
    return talkers


def talker_files(place: Path) -> list[Path]:
    """Return the audio files of a talker, in order of their names; those in folders of the folder too."""
    files = [place] if place.is_file() else sorted(file for file in place.rglob("*") if _is_audio(file))
    if not files:
        raise InputError(f"{place}: holds no audio files")
    return files


def read_mono(path: str | Path, fs: int) -> Tensor:
    """Return a recording (S,) at `fs` [Hz], channels averaged, without what is below 60 Hz.

    Raises:
        InputError: for a file that cannot be read, holds no sound, or NaN.
    """
    try:
        content, rate = soundfile.read(str(path), dtype="float64", always_2d=True)
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: cannot read speech: {' '.join(str(error).split())}") from None
    mono = torch.from_numpy(content).mean(-1)
    if not mono.isfinite().all():
        raise InputError(f"{path}: samples must be finite, got NaN or infinity")
    if not (mono.numel() and mono.abs().max() > 0):
        raise InputError(f"{path}: holds no sound")
    heard: Tensor = F.highpass_biquad(F.resample(mono, rate, fs), fs, 60.0)
    return heard


def stretches(path: Path, fs: int) -> tuple[Tensor, ...]:
    """Return what is said between the pauses of a recording, (S,) each, at the level of synthetic voices.

    Decoded once a process: the tensors are shared and must not be written to.
    """
    try:
        changed = path.stat().st_mtime_ns
    except OSError as error:
        raise InputError(f"{path}: cannot read speech: {error.strerror}") from None
    return _stretches(path, changed, fs)


@lru_cache(maxsize=256)
def _stretches(path: Path, changed: int, fs: int) -> tuple[Tensor, ...]:  # noqa: ARG001 (a new file is a new key)
    samples = read_mono(path, fs)
    active = speech_activity(samples, fs)
    samples = at_level(samples, active).float()
    margin = round(_MARGIN * fs)
    pieces = [samples[max(first - margin, 0) : last + margin] for first, last in _runs(active)]
    kept = tuple(piece.clone() for piece in pieces if len(piece) >= _SHORTEST * fs)
    if not kept:
        raise InputError(f"{path}: must hold at least {_SHORTEST} s of speech, got {len(samples) / fs:.3g} s of sound")
    return kept


def _runs(active: Tensor) -> Iterator[tuple[int, int]]:
    """Return start and end of each run of True."""
    edges = pad(active.int(), (1, 1)).diff().nonzero()[:, 0]
    return zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


def _is_audio(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and path.is_file() and not path.name.startswith(".")
