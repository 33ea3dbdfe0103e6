"""The score of a synthetic voice is the truth: formants, pitch and activity measured in running speech."""

from functools import lru_cache

import numpy as np
import pytest
import torch
from scipy.linalg import solve_toeplitz

from probtrack.simulation.voices import VOWELS, SyntheticVoice, SyntheticVoices

FS = 16000


@lru_cache
def talk(pitch=115.0, formant_scale=1.0, seconds=12.0, fs=FS, seed=2):
    voices = SyntheticVoices((SyntheticVoice(pitch=pitch, formant_scale=formant_scale),))
    return voices.speak([[(0.2, 0.45 * seconds), (0.55 * seconds, seconds - 0.3)]], duration=seconds, fs=fs, seed=seed)[
        0
    ]


def steady(score, reach=4):
    """Settings in the midst of `2 reach + 1` whose formants rest on one vowel."""
    vowel = score.vowel.unfold(0, 2 * reach + 1, 1)
    return (reach + ((vowel >= 0) & (vowel == vowel[:, :1])).all(-1).nonzero()[:, 0]).tolist()


def formants(x, order=18, count=3):
    """Oracle: the lowest resonances [Hz] by linear prediction (autocorrelation method)."""
    x = np.append(0, x[1:] - 0.97 * x[:-1]) * np.hamming(len(x))
    r = np.correlate(x, x, "full")[len(x) - 1 :][: order + 1]
    roots = np.roots(np.append(1, -solve_toeplitz(r[:-1], r[1:])))
    frequency, width = np.angle(roots) * FS / (2 * np.pi), -np.log(np.abs(roots)) * FS / np.pi
    return np.sort(frequency[(frequency > 150) & (width < 700)])[:count]


def pitch(x, low, high):
    """Oracle: the fundamental frequency between two bounds [Hz] by autocorrelation."""
    r = np.correlate(x, x, "full")[len(x) - 1 :] / np.arange(len(x), 0, -1)
    peak = round(FS / high) + int(np.argmax(r[round(FS / high) : round(FS / low)]))
    left, top, right = r[peak - 1 : peak + 2]
    return FS / (peak + (left - right) / (2 * (left - 2 * top + right)))


@pytest.mark.parametrize(("f0", "scale"), [(90.0, 1.0), (115.0, 1.0), (120.0, 1.17)])
def test_formants_are_those_of_the_score(f0, scale):
    speech = talk(f0, scale)
    x, score = speech.samples.numpy(), speech.score
    at = steady(score)[::3]
    measured = np.stack([formants(x[80 * k - 320 : 80 * k + 320]) for k in at])
    error = np.abs(measured / score.formants[at].numpy() - 1)
    assert len(at) > 50
    # the slope of the glottal spectrum draws the lowest resonance down
    np.testing.assert_array_less(np.median(error, 0), [0.06, 0.015, 0.01])


@pytest.mark.parametrize("f0", [90.0, 115.0, 160.0])
def test_pitch_is_that_of_the_score(f0):
    speech = talk(f0)
    x, score = speech.samples.numpy(), speech.score
    at = steady(score)[::3]
    measured = np.array([pitch(x[80 * k - 400 : 80 * k + 400], 0.7 * f0, 1.4 * f0) for k in at])
    truth = score.f0.unfold(0, 9, 1).mean(-1)[np.array(at) - 4].numpy()
    assert np.quantile(np.abs(measured / truth - 1), 0.9) < 0.02


def test_pitch_falls_over_an_utterance_and_its_mean_is_the_pitch():
    score = talk(115.0, seconds=20.0).score
    voiced = score.f0 > 0
    time = score.time[voiced].numpy()
    progress = np.where(time < 9.5, (time - 0.2) / 8.8, (time - 11.0) / 8.7)
    slope, _ = np.polyfit(progress, 12 * np.log2(score.f0[voiced].numpy()), 1)
    assert score.f0[voiced].mean() == pytest.approx(115.0, rel=0.02)
    assert slope == pytest.approx(-4.5, abs=0.8)


