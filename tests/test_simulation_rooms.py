import builtins
import math

import pytest
import torch

from probtrack.errors import InputError
from probtrack.simulation import LEAD, ShoeboxRoom, add_noise, reverberation_time, smooth_path

FS = 16000
SIZE = (3.5, 3.1, 2.2)


def microphones():
    return torch.tensor([[1.35, 0.29, 1.51], [2.15, 0.31, 1.42], [3.01, 1.95, 1.38]])


def tone_on_the_way(frequency, t60=0.0):
    t = torch.arange(2 * FS) / FS
    path = smooth_path([(0.7, 2.2, 1.5), (1.3, 1.1, 1.5), (2.4, 1.3, 1.6)], 2.0, FS)
    x = torch.sin(2 * torch.pi * frequency * t) * (torch.sin(torch.pi * t / 2) ** 2)
    return path, ShoeboxRoom(SIZE, t60).render_moving(x, path.positions, microphones())


def arrival(response):
    """Delay of one pulse [samples], from the slope of its phase from 1 to 4 kHz."""
    spectrum = torch.fft.rfft(response, 4096)[256:1024]
    return -torch.angle(spectrum[1:] / spectrum[:-1]).mean() * 4096 / (2 * torch.pi)


@pytest.mark.parametrize("t60", [0.15, 0.27, 0.4])
def test_reaches_the_wanted_reverberation_time(t60):
    pytest.importorskip("pyroomacoustics")
    room = ShoeboxRoom(SIZE, t60)
    responses = room.impulse_responses(torch.tensor([[1.2, 1.7, 1.51], [2.3, 0.8, 1.2]]), microphones())
    assert reverberation_time(responses, FS).mean() == pytest.approx(t60, rel=0.1)


def test_reverberation_time_of_an_exponential_decay():
    t = torch.arange(FS) / FS
    decay = torch.stack([torch.randn(FS) * 10 ** (-3 * t / t60) for t60 in (0.2, 0.5)])
    torch.testing.assert_close(reverberation_time(decay, FS), torch.tensor([0.2, 0.5]), rtol=0.05, atol=0)


def test_direct_path_has_the_delay_and_loss_of_its_distance():
    pytest.importorskip("pyroomacoustics")
    points = torch.tensor([[1.13, 1.71, 1.51], [2.37, 0.83, 1.22], [0.4, 2.9, 0.3], [1.40, 0.39, 1.45]])
    distance = torch.cdist(points, microphones())
    responses = ShoeboxRoom(SIZE, 0.0).impulse_responses(points, microphones())
    for response, d in zip(responses.flatten(0, 1), distance.flatten(), strict=True):
        assert abs(arrival(response) - LEAD - d / 343.0 * FS) < 0.05
        gain = torch.fft.rfft(response, 4096).abs()[200:1000]  # 0.8 to 3.9 kHz
        torch.testing.assert_close(gain, (1 / d).expand(800), rtol=0.01, atol=0)


def test_reflections_leave_the_direct_path_alone():
    pytest.importorskip("pyroomacoustics")
    point, end = torch.tensor([[1.6, 0.7, 1.3]]), LEAD + 32  # heard after 24 samples, by the wall after 49
    dry, wet = (ShoeboxRoom(SIZE, t60).impulse_responses(point, microphones())[0, 0] for t60 in (0.0, 0.27))
    torch.testing.assert_close(wet[:end], dry[:end], rtol=0, atol=0.02 * float(dry.max()))


def test_nothing_arrives_before_the_direct_path():
    pytest.importorskip("pyroomacoustics")
    point = torch.tensor([[1.1, 1.9, 1.5]])
    response = ShoeboxRoom(SIZE, 0.27).impulse_responses(point, microphones())[0]
    for h, d in zip(response, torch.cdist(point, microphones())[0], strict=True):
        assert h[: int(d / 343.0 * FS)].abs().max() < 0.02 * h.abs().max()  # the tail of a windowed sinc


def test_reciprocity():
    pytest.importorskip("pyroomacoustics")
    room, points = ShoeboxRoom(SIZE, 0.2), torch.tensor([[1.1, 1.9, 1.5], [2.8, 0.7, 0.9]])
    there = room.impulse_responses(points, microphones())
    back = room.impulse_responses(microphones(), points)
    torch.testing.assert_close(there, back.transpose(0, 1), rtol=0, atol=1e-4)


