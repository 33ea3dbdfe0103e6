"""What a talker says: a small synthetic voice, or a recording of the user's own."""

import math
from pathlib import Path
from typing import NamedTuple

import soundfile
import torch
import torchaudio.functional as F
from torch import Tensor

from probtrack.errors import InputError
from probtrack.simulation.interpolation import interpolate
from probtrack.simulation.vocal_tract import HOP, filter_frames, friction, glottal_pulses, vocal_tract

VOWELS: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "i": ((270, 2290, 3010), (80, 120, 300)),
    "I": ((390, 1990, 2550), (100, 120, 300)),
    "E": ((530, 1840, 2480), (120, 140, 300)),
    "@": ((660, 1720, 2410), (140, 200, 300)),
    "a": ((730, 1090, 2440), (160, 80, 300)),
    "c": ((570, 840, 2410), (120, 200, 240)),
    "U": ((440, 1020, 2240), (120, 200, 200)),
    "u": ((300, 870, 2240), (100, 140, 200)),
    "A": ((640, 1190, 2390), (140, 140, 300)),
    "R": ((490, 1350, 1690), (80, 120, 120)),
}
"""Formants F1 to F3 and their bandwidths [Hz] of a man's vowels: Klaassen 2005, Tables 3.1 and 3.2."""

LEVEL = 0.07
"""Root mean square of the speech where it is active, full scale being 1."""

_Consonant = tuple[float, float, float, float, tuple[float, float, float]]
_CONSONANTS: tuple[
    _Consonant, ...
] = (  # voicing, noise, centre and bandwidth of the noise [Hz], F1 to F3 towards which the vowel bends
    (0.0, 0.50, 5500.0, 2000.0, (320.0, 1700.0, 2600.0)),  # like s
    (0.0, 0.45, 3000.0, 1200.0, (320.0, 1800.0, 2500.0)),  # like sh
    (0.0, 0.12, 6500.0, 5000.0, (320.0, 1100.0, 2300.0)),  # like f
    (0.0, 0.00, 4000.0, 3000.0, (250.0, 1800.0, 2700.0)),  # like t: a closure, then a burst
    (0.0, 0.00, 1800.0, 1500.0, (250.0, 2000.0, 2300.0)),  # like k
    (0.3, 0.00, 4000.0, 3000.0, (280.0, 1600.0, 2600.0)),  # like n
    (0.3, 0.00, 4000.0, 3000.0, (280.0, 1000.0, 2300.0)),  # like m
    (0.5, 0.00, 4000.0, 3000.0, (350.0, 1200.0, 2700.0)),  # like l
)


_BURST = 0.6  # gain of the noise that ends the closure of a plosive
_BREATH = 0.03  # gain of the noise in the voice


class Speech(NamedTuple):
    """Sound of one talker and the truth of when it speaks.

    Attributes:
        samples: (S,), full scale 1.
        active: (S,) bool, True from the start to the end of each utterance.
    """

    samples: Tensor
    active: Tensor


def synthesise_speech(duration: float, fs: int = 16000, *, generator: torch.Generator, pitch: float = 115.0) -> Speech:
    """Return babble of a man's voice: utterances of 1.5 to 3 s between pauses of 0.7 to 1.1 s.

    Syllables of a consonant and a vowel, about four a second, follow each other at random: glottal pulses of
    falling pitch through formants that glide from target to target, and noise for fricatives and bursts. It
    says nothing, but has what trackers live on: harmonics, formants, onsets and pauses.

    Args:
        duration: Length [s].
        fs: Sampling rate [Hz], at least 8000.
        generator: Draws what is said; the same seed says the same.
        pitch: Mean fundamental frequency [Hz].
    """
    if not (math.isfinite(duration) and duration > 0):
        raise InputError(f"duration must be finite and positive, got {duration}")
    if fs < 8000:
        raise InputError(f"fs must be at least 8000 Hz, got {fs}")
    size = round(duration * fs)
    samples = torch.zeros(size, dtype=torch.float64)
    active = torch.zeros(size, dtype=torch.bool)
    for start, end in _utterances(duration, generator):
        first, last = round(start * fs), min(round(end * fs), size)
        score = _score(end - start, generator)
        samples[first:last] = _phonate(score, last - first, pitch, fs, generator)
        active[first:last] = True
    return Speech(_at_level(samples, active), active)


