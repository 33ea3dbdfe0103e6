"""What a synthetic voice says: syllables of a consonant and a vowel, drawn at random."""

from typing import NamedTuple

import torch
from torch import Tensor

from probtrack.simulation.interpolation import interpolate
from probtrack.simulation.voices.phonemes import CONTINUANTS, PLOSIVES, VOWELS, Consonant

_FIRST, _ALL = tuple(CONTINUANTS.values()), (*CONTINUANTS.values(), *PLOSIVES.values())
_VOWELS = tuple(VOWELS.values())
_USUAL = 0.19  # s; in syllables shorter than this all times shrink


class Articulation(NamedTuple):
    """Settings of the mouth (K,) or (K, 3): amplitudes [-], then frequencies of noise and formants [Hz].

    `stress` is 0.7 to 1; `vowel` the place in `VOWELS` where the formants rest on one, else -1.
    """

    voicing: Tensor
    friction: Tensor
    aspiration: Tensor
    stress: Tensor
    centre: Tensor
    width: Tensor
    formants: Tensor
    bandwidths: Tensor
    vowel: Tensor


_Knot = tuple[float, ...]  # time, then the columns of `Articulation` without the vowel


def utterance(start: float, end: float, at: Tensor, rate: float, generator: torch.Generator) -> Articulation:
    """Draw syllables that fill an utterance from `start` to `end` [s], about `rate` a second.

    Args:
        start: [s].
        end: [s].
        at: Times of the settings to return, (K,) [s].
        rate: Syllables a second.
        generator: Draws length, consonant, vowel and stress of each.
    """
    count = max(1, round((end - start) * rate))
    draws = torch.rand(count, 4, generator=generator, dtype=torch.float64)
    lengths = 0.76 + 0.48 * draws[:, 0]
    ends = start + (end - start) * lengths.cumsum(0) / lengths.sum()
    begin, knots = start, list[_Knot]()
    vowel = torch.full(at.shape, -1)
    for last, (_, consonant, nucleus, stress) in zip(ends.tolist(), draws.tolist(), strict=True):
        choices = _ALL if knots else _FIRST
        index = int(nucleus * len(_VOWELS))
        syllable = _syllable(
            begin, last - begin, choices[int(consonant * len(choices))], _VOWELS[index], 0.7 + 0.3 * stress
        )
        knots += syllable
        vowel[(at >= syllable[-2][0]) & (at <= syllable[-1][0])] = index
        begin = last
    silent = (0.0, 0.0, 0.0)
    table = torch.tensor([(start, *silent, *knots[0][4:]), *knots, (end, *silent, *knots[-1][4:])], dtype=torch.float64)
    values = interpolate(at, table[:, 0].contiguous(), table[:, 1:])
    voicing, friction, aspiration, stress, centre, width = values[:, :6].unbind(-1)
    return Articulation(voicing, friction, aspiration, stress, centre, width, values[:, 6:9], values[:, 9:], vowel)


def _syllable(
    start: float, length: float, consonant: Consonant, vowel: tuple[tuple[float, ...], tuple[float, ...]], stress: float
) -> list[_Knot]:
    """Return settings that straight lines join; between the last two the formants rest on those of the vowel."""
    formants, widths = vowel
    scale = min(1.0, length / _USUAL)
    onset = min(0.09 * scale, 0.4 * length)
    steady = max(onset + 0.05 * scale, 0.5 * length)
    middle = [(a + 2 * b) / 3 for a, b in zip(consonant.locus, formants, strict=True)]
    begin, late = 0.010 * scale, onset + 0.035 * scale  # the voice after a breath sets in late
    noise = (stress, consonant.centre, consonant.width)

    def knot(time: float, amplitudes: tuple[float, float, float], target: list[float] | tuple[float, ...]) -> _Knot:
        return (start + time, *amplitudes, *noise, *target, *widths)

    held = (consonant.voicing, consonant.friction, 0.0)
    voiced = (0.8 * stress, 0.0, 0.0)
    release = (
        [knot(onset + 0.010 * scale, (0.0, 0.0, consonant.aspiration), consonant.locus), knot(late, voiced, middle)]
        if consonant.aspiration
        else [knot(onset + 0.020 * scale, voiced, middle)]
    )
    return [
        knot(begin, held, consonant.locus),
        knot(onset - 0.015 * scale, held, consonant.locus),
        knot(onset - 0.005 * scale, (consonant.voicing, consonant.burst, 0.0), consonant.locus),
        *release,
        knot(steady, (stress, 0.0, 0.0), formants),
        knot(0.87 * length, (0.8 * stress, 0.0, 0.0), formants),
    ]