def test_standing_talker_is_heard_through_the_impulse_response():
    pytest.importorskip("pyroomacoustics")
    room, place = ShoeboxRoom(SIZE, 0.2), torch.tensor([1.1, 1.9, 1.5])
    x = torch.randn(4000)
    audio = room.render_moving(x, place.expand(4000, 3), microphones())
    h = room.impulse_responses(place[None], microphones())[0]
    expected = torch.fft.irfft(torch.fft.rfft(x, 16384) * torch.fft.rfft(h, 16384), 16384)[:, LEAD : LEAD + 4000]
    error = torch.fft.rfft(audio - expected)[:, : 4000 * 7 // 16]  # both interpolate well up to 7 kHz
    assert error.abs().square().mean() < 1e-4 * torch.fft.rfft(expected).abs().square().mean()


def test_moving_tone_has_no_clicks():
    _, audio = tone_on_the_way(1000.0)
    power = torch.fft.rfft(audio * torch.blackman_window(audio.shape[-1])).abs().square()
    away = (torch.arange(power.shape[-1]) * FS / audio.shape[-1] - 1000.0).abs() > 30
    assert 10 * torch.log10(power[:, away].amax(-1) / power.amax(-1)).max() < -80


def test_moving_tone_arrives_when_geometry_says():
    path, audio = tone_on_the_way(1000.0)
    now = torch.arange(audio.shape[-1]) / FS
    for heard, microphone in zip(audio, microphones(), strict=True):
        distance = torch.linalg.vector_norm(path.positions - microphone, dim=-1)
        delay = distance / 343.0  # at emission, 1e-3 of it off the delay at arrival, so solve once more
        delay = torch.lerp(delay[:-1], delay[1:], 0.5)[(now - delay).mul(FS).long().clamp(0, audio.shape[-1] - 2)]
        t = now - delay
        expected = torch.sin(2 * torch.pi * 1000 * t) * torch.sin(torch.pi * t / 2) ** 2
        middle = slice(4000, -4000)
        gain = (heard * expected)[middle].mean() / expected[middle].square().mean()
        assert gain == pytest.approx(float((1 / distance[middle]).mean()), rel=0.2)
        loudness = heard * distance
        assert (loudness - expected)[middle].abs().max() < 0.03  # an eighth of a sample at 1 kHz is 0.05


def test_approaching_talker_sounds_higher():
    t = torch.arange(2 * FS) / FS
    path = torch.stack([0.5 + 1.0 * t, torch.full_like(t, 1.5), torch.full_like(t, 1.5)], -1)
    ends = torch.tensor([[3.4, 1.5, 1.5], [0.1, 1.5, 1.5]])
    audio = ShoeboxRoom(SIZE, 0.0).render_moving(torch.sin(2 * torch.pi * 2000 * t), path, ends)
    window = torch.hann_window(FS)
    peak = torch.fft.rfft(audio[:, FS // 2 : FS // 2 + FS] * window, 16 * FS).abs().argmax(-1) / 16
    expected = torch.tensor([2000 / (1 - 1 / 343), 2000 / (1 + 1 / 343)])
    torch.testing.assert_close(peak.double(), expected, rtol=0, atol=0.1)


def test_reverberant_moving_tone_has_no_clicks():
    pytest.importorskip("pyroomacoustics")
    _, audio = tone_on_the_way(500.0, t60=0.15)
    power = torch.fft.rfft(audio * torch.blackman_window(audio.shape[-1])).abs().square()
    away = (torch.arange(power.shape[-1]) * FS / audio.shape[-1] - 500.0).abs() > 150
    assert 10 * torch.log10(power[:, away].amax(-1) / power.amax(-1)).max() < -60


@pytest.mark.parametrize("snr_db", [-5.0, 20.0])
def test_noise_has_the_wanted_level_over_speech(snr_db):
    clean = torch.randn(3, FS) * torch.tensor([[1.0], [0.5], [2.0]])
    speech = torch.arange(FS) % 3000 < 1900
    clean[:, ~speech] *= 0.01
    noise = add_noise(clean, snr_db, speech, generator=torch.Generator().manual_seed(1)) - clean
    measured = 10 * torch.log10(clean[:, speech].square().mean() / noise.square().mean())
    assert measured == pytest.approx(snr_db, abs=0.2)
    torch.testing.assert_close(noise.std(-1), noise.std().expand(3), rtol=0.05, atol=0)


def test_noise_is_white():
    noise = add_noise(torch.ones(1, 4 * FS), 0.0, generator=torch.Generator().manual_seed(1)) - 1
    power = torch.fft.rfft(noise).abs().square()[0, :-1].reshape(8, -1).mean(-1)
    torch.testing.assert_close(power / power.mean(), torch.ones(8), rtol=0.06, atol=0)  # 4 / sqrt(4000)


def test_noise_needs_speech():
    with pytest.raises(InputError, match="speech must hold somewhere"):
        add_noise(torch.randn(2, 9), 20.0, torch.zeros(9, dtype=torch.bool), generator=torch.Generator())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((3.5, 3.1), 0.2), "size must be three positive lengths"),
        (((3.5, 3.1, -2.2), 0.2), "size must be three positive lengths"),
        ((SIZE, -0.1), "t60 must be finite and not negative, got -0.1"),
        ((SIZE, math.nan), "t60 must be finite and not negative, got nan"),
        ((SIZE, 0.2, 0), "fs and speed_of_sound must be positive"),
    ],
)
def test_rejects_bad_room(arguments, message):
    with pytest.raises(InputError, match=message):
        ShoeboxRoom(*arguments)


def test_rejects_a_reverberation_time_that_no_absorption_gives():
    with pytest.raises(InputError, match=r"t60 of 0.005 s cannot be reached"):
        _ = ShoeboxRoom(SIZE, 0.005).absorption


def test_rejects_places_outside_the_room():
    with pytest.raises(InputError, match=r"talker at \(1, 1, 2.3\) m is outside"):
        ShoeboxRoom(SIZE, 0.0).impulse_responses(torch.tensor([[1.0, 1.0, 2.3]]), microphones())
    with pytest.raises(InputError, match=r"positions must have shape \(7, 3\), got \(6, 3\)"):
        ShoeboxRoom(SIZE, 0.0).render_moving(torch.zeros(7), torch.ones(6, 3), microphones())


def test_missing_extra_names_its_install_line(monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "pyroomacoustics":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r"pip install 'probtrack\[simulation\]'"):
        ShoeboxRoom(SIZE, 0.2).impulse_responses(torch.ones(1, 3), microphones())
