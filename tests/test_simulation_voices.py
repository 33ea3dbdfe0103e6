"""The synthetic voice as sound: formants, pitch, spectrum and rhythm, measured."""

import numpy as np
import pytest
import torch

from probtrack.errors import InputError
from probtrack.simulation.voices import VOWELS, SyntheticVoice, SyntheticVoices, TurnTaking, sustained_vowel
from probtrack.simulation.voices.vocal_tract import friction

FS = 16000
MAN = SyntheticVoices((SyntheticVoice(),))


def speech(seed=0, duration=10.0, voices=MAN, fs=FS):
    turns = TurnTaking().draw(1, duration, torch.Generator().manual_seed(seed))
    return voices.speak(turns, duration=duration, fs=fs, seed=seed)[0]


def free_resonances(x, order=14):
    """Oracle: frequencies and bandwidths [Hz] of samples in which only resonances ring, by linear prediction."""
    past = np.lib.stride_tricks.sliding_window_view(x, order)[:-1, ::-1]
    roots = np.roots(np.append(1, -np.linalg.lstsq(past, x[order:])[0]))
    roots = roots[roots.imag > 0]
    roots = roots[np.argsort(np.angle(roots))]
    return np.angle(roots) * FS / (2 * np.pi), -np.log(np.abs(roots)) * FS / np.pi


@pytest.mark.parametrize("vowel", VOWELS)
def test_sustained_vowel_has_its_formants(vowel):
    x = sustained_vowel(vowel, 0.5, FS, pitch=50.0).numpy()
    shut = x[3200 + 220 : 3200 + 300]  # of a cycle of 320 samples: the glottis shuts after 0.56 of it
    frequencies, bandwidths = free_resonances(shut)
    np.testing.assert_allclose(frequencies[:3], VOWELS[vowel][0], rtol=0.02)
    np.testing.assert_allclose(bandwidths[:3], VOWELS[vowel][1], rtol=0.2)


def test_a_shorter_vocal_tract_scales_all_formants():
    x = sustained_vowel("E", 0.5, FS, pitch=50.0, formant_scale=1.17).numpy()
    frequencies, bandwidths = free_resonances(x[3200 + 220 : 3200 + 300])
    np.testing.assert_allclose(frequencies[:4], 1.17 * np.array([*VOWELS["E"][0], 3500.0]), rtol=0.02)
    np.testing.assert_allclose(bandwidths[:3], VOWELS["E"][1], rtol=0.2)


