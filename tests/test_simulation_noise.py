"""Noises of a scene: what they are, and how loud."""

import math

import pytest
import soundfile
import torch

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray
from probtrack.simulation.noise import (
    DiffuseNoise,
    Interferer,
    RecordedNoise,
    WhiteNoise,
    add_noise,
    at_snr,
    mixed,
    spectral_gain,
)
from probtrack.simulation.rooms import ShoeboxRoom

FS = 8000
ROOM = ShoeboxRoom((4.0, 3.0, 2.5), 0.0)


def array():
    return MicrophoneArray([[1.0, 1.0, 1.2], [1.9, 1.1, 1.3], [1.2, 2.5, 1.0]])


def generator(seed=5):
    return torch.Generator().manual_seed(seed)


def draw(noise, size=FS, fs=FS, seed=5):
    return noise.draw(ROOM, array(), size, fs, generator(seed))


def recording(path, samples, fs=FS):
    soundfile.write(path, samples.T.numpy(), fs, subtype="DOUBLE")
    return str(path)


def level_db(noise):
    return 10 * torch.log10(noise.square().mean(-1))


def noises(folder):
    three = recording(folder / "three.wav", torch.randn(3, FS) * torch.tensor([[0.1], [0.2], [0.05]]))
    voice = recording(folder / "voice.wav", torch.randn(1, 5 * FS))
    place = (2.0, 2.0, 1.5)
    return [
        WhiteNoise(),
        DiffuseNoise("speech"),
        DiffuseNoise(file=voice),
        RecordedNoise(three),
        Interferer(place, voice),
    ]


def test_every_noise_has_unit_power_and_its_own_seed(tmp_path):
    for noise in noises(tmp_path):
        one, again, other = draw(noise), draw(noise), draw(noise, seed=6)
        assert one.shape == (3, FS)
        assert one.dtype == torch.get_default_dtype()
        assert one.square().mean() == pytest.approx(1.0)
        assert torch.equal(one, again)
        assert not torch.equal(one, other)


def test_white_noise_is_white_and_independent():
    noise = draw(WhiteNoise(), 2**17)
    torch.testing.assert_close(noise @ noise.T / 2**17, torch.eye(3), rtol=0, atol=5 * math.sqrt(2 / 2**17))
    bands = torch.fft.rfft(noise).abs().square()[:, 1:].reshape(3, 16, -1).mean(-1)
    torch.testing.assert_close(bands, torch.full_like(bands, 2.0**17), rtol=5 / math.sqrt(2**12), atol=0)


@pytest.mark.parametrize(
    ("spectrum", "frequency", "level"),
    [
        ("pink", 1000, -3.01),
        ("pink", 3, 0.0),
        ("white", 1000, 0.0),
        ("speech", 4000, -9.0),
        ("speech", 150, -0.7),
        ("speech", 15, 12.0),
        ("fan", 3000, -6.0),
    ],
)
def test_an_octave_up_the_spectrum_changes_as_stated(spectrum, frequency, level):
    low, high = spectral_gain(spectrum, torch.tensor([1.0, 2.0]) * frequency)
    assert 20 * math.log10(high / low) == pytest.approx(level, abs=0.6)


def test_recorded_noise_keeps_levels_and_samples_of_channels(tmp_path):
    samples = torch.randn(3, 9 * FS) * torch.tensor([[0.01], [0.02], [0.005]])
    noise = draw(RecordedNoise(recording(tmp_path / "n.wav", samples)))
    start = int((samples[1] / samples[0] - noise[1, 0] / noise[0, 0]).abs().argmin())
    cut = samples[:, start : start + FS]
    torch.testing.assert_close(noise, cut / cut.square().mean().sqrt())


def test_short_recordings_go_on_without_a_seam(tmp_path):
    t = torch.arange(FS) / FS
    tone = torch.stack([torch.sin(2 * torch.pi * (200 + 7 * k) * t + k) for k in range(3)])
    noise = draw(RecordedNoise(recording(tmp_path / "tone.wav", tone)), 5 * FS)
    step = noise.diff(dim=-1).abs().amax(-1) / noise.abs().amax(-1)
    assert (step < 1.5 * 2 * torch.pi * 214 / FS).all()
    power = noise.square().unfold(-1, 400, 400).mean(-1)
    assert power.min() > 0.4 * power.mean()  # a gap would show; tones may cancel by half where they fade


def test_recordings_are_resampled(tmp_path):
    t = torch.arange(3 * 16000) / 16000
    tone = torch.sin(2 * torch.pi * 1000 * t).expand(3, -1)
    noise = draw(RecordedNoise(recording(tmp_path / "tone.wav", tone, 16000)))
    assert torch.fft.rfft(noise[0]).abs().argmax() == 1000


def test_interferer_is_heard_from_its_place():
    noise = draw(Interferer((3.0, 0.5, 1.0), spectrum="white"), 4 * FS)
    distance = torch.linalg.vector_norm(array().positions - torch.tensor([3.0, 0.5, 1.0]), dim=-1)
    expected = -20 * torch.log10(distance / distance[0])
    torch.testing.assert_close(level_db(noise) - level_db(noise)[0], expected, rtol=0, atol=0.15)
    spectrum = torch.fft.rfft(noise)
    for k in (1, 2):
        lag = torch.fft.irfft(torch.exp(1j * torch.angle(spectrum[k] * spectrum[0].conj()))).argmax()
        lag = lag - 4 * FS if lag > 2 * FS else lag
        assert lag == pytest.approx(float((distance[k] - distance[0]) / 343 * FS), abs=1)


