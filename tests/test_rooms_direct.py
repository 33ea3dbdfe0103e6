"""Sound that comes straight from a mouth, against the geometry of emission and reception."""

import math

import pytest
import torch
from oracles.mirrored_talkers import SPEECH_BANDS

from probtrack.simulation.motion import Motion
from probtrack.simulation.rooms import LEAD, SPEECH
from probtrack.simulation.rooms.direct import direct_responses, direct_sound

FS = 16000
C = 343.0
MICROPHONES = [[1.35, 0.29, 1.51], [2.15, 0.31, 1.42], [3.01, 1.95, 1.38]]


def motion(position, mouth=0.0):
    """Return a motion at `position` (S, 3) with its mouth at `mouth` (S,) or a number."""
    mouth = torch.as_tensor(mouth).expand(len(position))
    return Motion(position, torch.zeros_like(position), mouth, mouth)


def standing(point, size, mouth=0.0):
    return motion(torch.tensor(point).expand(size, 3), mouth)


def curve(size):
    """Return a walk (size, 3) at up to 1.5 m/s."""
    t = torch.arange(size) / FS
    return torch.stack(
        [1.7 + 0.9 * torch.cos(1.6 * t), 1.5 + 0.8 * torch.sin(1.6 * t), 1.5 + 0.1 * torch.sin(3 * t)], -1
    )


def tone(frequency, size):
    t = torch.arange(size) / FS
    return torch.sin(2 * torch.pi * frequency * t) * torch.sin(torch.pi * t / t[-1]) ** 2


def heard_by(microphones, signal, moving, directivity=None):
    return direct_sound(signal, moving, torch.tensor(microphones), directivity, FS, C)


def off_tone_db(audio, frequency, width):
    """Return the largest line farther than `width` [Hz] from the tone, relative to it [dB]."""
    power = torch.fft.rfft(audio * torch.blackman_window(audio.shape[-1])).abs().square()
    away = (torch.arange(power.shape[-1]) * FS / audio.shape[-1] - frequency).abs() > width
    return 10 * torch.log10(power[:, away].amax(-1) / power.amax(-1)).max()


@pytest.mark.parametrize("point", [(1.13, 1.71, 1.51), (2.37, 0.83, 1.22), (0.4, 2.9, 0.3), (1.4, 0.39, 1.45)])
def test_standing_source_arrives_with_the_delay_and_loss_of_its_distance(point):
    signal = torch.zeros(2048)
    signal[500:1500] = torch.randn(1000) * torch.hann_window(1000)
    signal = torch.fft.irfft(torch.fft.rfft(signal) * (torch.arange(1025) < 0.87 * 1024), 2048)  # to 7 kHz
    f = torch.fft.rfftfreq(2048, 1 / FS)[64:832]  # 0.5 to 6.5 kHz
    audio = heard_by(MICROPHONES, signal, standing(point, 2048))
    ratio = (torch.fft.rfft(audio) / torch.fft.rfft(signal))[:, 64:832]
    for r, microphone in zip(ratio, MICROPHONES, strict=True):
        distance = math.dist(point, microphone)
        expected = torch.exp(-2j * torch.pi * f * distance / C) / distance
        assert ((r - expected).abs() * distance).max() < 0.01  # a hundredth of a sample at 2.5 kHz


@pytest.mark.parametrize("frequency", [300.0, 1000.0, 3000.0])
def test_moving_tone_arrives_when_geometry_says(frequency):
    """Emission times from a fixed-point iteration in closed form: what is heard now left when the mouth was there."""
    size = 2 * FS
    path = curve(size)
    audio = heard_by(MICROPHONES, tone(frequency, size), motion(path))
    now = torch.arange(size)[4000:-4000] / FS
    for heard, microphone in zip(audio, MICROPHONES, strict=True):
        then = now.clone()
        for _ in range(20):
            place = torch.stack(
                [1.7 + 0.9 * torch.cos(1.6 * then), 1.5 + 0.8 * torch.sin(1.6 * then), 1.5 + 0.1 * torch.sin(3 * then)],
                -1,
            )
            distance = (place - torch.tensor(microphone)).square().sum(-1).sqrt()
            then = now - distance / C
        wave = torch.sin(2 * torch.pi * frequency * then) * torch.sin(torch.pi * then * FS / (size - 1)) ** 2
        error = (heard[4000:-4000] * distance - wave).abs().max()
        assert error < 2 * torch.pi * frequency / FS * 0.02 + 1e-3  # a fiftieth of a sample