@pytest.mark.parametrize("pitch", [80.0, 131.0, 210.0])
def test_sustained_vowel_has_its_pitch(pitch):
    x = sustained_vowel("A", 1.0, FS, pitch=pitch)
    spectrum = torch.fft.rfft(x, 2 * len(x))
    correlation = torch.fft.irfft(spectrum.abs().square())[: FS // 60]
    peak = 40 + int(correlation[40:].argmax())
    left, top, right = correlation[peak - 1 : peak + 2].tolist()
    lag = peak + (left - right) / (2 * (left - 2 * top + right))
    assert FS / lag == pytest.approx(pitch, rel=2e-3)


def test_pulses_do_not_alias():
    x = sustained_vowel("i", 1.0, FS, pitch=200.0)[4000:12000]  # 100 whole cycles: only harmonics may be there
    power = torch.fft.rfft(x * torch.blackman_window(len(x), periodic=True)).abs().square()
    harmonic = (torch.arange(len(power)) + 10) % 100 <= 20
    assert 10 * torch.log10(power[~harmonic].max() / power.max()) < -60


def test_silent_in_pauses_and_at_its_level_in_between():
    x, active, _ = speech(2)
    assert x[~active].abs().max() == 0
    assert x[active].square().mean().sqrt() == pytest.approx(0.07, rel=1e-6)
    assert x.abs().max() < 0.95


@pytest.mark.parametrize("rate", [3.0, 5.0])
def test_syllables_follow_each_other_at_their_rate(rate):
    voices = SyntheticVoices((SyntheticVoice(rate=rate),))
    x = voices.speak([[(0.0, 16.0)]], duration=16.0, fs=FS, seed=3)[0].samples
    envelope = torch.nn.functional.avg_pool1d(x.square()[None], FS // 50, FS // 50)[0].sqrt()
    power = torch.fft.rfft((envelope - envelope.mean()) * torch.hann_window(len(envelope))).abs().square()
    frequency = torch.arange(len(power)) * 50 / len(envelope)
    smooth = torch.nn.functional.avg_pool1d(power[None], 21, 1, 10)[0]
    low = frequency < 1.5 * rate
    assert frequency[low][smooth[low].argmax()] == pytest.approx(rate, rel=0.15)


def test_long_term_spectrum_falls_like_speech():
    x = speech(4).samples
    power = torch.stft(x, 1024, window=torch.hann_window(1024), return_complex=True).abs().square().mean(-1)
    frequency = torch.arange(513) * FS / 1024

    def density(centre):
        band = (frequency > centre / 2**0.5) & (frequency < centre * 2**0.5)
        return float(10 * torch.log10(power[band].mean()))

    assert 6 < (density(500) - density(4000)) / 3 < 12  # dB an octave
    assert density(60) < density(250) - 12


def test_same_seed_says_the_same():
    assert torch.equal(speech(5, 3.0).samples, speech(5, 3.0).samples)
    assert not torch.equal(speech(5, 3.0).samples, speech(6, 3.0).samples)


def test_default_dtype_does_not_change_what_is_said():
    double = speech(7, 3.0)
    torch.set_default_dtype(torch.float32)
    single = speech(7, 3.0)
    assert single.samples.dtype == torch.float32
    torch.testing.assert_close(single.samples.double(), double.samples, rtol=0, atol=1e-7)


def test_one_talker_says_the_same_however_many_others_there_are():
    turns = [[(0.2, 1.5)], [(1.7, 2.6)], []]
    alone = SyntheticVoices().speak(turns[:1], duration=3.0, fs=FS, seed=11)
    together = SyntheticVoices().speak(turns, duration=3.0, fs=FS, seed=11)
    torch.testing.assert_close(alone[0].samples, together[0].samples, rtol=0, atol=0)
    assert not torch.equal(together[0].active, together[1].active)
    assert together[2].samples.abs().max() == 0
    assert not together[2].active.any()


def test_drawn_voices_are_men_and_women():
    voices = [SyntheticVoice.draw(torch.Generator().manual_seed(seed)) for seed in range(300)]
    women = [voice for voice in voices if voice.formant_scale > 1.08]
    men = [voice for voice in voices if voice.formant_scale <= 1.08]
    assert 110 < len(women) < 190
    assert all(165 < voice.pitch < 265 for voice in women)
    assert all(95 < voice.pitch < 151 for voice in men)


@pytest.mark.parametrize("fs", [8000, 22050, 44100, 48000])
def test_any_sampling_rate_says_the_same(fs):
    voices = SyntheticVoices((SyntheticVoice(breath=0.7),))
    bands, vowels = [], []
    for rate in (FS, fs):
        x, _, score = speech(8, 5.0, voices, rate)
        assert len(x) == 5 * rate
        power = torch.fft.rfft(x).abs().square()[5 * 200 : 5 * 1400].reshape(12, -1).sum(-1)
        bands.append(10 * torch.log10(power / power.sum()))
        vowels.append(score.vowel[torch.searchsorted(score.time, torch.arange(0.1, 4.9, 0.05))])
    # at 16 kHz, images of the resonators stand for the formants that are missing above: 3 dB at 2.5 kHz
    assert (bands[0] - bands[1]).abs().median() < 0.6
    assert (vowels[0] == vowels[1]).double().mean() > 0.93  # but where one begins or ends


def test_utterances_begin_with_sound():
    turns = [[(0.5 * k, 0.5 * k + 0.4) for k in range(24)]]
    x = MAN.speak(turns, duration=12.0, fs=FS, seed=1)[0].samples.reshape(24, -1)
    assert x[:, 320:800].square().mean(-1).sqrt().min() > 2e-4  # no closure of a plosive


@pytest.mark.parametrize(("fs", "peak"), [(8000, 3200.0), (16000, 5500.0)])
def test_hiss_lies_at_its_centre_or_as_high_as_the_rate_allows(fs, peak):
    response = friction(torch.tensor([5500.0]), torch.tensor([500.0]), fs)[0].abs()
    assert float(response.argmax()) * fs / 2 / (len(response) - 1) == pytest.approx(peak, abs=50)
    assert response.square().mean() == pytest.approx(1.0)


def test_no_click_where_utterances_begin_and_end():
    x, active, _ = speech(9, 15.0)
    edges = active.int().diff().nonzero()[:, 0]
    steps = x.diff().abs()
    around = torch.stack([steps[edge - 8 : edge + 8].max() for edge in edges if 8 < edge < len(steps) - 8])
    assert around.max() < torch.quantile(steps[active[1:]], 0.99)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"pitch": 20.0}, "pitch must be between 40 and 600, got 20.0"),
        ({"pitch_range": -1.0}, "pitch_range must be between 0 and 24, got -1.0"),
        ({"formant_scale": 2.0}, "formant_scale must be between 0.7 and 1.6, got 2.0"),
        ({"jitter": 0.5}, "jitter must be between 0 and 0.05, got 0.5"),
        ({"breath": -1.0}, "breath must be finite and not negative, got -1.0"),
        ({"rate": float("nan")}, "rate must be between 1 and 10, got nan"),
    ],
)
def test_rejects_voices_that_cannot_be(setting, message):
    with pytest.raises(InputError, match=message):
        SyntheticVoice(**setting)


@pytest.mark.parametrize(
    ("turns", "settings", "message"),
    [
        ([[(0.0, 1.0)], []], {}, "talkers must be at least as many as the turns are for, 2, got 1"),
        ([[(1.0, 0.5)]], {}, r"turns of talker 0 must be in order and within 2.0 s, got \(1.0, 0.5\)"),
        ([[(0.0, 2.5)]], {}, r"within 2.0 s, got \(0.0, 2.5\)"),
        ([[(0.5, 1.0), (0.8, 1.2)]], {}, r"in order .* got \(0.8, 1.2\)"),
        ([[(float("nan"), 1.0)]], {}, r"in order .* got \(nan, 1.0\)"),
        ([[(1.0, 1.00001)]], {}, "turns must be utterances of at least one sample, got"),
        ([[]], {"duration": 0.0}, "duration must be finite and positive, got 0"),
        ([[]], {"fs": 4000}, "fs must be an integer of at least 8000, got 4000"),
        ([[]], {"seed": -1}, "seed must be an integer of at least 0, got -1"),
    ],
)
def test_rejects_what_cannot_be_spoken(turns, settings, message):
    with pytest.raises(InputError, match=message):
        MAN.speak(turns, **({"duration": 2.0, "fs": FS, "seed": 0} | settings))


def test_rejects_a_vowel_that_is_not_known():
    with pytest.raises(InputError, match="vowel must be one of i, I"):
        sustained_vowel("o", 1.0)