def sustained_vowel(vowel: str, duration: float, fs: int = 16000, *, pitch: float = 115.0) -> Tensor:
    """Return (S,) samples of one of `VOWELS` held at a constant pitch [Hz], without noise.

    >>> sustained_vowel("a", 0.1).shape
    torch.Size([1600])
    """
    if vowel not in VOWELS:
        raise InputError(f"vowel must be one of {', '.join(VOWELS)}, got {vowel}")
    size = round(duration * fs)
    count = math.ceil(size / round(HOP * fs)) + 1
    formants, bandwidths = (torch.tensor(x, dtype=torch.float64).expand(count, 3) for x in VOWELS[vowel])
    source = glottal_pulses(torch.full((size,), pitch, dtype=torch.float64), fs)
    samples = filter_frames(source, vocal_tract(formants, bandwidths, fs), fs)
    return _at_level(samples, torch.ones(size, dtype=torch.bool))


def load_speech(path: str | Path, fs: int, duration: float) -> Speech:
    """Return `duration` [s] of a recording at `fs` [Hz], from its start, and over again where it is shorter.

    Channels are averaged, what is below 60 Hz is removed, and the level is that of `synthesise_speech`.
    When it speaks is judged by its energy over its own noise floor: see `speech_activity`.

    Raises:
        InputError: for a file that cannot be read or holds no sound.
    """
    try:
        content, rate = soundfile.read(str(path), dtype="float64", always_2d=True)
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: cannot read speech: {' '.join(str(error).split())}") from None
    mono = torch.from_numpy(content).mean(-1)
    if not mono.isfinite().all() or not (mono.numel() and mono.abs().max() > 0):
        raise InputError(f"{path}: holds no sound")
    mono = F.highpass_biquad(F.resample(mono, rate, fs), fs, 60.0)
    size = round(duration * fs)
    samples = mono.repeat(math.ceil(size / len(mono)))[:size]
    active = speech_activity(samples, fs)
    return Speech(_at_level(samples, active), active)