def test_jitter_is_the_spread_of_the_pitch():
    score = (
        SyntheticVoices((SyntheticVoice(jitter=0.02),)).speak([[(0.0, 20.0)]], duration=20.0, fs=FS, seed=0)[0].score
    )
    at = torch.tensor(steady(score, 2))
    curve = score.f0.log()
    bend = (curve[at + 1] - 2 * curve[at] + curve[at - 1]) / 6**0.5
    assert bend.std() == pytest.approx(0.02, rel=0.15)


@pytest.mark.parametrize("scale", [1.0, 1.25])
def test_a_vowel_of_the_score_has_the_formants_of_the_table(scale):
    score = talk(formant_scale=scale).score
    said = score.vowel >= 0
    table = torch.tensor(list(VOWELS.values()), dtype=torch.float64)[score.vowel[said]]
    torch.testing.assert_close(score.formants[said], scale * table[:, 0])
    torch.testing.assert_close(score.bandwidths[said], table[:, 1])
    assert (score.voicing[said] > 0.5).all()
    assert len(score.vowel[said].unique()) == len(VOWELS)


def test_score_is_empty_where_nothing_is_said():
    speech = talk(seconds=6.0)
    score, size = speech.score, len(speech.samples)
    spoken = speech.active[(score.time * FS).round().long().clamp(max=size - 1)]
    silent = ~spoken & ~spoken.roll(1)  # the end of an utterance is a setting of it
    for column in (score.f0, score.voicing, *score.formants.T, *score.bandwidths.T):
        assert column[silent].abs().max() == 0
    assert (score.vowel[silent] == -1).all()
    assert (score.formants[spoken] > 0).all()
    assert ((score.f0 > 0) == (score.voicing > 0)).all()


@pytest.mark.parametrize("fs", [16000, 44100])
def test_settings_are_five_milliseconds_apart_up_to_the_end(fs):
    speech = talk(seconds=4.0, fs=fs)
    time = speech.score.time
    torch.testing.assert_close(time.diff(), torch.full((len(time) - 1,), 0.005), rtol=0, atol=0.51 / fs)
    assert 4.0 <= time[-1] < 4.005 + 1e-9


def test_voicing_is_where_the_sound_is_periodic():
    speech = talk(100.0)
    frames = speech.samples.unfold(0, 640, 80)
    power = frames.square().sum(-1)
    correlation = torch.fft.irfft(torch.fft.rfft(frames, 1280).abs().square())[:, 100:250]
    periodic = correlation.amax(-1) / power.clamp_min(1e-12) * 640 / (640 - 160)
    voicing = speech.score.voicing.unfold(0, 9, 1)[: len(frames)]
    voiced, noisy = voicing.amin(-1) > 0.5, (power > 1e-3 * power.max()) & (voicing.amax(-1) == 0)
    assert noisy.sum() > 20
    assert periodic[voiced].quantile(0.05) > 0.7
    assert periodic[noisy].quantile(0.95) < 0.5


def test_activity_is_where_the_energy_is():
    speech = talk(seconds=12.0)
    level = speech.samples.square().unfold(0, 1600, 800).mean(-1)
    share = speech.active.double().unfold(0, 1600, 800).mean(-1)
    assert level[share == 0].max() == 0
    assert (level[share == 1] > 0.07**2 / 1000).double().mean() > 0.97


def test_an_utterance_between_two_settings_keeps_to_absolute_time():
    voices = SyntheticVoices((SyntheticVoice(pitch=100.0, pitch_range=0.0, jitter=0.0, breath=0.0),))
    wave = torch.exp(-2j * torch.pi * 100 * torch.arange(2 * FS) / FS)
    spoken = [voices.speak([[(start, 1.9)]], duration=2.0, fs=FS, seed=0)[0].samples for start in (0.2, 0.2045)]
    phases = [(x.to(wave.dtype) @ wave).angle() for x in spoken]
    # pulses are counted from the setting before
    assert (phases[0] - phases[1]).abs() < 0.2


@pytest.mark.parametrize("scale", [1.0, 1.17])
def test_higher_formants_scale_too(scale):
    speech = talk(100.0, scale)
    x = speech.samples.numpy()
    fourth = [formants(x[80 * k - 320 : 80 * k + 320], count=4)[-1] for k in steady(speech.score)[::3]]
    assert np.median(fourth) == pytest.approx(3500 * scale, rel=0.03)