def test_approaching_talker_sounds_higher():
    t = torch.arange(2 * FS) / FS
    path = torch.stack([0.5 + 1.0 * t, torch.full_like(t, 1.5), torch.full_like(t, 1.5)], -1)
    audio = heard_by([[3.4, 1.5, 1.5], [0.1, 1.5, 1.5]], torch.sin(2 * torch.pi * 2000 * t), motion(path))
    middle = audio[:, FS // 2 : FS // 2 + FS] * torch.hann_window(FS)
    peak = torch.fft.rfft(middle, 1 << 18).abs().argmax(-1) * FS / (1 << 18)
    torch.testing.assert_close(peak, torch.tensor([2000 / (1 - 1 / C), 2000 / (1 + 1 / C)]), rtol=0, atol=0.1)


def test_moving_tone_has_no_clicks():
    audio = heard_by(MICROPHONES, tone(1000.0, 2 * FS), motion(curve(2 * FS)))
    assert off_tone_db(audio, 1000.0, 30) < -80


def test_a_turning_mouth_makes_no_clicks():
    mouth = torch.linspace(-math.pi, 3 * math.pi, 2 * FS).remainder(2 * math.pi)
    audio = heard_by(MICROPHONES, tone(1000.0, 2 * FS), standing((1.1, 1.9, 1.5), 2 * FS, mouth), SPEECH)
    assert off_tone_db(audio, 1000.0, 30) < -80


@pytest.mark.parametrize(("frequency", "band"), SPEECH_BANDS.items())
def test_a_mouth_that_turns_is_as_loud_as_its_pattern_says(frequency, band):
    """Front, side and back, on both sides and obliquely upwards."""
    angles_deg = torch.tensor([0.0, 35.0, 90.0, 140.0, 180.0, -90.0, -35.0])
    mouth = torch.deg2rad(angles_deg).repeat_interleave(2000) + 0.7
    size = len(mouth)
    ahead = [[1.1 + 1.5 * math.cos(0.7), 1.9 + 1.5 * math.sin(0.7), z] for z in (1.4, 2.6)]
    signal = torch.sin(2 * torch.pi * frequency * torch.arange(size) / FS)
    audio = heard_by(ahead, signal, standing((1.1, 1.9, 1.4), size, mouth), SPEECH)
    power = audio.reshape(2, 7, 2000)[..., 600:1800].square().mean(-1)
    for m, (elevation, distance) in enumerate([(1.0, 1.5), (1.5 / math.hypot(1.5, 1.2), math.hypot(1.5, 1.2))]):
        level = 10 * torch.log10(power[m] * 2 * distance**2)
        cosine = torch.cos(torch.deg2rad(angles_deg)) * elevation
        torch.testing.assert_close(level, -band[0] * ((1 - cosine) / 2) ** band[1], rtol=0, atol=0.8)


def test_direction_counts_at_emission():
    """A mouth that turns away at once: the microphone hears it only when the sound has come."""
    mouth = torch.where(torch.arange(4000) < 2000, 0.0, math.pi)
    signal = torch.sin(2 * torch.pi * 4000 * torch.arange(4000) / FS)
    audio = heard_by([[3.5, 1.0, 1.0]], signal, standing((0.5, 1.0, 1.0), 4000, mouth), SPEECH)[0]
    delay = round(3.0 / C * FS)
    before, after = audio[2000 + delay - 60 : 2000 + delay - 10], audio[2000 + delay + 10 : 2000 + delay + 60]
    assert 10 * torch.log10(after.square().mean() / before.square().mean()) == pytest.approx(-19.3, abs=1.0)


def test_nothing_is_heard_before_the_first_sound_arrives():
    audio = heard_by([[3.5, 1.0, 1.0]], torch.ones(400), standing((0.5, 1.0, 1.0), 400))[0]
    arrival = int(3.0 / C * FS)
    assert audio[: arrival - 70].abs().max() == 0
    assert audio[: arrival - 5].abs().max() < 0.05
    assert float(audio[arrival + 100 : arrival + 200].mean()) == pytest.approx(1 / 3, rel=0.01)


def test_a_mouth_at_the_microphone_is_as_loud_as_at_five_centimetres():
    signal = tone(500.0, 2000)
    audio = heard_by([[1.0, 1.0, 1.0], [1.0, 1.05, 1.0]], signal, standing((1.0, 1.0, 1.0), 2000), None)
    torch.testing.assert_close(audio[0], audio[1], rtol=0, atol=1e-6)
    assert float(audio.abs().max()) == pytest.approx(20.0, rel=0.01)


@pytest.mark.parametrize("size", [1, 2, 5])
def test_short_signals_are_heard(size):
    audio = heard_by(MICROPHONES, torch.ones(size), standing((1.3, 0.3, 1.5), size), SPEECH)
    assert audio.shape == (3, size)
    assert audio.isfinite().all()


def test_single_precision_is_near_double():
    signal, moving = tone(1000.0, FS), motion(curve(FS), torch.linspace(0, 3, FS))
    double = heard_by(MICROPHONES, signal, moving, SPEECH)
    torch.set_default_dtype(torch.float32)
    single = direct_sound(
        signal.float(), Motion(*(x.float() for x in moving)), torch.tensor(MICROPHONES), SPEECH, FS, C
    )
    assert single.dtype == torch.float32
    torch.testing.assert_close(
        single.double(), double, rtol=0, atol=1e-3
    )  # 3e-7 m of rounding, and that of the filters


@pytest.mark.parametrize("directivity", [None, SPEECH])
def test_response_and_sound_of_a_standing_source_agree(directivity):
    signal = torch.zeros(3000)
    signal[200:2000] = torch.randn(1800) * torch.hann_window(1800)
    points, mouth = torch.tensor([[1.13, 1.71, 1.51], [0.4, 2.9, 0.3]]), torch.tensor([0.4, -2.0])
    h = direct_responses(points, torch.tensor(MICROPHONES), directivity, mouth, length=700, fs=FS, speed_of_sound=C)
    for k in range(2):
        audio = heard_by(MICROPHONES, signal, standing(points[k].tolist(), 3000, mouth[k]), directivity)
        through = torch.fft.irfft(torch.fft.rfft(signal, 8192) * torch.fft.rfft(h[k], 8192))[:, LEAD : LEAD + 3000]
        spectra = torch.fft.rfft(torch.stack([audio, through]))[..., 100:1300]  # 0.5 to 7 kHz
        assert (spectra[0] - spectra[1]).abs().square().mean() < 1e-4 * spectra[0].abs().square().mean()
