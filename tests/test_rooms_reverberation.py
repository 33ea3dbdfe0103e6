"""How long a room rings: decays of known time, and the times that rooms were asked for."""

import math

import pytest
import scipy.signal
import torch

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray
from probtrack.simulation.rooms import SPEECH, ShoeboxRoom, reverberation_time
from probtrack.simulation.rooms.reverberation import max_order, reach, wall_absorption

FS = 16000
C = 343.0


@pytest.mark.parametrize("fs", [8000, 16000])
def test_time_of_exponential_decays(fs):
    t = torch.arange(fs) / fs
    decays = torch.stack([10 ** (-3 * t / t60) for t60 in (0.13, 0.2, 0.5)])
    torch.testing.assert_close(reverberation_time(decays, fs), torch.tensor([0.13, 0.2, 0.5]), rtol=0.003, atol=0)


def test_time_of_noisy_decays_at_any_level():
    t = torch.arange(FS) / FS
    decays = 1e-3 * torch.randn(2, 3, FS) * 10 ** (-3 * t / 0.4)
    torch.testing.assert_close(reverberation_time(decays, FS), torch.full((2, 3), 0.4), rtol=0.05, atol=0)


def test_a_strong_direct_sound_is_no_part_of_the_decay():
    """The first 5 dB are left out, as ISO 3382-1 has it."""
    h = 10 ** (-3 * torch.arange(FS) / FS / 0.3)
    h[0] = math.sqrt(float(h[1:].square().sum()))  # 3 dB above the rest
    assert float(reverberation_time(h, FS)) == pytest.approx(0.3, rel=0.003)


@pytest.mark.parametrize("value", [0.0, math.nan, math.inf])
def test_what_does_not_decay_has_no_time(value):
    with pytest.raises(InputError, match="response must be finite and decay by 35 dB"):
        reverberation_time(torch.full((2, 100), value), FS)
    with pytest.raises(InputError, match="response must be finite and decay by 35 dB"):
        reverberation_time(torch.tensor([1.0] + [value] * 50), FS)


@pytest.mark.parametrize(
    ("size", "t60"),
    [
        ((3.5, 3.1, 2.2), 0.27),
        ((3.5, 3.1, 2.2), 0.34),
        ((5.5, 6.1, 2.8), 0.5),
        ((2.8, 4.5, 2.6), 0.4),
    ],
)
def test_a_room_has_the_reverberation_time_it_was_asked_for(size, t60):
    pytest.importorskip("pyroomacoustics")
    room, extent = ShoeboxRoom(size, t60), torch.tensor(size)
    array = MicrophoneArray(extent * torch.tensor([[0.38, 0.11, 0.68], [0.77, 0.64, 0.33]]))
    points = extent * torch.tensor([[0.21, 0.83, 0.61], [0.66, 0.23, 0.71], [0.52, 0.47, 0.29], [0.84, 0.58, 0.53]])
    alike = reverberation_time(room.impulse_responses(points, array, FS), FS)
    mouth = torch.tensor([0.3, -2.1, 1.5, 3.0])
    talking = reverberation_time(room.impulse_responses(points, array, FS, directivity=SPEECH, mouth=mouth), FS)
    assert float(alike.mean()) == pytest.approx(t60, rel=0.05)
    assert float(talking.mean()) == pytest.approx(t60, rel=0.07)  # more of what is heard has been to more walls
    for times in (alike, talking):
        torch.testing.assert_close(times, torch.full_like(times, t60), rtol=0.12, atol=0)


def test_reverberation_time_holds_in_octave_bands():
    """Walls that are alike at all frequencies give one time from 500 Hz on, where many modes overlap in a band."""
    pytest.importorskip("pyroomacoustics")
    array = MicrophoneArray([[1.35, 0.29, 1.51], [2.15, 0.31, 1.42], [3.01, 1.95, 1.38]])
    h = ShoeboxRoom((3.5, 3.1, 2.2), 0.3).impulse_responses(torch.tensor([[1.2, 1.7, 1.5], [2.6, 0.7, 1.1]]), array, FS)
    for band in (500, 1000, 2000, 4000):
        sos = scipy.signal.butter(4, [band / math.sqrt(2), band * math.sqrt(2)], "bandpass", fs=FS, output="sos")
        heard = torch.from_numpy(scipy.signal.sosfilt(sos, h.numpy()))
        assert float(reverberation_time(heard, FS).mean()) == pytest.approx(0.3, rel=0.1)


def test_absorption_is_near_eyring_in_a_cube():
    """In a room without a long axis Eyring's formula is right to a tenth or two: 0.161 V / (-S ln(1 - a))."""
    absorption = wall_absorption((4.0, 4.2, 3.9), 0.3, FS, C)
    volume, surface = 4.0 * 4.2 * 3.9, 2 * (4.0 * 4.2 + 4.2 * 3.9 + 4.0 * 3.9)
    assert 0.161 * volume / (-surface * math.log(1 - absorption)) == pytest.approx(0.3, rel=0.2)


def test_shorter_times_need_more_absorption():
    absorption = [wall_absorption((3.5, 3.1, 2.2), t60, FS, C) for t60 in (0.1, 0.2, 0.4)]
    assert absorption == sorted(absorption, reverse=True)


def test_all_images_within_reach_are_within_the_order():
    """Enumerated over twice the order: an image of a higher one is too far from every place in the room."""
    size, t60 = (3.5, 3.1, 2.2), 0.1
    order, far = max_order(size, t60, C), reach(t60, C)
    assert far == pytest.approx(343 * 0.1 * 2 / 3)
    steps = torch.arange(-2 * order, 2 * order + 1)
    rooms = torch.cartesian_prod(steps, steps, steps)
    extent = torch.tensor(size)
    gap = ((rooms.abs() - 1).clamp(min=0) * extent).square().sum(-1).sqrt()  # for a microphone at the wall next to it
    assert int(rooms[gap < far].abs().sum(-1).max()) <= order


@pytest.mark.parametrize("t60", [0.001, 0.005, 0.02])
def test_a_time_too_short_is_one_clear_line(t60):
    with pytest.raises(InputError, match=f"no absorption of its walls gives a t60 of {t60:g} s") as error:
        ShoeboxRoom((3.5, 3.1, 2.2), t60).absorption(FS)
    assert "\n" not in str(error.value)


def test_a_time_too_long_to_compute_names_the_longest():
    with pytest.raises(InputError, match=r"t60 of 5 s .* needs 5e\+08 image sources: the longest .* is about 0.777 s"):
        ShoeboxRoom((3.5, 3.1, 2.2), 5.0).absorption(FS)
    assert max_order((3.5, 3.1, 2.2), 0.777, C) == 114  # 4 / 3 * 114^3 is just below 2 million
