"""Talkers from recordings of the user's own."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from probtrack.errors import InputError
from probtrack.simulation.voices.base import Speech, Voices, at_level, sample_spans, talker_generators
from probtrack.simulation.voices.material import find_talkers, talker_files
from probtrack.simulation.voices.reel import Reel


@dataclass(frozen=True)
class RecordedVoices(Voices):
    """Real speech that keeps to given turns.

    Each talker's files come in an order drawn from the seed, without their pauses longer than 0.3 s, and fill
    one utterance after the other; when all has been said it begins again. An utterance ends up to 0.2 s early
    or late, where the talker is quiet, but not after the next one of any talker begins. What is below 60 Hz is
    removed, and the level where it is active is that of synthetic voices (as ITU-T P.56 has it: over speech
    alone).

    Args:
        folder: A folder with one folder of audio files a talker, or with one audio file a talker, or one file.
        talkers: Names (of folders, or of files without their suffix) of those to speak, in order; None draws
            different ones from the seed.
    """

    folder: str
    talkers: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if self.talkers is not None and len(set(self.talkers)) < len(self.talkers):
            raise InputError(f"talkers must be different names, got {', '.join(self.talkers)}")

    def speak(
        self, turns: Sequence[Sequence[tuple[float, float]]], *, duration: float, fs: int, seed: int
    ) -> list[Speech]:
        spans, generators = sample_spans(turns, duration, fs), talker_generators(seed, len(turns))
        size = round(duration * fs)
        starts = torch.tensor([*sorted(first for talker in spans for first, _ in talker), size])
        places = self._places(len(turns), seed)
        return [
            _fill(Reel(talker_files(place), fs, generator), utterances, starts, size)
            for place, generator, utterances in zip(places, generators, spans, strict=True)
        ]

    def _places(self, count: int, seed: int) -> list[Path]:
        """Return the folder or file of each talker."""
        found = find_talkers(self.folder)
        unknown = [name for name in self.talkers or () if name not in found]
        if unknown:
            raise InputError(f"{self.folder}: has no talker {unknown[0]!r}")
        if self.talkers is None:
            order = torch.randperm(len(found), generator=torch.Generator().manual_seed(seed)).tolist()
            names = [list(found)[i] for i in order]
        else:
            names = list(self.talkers)
        if len(names) < count:
            raise InputError(f"{self.folder}: {count} talkers are to speak, got {len(names)}")
        return [found[name] for name in names[:count]]


def _fill(reel: Reel, utterances: list[tuple[int, int]], starts: torch.Tensor, size: int) -> Speech:
    """Return `size` samples in which `reel` speaks about from the first to the last sample of each utterance."""
    samples, active = torch.zeros(size, dtype=torch.float64), torch.zeros(size, dtype=torch.bool)
    for first, last in utterances:
        limit = int(starts[torch.searchsorted(starts, last)])
        sound = reel.cut(last - first, limit - first)
        samples[first : first + len(sound)] = sound
        active[first : first + len(sound)] = True
    return Speech(at_level(samples, active), active)
