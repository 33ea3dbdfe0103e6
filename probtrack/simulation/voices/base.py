"""The one interface of everything that talks, and the sound and truth that it gives."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from probtrack._checks import as_positive, check_int
from probtrack.errors import InputError

LEVEL = 0.07
"""Root mean square of the speech where it is active, full scale being 1."""


class VoiceScore(NamedTuple):
    """What a synthetic voice does, one setting about every 5 ms: the truth for formant, pitch and vowel estimators.

    Between two settings all values go along straight lines. Where nothing is said they are 0.

    Attributes:
        time: (K,) [s].
        f0: (K,), fundamental frequency [Hz], 0 where the voice is silent.
        formants: (K, 3), F1 to F3 [Hz].
        bandwidths: (K, 3), of F1 to F3 [Hz].
        voicing: (K,), amplitude of the voice [-], 0 in pauses and voiceless consonants, 1 in a stressed vowel.
        vowel: (K,) integer, place in `VOWELS` while the formants rest on that vowel's, elsewhere -1.
    """

    time: Tensor
    f0: Tensor
    formants: Tensor
    bandwidths: Tensor
    voicing: Tensor
    vowel: Tensor


class Speech(NamedTuple):
    """Sound of one talker and the truth of when it speaks.

    Attributes:
        samples: (S,), root mean square `LEVEL` where active; full scale is 1.
        active: (S,) bool, True from the start to the end of each utterance.
        score: What a synthetic voice did; None of a recorded one.
    """

    samples: Tensor
    active: Tensor
    score: VoiceScore | None = None


class Voices(ABC):
    """Who the talkers are and what they say. A subclass is a frozen dataclass of plain values."""

    @abstractmethod
    def speak(
        self, turns: Sequence[Sequence[tuple[float, float]]], *, duration: float, fs: int, seed: int
    ) -> list[Speech]:
        """Return the speech of `len(turns)` talkers, each `round(duration * fs)` samples.

        Args:
            turns: Start and end [s] of every utterance of every talker, as `Turns.draw` gives them.
            duration: [s].
            fs: Sampling rate [Hz], at least 8000.
            seed: Of who speaks and what. What a talker says does not depend on how many others there are.

        Raises:
            InputError: for utterances out of order or outside the duration, and for too few talkers.
        """


def sample_spans(
    turns: Sequence[Sequence[tuple[float, float]]], duration: float, fs: int
) -> list[list[tuple[int, int]]]:
    """Return first and last sample (exclusive) of each utterance, or raise `InputError` if `turns` cannot be."""
    as_positive(duration, "duration")
    check_int(fs, "fs", low=8000)
    for talker, utterances in enumerate(turns):
        before = 0.0
        for start, end in utterances:
            if not before <= start < end <= duration:
                raise InputError(
                    f"turns of talker {talker} must be in order and within {duration} s, got ({start}, {end})"
                )
            before = end
    return [[_span(start, end, fs) for start, end in utterances] for utterances in turns]


def talker_generators(seed: int, num_talkers: int) -> list[torch.Generator]:
    """Return a random generator for each talker, the same for the first ones however many there are."""
    source = torch.Generator().manual_seed(check_int(seed, "seed", low=0))
    seeds = [int(torch.randint(2**62, (), generator=source)) for _ in range(num_talkers)]
    return [torch.Generator().manual_seed(seed) for seed in seeds]


def at_level(samples: Tensor, active: Tensor) -> Tensor:
    """Scale to a root mean square of `LEVEL` where `active`; silence stays silence.

    The level is exact, and so are ratios between talkers: of real speech a rare pop may pass full scale.
    """
    power = float(samples[active].square().mean()) if active.any() else 0.0
    if power > 0:
        samples = samples * (LEVEL / math.sqrt(power))
    return samples.to(torch.get_default_dtype())


def _span(start: float, end: float, fs: int) -> tuple[int, int]:
    first, last = round(start * fs), round(end * fs)
    if first == last:
        raise InputError(f"turns must be utterances of at least one sample, got ({start}, {end})")
    return first, last