def speech_activity(samples: Tensor, fs: int) -> Tensor:
    """Return when a clean recording (S,) of one voice speaks, (S,) bool, by its level in frames of 20 ms.

    The threshold stands a third of the way up from the noise floor (the level that 10 % of the frames stay
    below) to the level of speech (which 5 % exceed), in dB. Gaps shorter than 0.3 s belong to the speech.
    Where the two are less than 10 dB apart there are no pauses to be found, and all is speech.
    """
    frame = round(0.02 * fs)
    padded = torch.nn.functional.pad(samples, (0, -len(samples) % frame))
    level = 10 * torch.log10(padded.reshape(-1, frame).square().mean(-1) + 1e-10)
    floor, top = torch.quantile(level, 0.1), torch.quantile(level, 0.95)
    loud = (level > floor + (top - floor) / 3) | (top - floor < 10)
    gap = 15  # frames; a dilation followed by an erosion of the same width closes what is shorter
    wide = torch.nn.functional.max_pool1d(loud.double()[None], 2 * (gap // 2) + 1, 1, gap // 2)
    closed = -torch.nn.functional.max_pool1d(-wide, 2 * (gap // 2) + 1, 1, gap // 2)
    return closed[0].bool().repeat_interleave(frame)[: len(samples)]


def _utterances(duration: float, generator: torch.Generator) -> list[tuple[float, float]]:
    """Return start and end of each utterance [s]; the first starts after 0.25 s."""
    spans, start = [], 0.25
    while start < duration - 0.6:
        long, pause = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
        end = min(start + 1.5 + 1.5 * long**2, duration)
        spans.append((start, end))
        start = end + 0.7 + 0.4 * pause
    return spans or [(0.0, duration)]


def _score(duration: float, generator: torch.Generator) -> Tensor:
    """Draw syllables for `duration` [s]; returns (K, 11) settings every `HOP`, as `_syllable` has them."""
    settings, start = [], 0.0
    while start < duration - 0.12:
        u = torch.rand(4, generator=generator, dtype=torch.float64).tolist()
        length = 0.19 + 0.12 * u[0]
        if duration - start - length < 0.12:
            length = duration - start  # the last syllable is drawn out, or cut
        settings += _syllable(start, length, u[1], u[2], 0.7 + 0.3 * u[3])
        start += length
    settings.insert(0, (0.0, 0.0, 0.0, *settings[0][3:]))
    settings.append((duration, 0.0, 0.0, *settings[-1][3:]))
    knots = torch.tensor(settings, dtype=torch.float64)
    at = torch.arange(math.ceil(duration / HOP) + 1, dtype=torch.float64) * HOP
    return interpolate(at, knots[:, 0].contiguous(), knots[:, 1:])


def _syllable(start: float, length: float, consonant: float, vowel: float, stress: float) -> list[tuple[float, ...]]:
    """Return settings that straight lines join; `consonant` and `vowel` in [0, 1) choose one of each.

    Each is (time, voicing, noise, stress, centre and bandwidth of the noise, F1 to F3, B1 to B3).
    """
    voicing, noise, *hiss, locus = _CONSONANTS[int(consonant * len(_CONSONANTS))]
    formants, widths = list(VOWELS.values())[int(vowel * len(VOWELS))]
    burst = _BURST if voicing == noise == 0 else noise
    onset = min(0.09, 0.4 * length)
    middle = [(a + 2 * b) / 3 for a, b in zip(locus, formants, strict=True)]
    return [
        (start + 0.010, voicing, noise, stress, *hiss, *locus, *widths),
        (start + onset - 0.015, voicing, noise, stress, *hiss, *locus, *widths),
        (start + onset - 0.005, voicing, burst, stress, *hiss, *locus, *widths),
        (start + onset + 0.020, 0.8 * stress, 0.0, stress, *hiss, *middle, *widths),
        (start + 0.60 * length, stress, 0.0, stress, *hiss, *formants, *widths),
        (start + 0.85 * length, 0.8 * stress, 0.0, stress, *hiss, *formants, *widths),
    ]


def _phonate(score: Tensor, size: int, pitch: float, fs: int, generator: torch.Generator) -> Tensor:
    """Return (size,) samples of an utterance whose settings are `score` (K, 12)."""

    def draw(count: int) -> Tensor:
        return torch.randn(count, generator=generator, dtype=torch.float64)

    voicing, noise, stress, centre, spread = score[:, :5].unbind(-1)
    fall = torch.linspace(1.12, 0.86, len(score), dtype=torch.float64)
    jitter = 1 + 0.008 * draw(len(score))
    f0 = pitch * fall * jitter * (0.75 + 0.3 * stress)
    settings = torch.arange(len(score), dtype=torch.float64) * HOP
    at = torch.arange(size, dtype=torch.float64) / fs
    f0, voicing, noise = interpolate(at, settings, torch.stack([f0, voicing, noise], -1)).unbind(-1)
    breath = _BREATH * draw(size)
    voiced = filter_frames(
        (glottal_pulses(f0, fs) + breath) * voicing, vocal_tract(score[:, 5:8], score[:, 8:], fs), fs
    )
    return voiced + filter_frames(draw(size) * noise, friction(centre, spread, fs), fs)


def _at_level(samples: Tensor, active: Tensor) -> Tensor:
    """Scale to an active level of `LEVEL`, or less where a peak would otherwise pass 0.95."""
    scaled = samples * (LEVEL / samples[active].square().mean().sqrt())
    return (scaled * min(1.0, 0.95 / float(scaled.abs().max()))).to(torch.get_default_dtype())
