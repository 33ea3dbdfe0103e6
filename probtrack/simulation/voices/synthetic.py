"""Talkers made by a computer: every formant, pitch and pause of theirs is known."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from probtrack._checks import as_non_negative
from probtrack.errors import InputError
from probtrack.simulation.interpolation import interpolate
from probtrack.simulation.voices.base import Speech, Voices, VoiceScore, at_level, sample_spans, talker_generators
from probtrack.simulation.voices.phonemes import VOWELS
from probtrack.simulation.voices.syllables import Articulation, utterance
from probtrack.simulation.voices.vocal_tract import HOP, filter_frames, friction, glottal_pulses, vocal_tract

_RATE = 16000  # Hz, at which the amplitude of breath is given


@dataclass(frozen=True)
class SyntheticVoice:
    """One talker: a glottis, a vocal tract and a manner of speaking.

    Args:
        pitch: Mean fundamental frequency [Hz], 40 to 600.
        pitch_range: Fall of the pitch from the beginning to the end of an utterance [semitones], 0 to 24.
            Stress moves it by up to a quarter of that, up or down.
        formant_scale: Formants over those of a man in `VOWELS`, 0.7 to 1.6: about 1.17 of a woman and 1.3 of a
            child, whose vocal tracts are shorter by as much.
        jitter: Standard deviation of the pitch from one 5 ms to the next, over the pitch, 0 to 0.05.
        breath: Noise in the voice, over the pulses of the glottis [-].
        rate: Syllables a second, 1 to 10.
    """

    pitch: float = 115.0
    pitch_range: float = 4.5
    formant_scale: float = 1.0
    jitter: float = 0.008
    breath: float = 0.03
    rate: float = 4.0

    def __post_init__(self) -> None:
        bounds = {"pitch": (40, 600), "pitch_range": (0, 24), "formant_scale": (0.7, 1.6), "jitter": (0, 0.05)}
        for name, (low, high) in (bounds | {"rate": (1, 10)}).items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"{name} must be between {low} and {high}, got {value}")
        as_non_negative(self.breath, "breath")

    @staticmethod
    def draw(generator: torch.Generator) -> "SyntheticVoice":
        """Draw a man or a woman, as likely: pitch about 120 or 210 Hz, formants times about 1 or 1.16."""
        woman, high, long, breath, rate = torch.rand(5, generator=generator, dtype=torch.float64).tolist()
        pitch, scale = (210.0, 1.16) if woman < 0.5 else (120.0, 1.0)
        return SyntheticVoice(
            pitch=pitch * 1.25 ** (2 * high - 1),
            formant_scale=scale * 1.06 ** (2 * long - 1),
            breath=0.02 + 0.03 * breath,
            rate=3.5 + rate,
        )


@dataclass(frozen=True)
class SyntheticVoices(Voices):
    """Babble of syllables, about four a second: glottal pulses through formants that glide, noise and bursts.

    It says nothing, but has what trackers live on: harmonics, formants, onsets and pauses; and its `VoiceScore`
    is known.

    Args:
        talkers: Voice of each talker; None draws men and women from the seed.
    """

    talkers: tuple[SyntheticVoice, ...] | None = None

    def speak(
        self, turns: Sequence[Sequence[tuple[float, float]]], *, duration: float, fs: int, seed: int
    ) -> list[Speech]:
        spans = sample_spans(turns, duration, fs)
        if self.talkers is not None and len(self.talkers) < len(turns):
            raise InputError(
                f"talkers must be at least as many as the turns are for, {len(turns)}, got {len(self.talkers)}"
            )
        spoken = []
        for talker, generator in enumerate(talker_generators(seed, len(turns))):
            voice = SyntheticVoice.draw(generator) if self.talkers is None else self.talkers[talker]
            spoken.append(_monologue(voice, turns[talker], spans[talker], duration, fs, generator))
        return spoken


def sustained_vowel(
    vowel: str, duration: float, fs: int = 16000, *, pitch: float = 115.0, formant_scale: float = 1.0
) -> Tensor:
    """Return (S,) samples of one of `VOWELS` held at a constant pitch [Hz], without noise.

    >>> sustained_vowel("a", 0.1).shape
    torch.Size([1600])
    """
    if vowel not in VOWELS:
        raise InputError(f"vowel must be one of {', '.join(VOWELS)}, got {vowel}")
    size = round(duration * fs)
    count = math.ceil(size / round(HOP * fs)) + 1
    formants, bandwidths = (torch.tensor(x, dtype=torch.float64).expand(1, 3) for x in VOWELS[vowel])
    throat = vocal_tract(formants * formant_scale, bandwidths, fs, formant_scale)
    source = glottal_pulses(torch.full((size,), pitch, dtype=torch.float64), fs)
    return at_level(filter_frames(source, count, lambda _: throat, fs), torch.ones(size, dtype=torch.bool))


def _monologue(
    voice: SyntheticVoice,
    utterances: Sequence[tuple[float, float]],
    spans: Sequence[tuple[int, int]],
    duration: float,
    fs: int,
    generator: torch.Generator,
) -> Speech:
    """Return what one talker says, utterance by utterance.

    Noise has a generator of its own: how much of it is drawn depends on `fs`, what is said does not.
    """
    size, hop = round(duration * fs), round(HOP * fs)
    samples, active = torch.zeros(size, dtype=torch.float64), torch.zeros(size, dtype=torch.bool)
    time = torch.arange(math.ceil(size / hop) + 1, dtype=torch.float64) * hop / fs
    score = _silent_score(time)
    noise = torch.Generator().manual_seed(int(torch.randint(2**62, (), generator=generator)))
    for (start, end), (first, last) in zip(utterances, spans, strict=True):
        low, high = first // hop, -(-last // hop) + 1
        at, place = time[low:high], torch.arange(low, high) * hop
        mouth = utterance(start, end, at, voice.rate, generator)
        mouth = mouth._replace(formants=mouth.formants * voice.formant_scale)
        f0 = _melody(voice, mouth.stress, (at - start) / (end - start), noise)
        sound = _phonate(voice, mouth, f0, fs, noise)
        samples[first:last] = sound[first - low * hop :][: last - first]
        active[first:last] = True
        _write(score, slice(low, high), mouth, f0, (place >= first) & (place <= last))
    return Speech(at_level(samples, active), active, score)


def _melody(voice: SyntheticVoice, stress: Tensor, progress: Tensor, generator: torch.Generator) -> Tensor:
    """Return the fundamental frequency (K,) [Hz]: it falls, rises with stress, and trembles."""
    semitones = voice.pitch_range * (0.5 - progress + (stress - 0.85) / 0.6)
    tremble = torch.randn(len(stress), generator=generator, dtype=torch.float64).clamp(-3, 3)
    return voice.pitch * 2 ** (semitones / 12) * (1 + voice.jitter * tremble)


def _phonate(voice: SyntheticVoice, mouth: Articulation, f0: Tensor, fs: int, generator: torch.Generator) -> Tensor:
    """Return the sound between the first and the last of K settings, (K - 1) * hop samples."""
    hop = round(HOP * fs)
    size = (len(f0) - 1) * hop

    def noise() -> Tensor:
        return torch.randn(size, generator=generator, dtype=torch.float64)

    settings = torch.stack([f0, mouth.voicing, mouth.friction, mouth.aspiration], -1)
    at = torch.arange(size, dtype=torch.float64) / hop
    pitch, voicing, hiss, breath = interpolate(at, torch.arange(len(f0)).double(), settings).unbind(-1)
    breath = (breath + voice.breath * voicing) * math.sqrt(fs / _RATE)  # the same density at any rate
    source = glottal_pulses(pitch, fs) * voicing + noise() * breath

    def throat(rows: slice) -> Tensor:
        return vocal_tract(mouth.formants[rows], mouth.bandwidths[rows], fs, voice.formant_scale)

    def lips(rows: slice) -> Tensor:
        return friction(mouth.centre[rows], mouth.width[rows], fs)

    return filter_frames(source, len(f0), throat, fs) + filter_frames(noise() * hiss, len(f0), lips, fs)


def _silent_score(time: Tensor) -> VoiceScore:
    count = len(time)
    zero, zeros = torch.zeros(count, dtype=time.dtype), torch.zeros(count, 3, dtype=time.dtype)
    return VoiceScore(time, zero, zeros, zeros.clone(), zero.clone(), torch.full((count,), -1))


def _write(score: VoiceScore, rows: slice, mouth: Articulation, f0: Tensor, said: Tensor) -> None:
    """Fill the rows of `score` that lie inside an utterance."""
    score.f0[rows][said] = torch.where(mouth.voicing > 0, f0, 0)[said]
    score.formants[rows][said] = mouth.formants[said]
    score.bandwidths[rows][said] = mouth.bandwidths[said]
    score.voicing[rows][said] = mouth.voicing[said]
    score.vowel[rows][said] = mouth.vowel[said]