def test_interferer_is_on_before_the_recording_starts():
    noise = draw(Interferer((3.9, 2.9, 2.4)), 2 * FS)
    assert (noise[:, :40].abs().amax(-1) > 0.1).all()


def test_fan_hums_at_its_blades():
    power = torch.fft.rfft(draw(Interferer((3.0, 0.5, 1.0)), 4 * FS)[0]).abs().square()
    frequency = torch.arange(len(power)) / 4
    hum, beside = ((frequency - f).abs() < 3 for f in (130.0, 180.0))
    assert power[hum].sum() > 20 * power[beside].sum()


def test_levels_of_noises_are_relative_to_each_other():
    both = [WhiteNoise(level_db=-7.0), DiffuseNoise(level_db=4.0)]
    first = mixed(both[:1], ROOM, array(), FS, FS, generator())
    sum_ = mixed(both, ROOM, array(), FS, FS, generator())
    assert 10 * torch.log10(first.square().mean()) == pytest.approx(-7.0)
    assert 10 * torch.log10((sum_ - first).square().mean()) == pytest.approx(4.0)
    assert abs((first * (sum_ - first)).mean()) < 0.03  # independent of each other
    assert not mixed([], ROOM, array(), FS, FS, generator()).any()


def test_snr_is_of_active_speech_over_all_noise():
    clean, active = torch.randn(3, FS) * torch.tensor([[0.1], [0.3], [0.2]]), torch.zeros(FS, dtype=torch.bool)
    active[1000:3000] = True
    clean[:, ~active] *= 0.01
    scaled = at_snr(clean, 7.0 * torch.randn(3, FS), 13.0, active)
    speech = float(clean[:, 1000:3000].square().mean())
    assert 10 * math.log10(speech / float(scaled.square().mean())) == pytest.approx(13.0, abs=1e-6)
    noisy = add_noise(clean, 13.0, active, generator=generator())
    assert 10 * math.log10(speech / float((noisy - clean).square().mean())) == pytest.approx(13.0, abs=1e-6)


ONES = torch.ones(2, 4)
ALL = torch.ones(4, dtype=torch.bool)


@pytest.mark.parametrize(
    ("clean", "noise", "snr", "active", "message"),
    [
        (ONES, ONES, 10.0, ~ALL, "clean must hold speech where active"),
        (0 * ONES, ONES, 10.0, ALL, "clean must hold speech where active"),
        (ONES, 0 * ONES, 10.0, ALL, "noise must not be silent"),
        (ONES, ONES * torch.nan, 10.0, ALL, "noise must be finite"),
        (ONES * torch.inf, ONES, 10.0, ALL, "clean must be finite"),
        (ONES, ONES, math.nan, ALL, "snr_db must be finite"),
        (ONES, ONES[:1], 10.0, ALL, "noise must have the shape of clean"),
        (ONES, ONES, 10.0, ALL[:3], r"active must be bool and have shape \(4,\)"),
    ],
)
def test_levels_that_cannot_be_are_said(clean, noise, snr, active, message):
    with pytest.raises(InputError, match=message):
        at_snr(clean, noise, snr, active)


def test_files_that_cannot_be_used_are_said(tmp_path):
    files = {
        "cannot read noise": str(tmp_path / "none.wav"),
        "must be finite": recording(tmp_path / "nan.wav", torch.full((3, FS), torch.nan)),
        "must not be silent": recording(tmp_path / "zeros.wav", torch.zeros(3, FS)),
        "at least 0.5 s, got 0.25 s": recording(tmp_path / "short.wav", torch.ones(3, FS // 4)),
        "would be heard alike at all microphones": recording(tmp_path / "mono.wav", torch.ones(1, FS)),
        "a channel for each of 3 microphones, got 2": recording(tmp_path / "two.wav", torch.ones(2, FS)),
        "cannot read noise: Error": str(tmp_path / "text.wav"),
    }
    (tmp_path / "text.wav").write_text("no sound")
    for message, file in files.items():
        with pytest.raises(InputError, match=message) as caught:
            draw(RecordedNoise(file))
        assert file in str(caught.value)
        assert "\n" not in str(caught.value)


def test_interferers_that_cannot_be_are_said(tmp_path):
    with pytest.raises(InputError, match=r"interferer at \(9.0, 1.0, 1.0\) m is outside the room"):
        draw(Interferer((9.0, 1.0, 1.0)))
    with pytest.raises(InputError, match="position must be three finite coordinates"):
        Interferer((1.0, math.nan, 1.0))
    half = torch.cat([torch.ones(1, FS), torch.zeros(1, 60 * FS)], -1)
    with pytest.raises(InputError, match="stretch of noise must not be silent"):
        draw(Interferer((2.0, 1.0, 1.0), recording(tmp_path / "pause.wav", half)))
    with pytest.raises(InputError, match="level_db must be finite"):
        mixed([WhiteNoise(math.inf)], ROOM, array(), FS, FS, generator())


@pytest.mark.realdata
def test_real_recordings_fill_the_room(data_dir):
    for name, rate in (("doing_the_dishes", 16000), ("babble_8kHz", 8000)):
        noise = DiffuseNoise(file=str(data_dir / "noise" / f"{name}.flac"))
        audio = noise.draw(ROOM, array(), 8 * 16000, 16000, generator())
        assert audio.square().mean() == pytest.approx(1.0)
        assert (level_db(audio).abs() < 1.0).all()
        high = torch.fft.rfft(audio).abs().square()[:, 8 * 4200 :].sum() / torch.fft.rfft(audio).abs().square().sum()
        assert (high < 1e-3) == (rate == 8000)
