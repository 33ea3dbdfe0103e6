import numpy as np
import pytest
import soundfile
import torch

from probtrack.errors import InputError
from probtrack.simulation import VOWELS, load_speech, speech_activity, sustained_vowel, synthesise_speech

FS = 16000


def speech(seed=0, duration=20.0):
    return synthesise_speech(duration, FS, generator=torch.Generator().manual_seed(seed))


def free_resonances(x, order=14):
    """Oracle: frequencies and bandwidths [Hz] of samples in which only resonances ring, by linear prediction."""
    past = np.lib.stride_tricks.sliding_window_view(x, order)[:-1, ::-1]
    roots = np.roots(np.append(1, -np.linalg.lstsq(past, x[order:])[0]))
    roots = roots[roots.imag > 0]
    roots = roots[np.argsort(np.angle(roots))]
    return np.angle(roots) * FS / (2 * np.pi), -np.log(np.abs(roots)) * FS / np.pi


def runs(active):
    """Start and end of each run of True [samples]."""
    edges = torch.nn.functional.pad(active.int(), (1, 1)).diff()
    return torch.stack([(edges == 1).nonzero()[:, 0], (edges == -1).nonzero()[:, 0]], -1)


@pytest.mark.parametrize("vowel", VOWELS)
def test_sustained_vowel_has_its_formants(vowel):
    x = sustained_vowel(vowel, 0.5, FS, pitch=50.0).numpy()
    shut = x[3200 + 220 : 3200 + 300]  # of a cycle of 320 samples: the glottis shuts after 0.56 of it
    frequencies, bandwidths = free_resonances(shut)
    np.testing.assert_allclose(frequencies[:3], VOWELS[vowel][0], rtol=0.02)
    np.testing.assert_allclose(bandwidths[:3], VOWELS[vowel][1], rtol=0.2)


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


def test_active_about_two_thirds_of_the_time():
    share = torch.stack([speech(seed).active.double().mean() for seed in range(4)]).mean()
    assert 0.62 < share < 0.74


def test_utterances_and_pauses_last_as_long_as_people_s():
    spans = runs(speech(1).active) / FS
    utterances, pauses = (spans[:, 1] - spans[:, 0])[:-1], spans[1:, 0] - spans[:-1, 1]
    assert ((utterances > 1.49) & (utterances < 3.01)).all()
    assert ((pauses > 0.69) & (pauses < 1.11)).all()


def test_silent_in_pauses_and_at_its_level_in_between():
    x, active = speech(2)
    assert x[~active].abs().max() == 0
    assert x[active].square().mean().sqrt() == pytest.approx(0.07, rel=0.01)
    assert x.abs().max() < 0.95


def test_syllables_follow_each_other_about_four_times_a_second():
    x, active = speech(3)
    envelope = torch.nn.functional.avg_pool1d(x[active].square()[None], FS // 50, FS // 50)[0].sqrt()
    power = torch.fft.rfft((envelope - envelope.mean()) * torch.hann_window(len(envelope))).abs().square()
    frequency = torch.arange(len(power)) * 50 / len(envelope)
    in_band = (frequency > 2.5) & (frequency < 6)
    assert power[in_band].sum() > 0.4 * power.sum()


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


def test_activity_finds_the_pauses_of_a_recording():
    x, active = speech(8)
    found = speech_activity(x + 1e-3 * torch.randn(len(x)), FS)
    assert (found == active).double().mean() > 0.95


def test_activity_of_a_steady_sound_is_all_speech():
    assert speech_activity(torch.randn(FS), FS).all()


def test_load_resamples_downmixes_and_repeats(tmp_path):
    t = torch.arange(8000) / 8000
    tone = torch.sin(2 * torch.pi * 440 * t)
    soundfile.write(tmp_path / "two.wav", torch.stack([tone, 0.5 * tone], -1).numpy(), 8000)
    samples, active = load_speech(tmp_path / "two.wav", FS, 2.5)
    assert samples.shape == active.shape == (40000,)
    power = torch.fft.rfft(samples[20000:36000] * torch.hann_window(16000)).abs()
    assert int(power.argmax()) == 440
    torch.testing.assert_close(samples[:16000], samples[16000:32000])


@pytest.mark.parametrize(("content", "message"), [(None, "cannot read speech"), (b"text", "cannot read speech")])
def test_load_rejects_what_is_no_sound_file(tmp_path, content, message):
    if content is not None:
        (tmp_path / "a.wav").write_bytes(content)
    with pytest.raises(InputError, match=f"a.wav: {message}") as caught:
        load_speech(tmp_path / "a.wav", FS, 1.0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("samples", [0, 100])
def test_load_rejects_silence(tmp_path, samples):
    soundfile.write(tmp_path / "a.wav", np.zeros(samples), FS)
    with pytest.raises(InputError, match="holds no sound"):
        load_speech(tmp_path / "a.wav", FS, 1.0)


def test_rejects_bad_arguments():
    with pytest.raises(InputError, match="duration must be finite and positive, got 0"):
        synthesise_speech(0, FS, generator=torch.Generator())
    with pytest.raises(InputError, match="fs must be at least 8000 Hz, got 4000"):
        synthesise_speech(1.0, 4000, generator=torch.Generator())
    with pytest.raises(InputError, match="vowel must be one of i, I"):
        sustained_vowel("o", 1.0)
