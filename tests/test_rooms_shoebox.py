"""Rectangular rooms: standing, walking and turning talkers, with and without a cache."""

import itertools
import math

import pytest
import torch

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray
from probtrack.simulation.motion import Motion
from probtrack.simulation.rooms import LEAD, SPEECH, ResponseCache, ShoeboxRoom

FS = 16000
SIZE = (3.5, 3.1, 2.2)
ROOM = ShoeboxRoom(SIZE, 0.12)
DRY = ShoeboxRoom(SIZE, 0.0)
POINT = [1.2, 1.7, 1.5]  # of the grid

reverberant = pytest.mark.usefixtures("pyroomacoustics")


@pytest.fixture
def pyroomacoustics():
    return pytest.importorskip("pyroomacoustics")


def array():
    return MicrophoneArray([[1.35, 0.29, 1.51], [2.15, 0.31, 1.42], [3.01, 1.95, 1.38]], "three")


def motion(position, mouth=0.0):
    mouth = torch.as_tensor(mouth).expand(len(position))
    return Motion(position, torch.zeros_like(position), mouth, mouth)


def standing(size, mouth=0.0, point=POINT):
    return motion(torch.tensor(point).expand(size, 3), mouth)


def walk(size):
    """Return 1 m in a second, along a curve."""
    t = torch.arange(size) / FS
    return torch.stack([0.7 + 0.9 * t, 1.2 + 0.4 * torch.sin(2.2 * t), 1.5 + 0.05 * torch.sin(5 * t)], -1)


def tone(frequency, size):
    t = torch.arange(size) / FS
    return torch.sin(2 * torch.pi * frequency * t) * torch.sin(torch.pi * t / t[-1]) ** 2


def off_tone_db(audio, frequency, width):
    power = torch.fft.rfft(audio * torch.blackman_window(audio.shape[-1])).abs().square()
    away = (torch.arange(power.shape[-1]) * FS / audio.shape[-1] - frequency).abs() > width
    return float(10 * torch.log10(power[:, away].amax(-1) / power.amax(-1)).max())


def convolved(signal, responses):
    size = len(signal) + responses.shape[-1]
    heard = torch.fft.irfft(torch.fft.rfft(signal, size) * torch.fft.rfft(responses, size), size)
    return heard[..., LEAD : LEAD + len(signal)]


def below_7_khz(audio):
    return torch.fft.rfft(audio)[..., : audio.shape[-1] * 7 // 16]


@reverberant
@pytest.mark.parametrize(("directivity", "mouth"), [(None, None), (SPEECH, 2.5)])
def test_standing_talker_is_heard_through_the_impulse_response(directivity, mouth):
    signal = torch.randn(4000)
    audio = ROOM.render(signal, standing(4000, mouth or 0.0), array(), FS, directivity=directivity)
    mouths = None if mouth is None else torch.tensor([mouth])
    h = ROOM.impulse_responses(torch.tensor([POINT]), array(), FS, directivity=directivity, mouth=mouths)[0]
    expected = below_7_khz(convolved(signal, h))
    assert (below_7_khz(audio) - expected).abs().square().mean() < 1e-4 * expected.abs().square().mean()


@reverberant
def test_direct_sound_is_exact_where_reflections_are_those_of_the_grid():
    signal, place = torch.randn(4000), [1.23, 1.67, 1.54]
    audio = ROOM.render(signal, standing(4000, point=place), array(), FS)
    direct = DRY.render(signal, standing(4000, point=place), array(), FS)
    whole, alone = (room.impulse_responses(torch.tensor([POINT]), array(), FS)[0] for room in (ROOM, DRY))
    whole[:, : alone.shape[-1]] -= alone
    expected = below_7_khz(direct + convolved(signal, whole))
    assert (below_7_khz(audio) - expected).abs().square().mean() < 1e-4 * expected.abs().square().mean()


@reverberant
@pytest.mark.parametrize("spacing", [0.1, 0.05])
def test_moving_reverberant_tone_has_no_clicks(spacing):
    room = ShoeboxRoom(SIZE, 0.12, spacing=spacing)
    audio = room.render(tone(700.0, 2 * FS), motion(walk(2 * FS)), array(), FS)
    assert off_tone_db(audio, 700.0, 200) < -60


@reverberant
def test_a_turning_mouth_in_a_room_makes_no_clicks():
    mouth = torch.linspace(-math.pi, 3 * math.pi, 2 * FS).remainder(2 * math.pi)
    audio = ROOM.render(tone(700.0, 2 * FS), standing(2 * FS, mouth), array(), FS, directivity=SPEECH)
    assert off_tone_db(audio, 700.0, 30) < -80


@reverberant
def test_a_mouth_that_turned_is_heard_through_the_response_of_its_new_direction():
    signal, mouth = torch.randn(8000), torch.where(torch.arange(8000) < 4000, 0.3, -2.2)
    signal[3000:5000] = 0
    audio = ROOM.render(signal, standing(8000, mouth), array(), FS, directivity=SPEECH)
    points = torch.tensor([POINT] * 2)
    h = ROOM.impulse_responses(points, array(), FS, directivity=SPEECH, mouth=torch.tensor([0.3, -2.2]))
    early, late = (torch.where(some, signal, 0.0) for some in (mouth > 0, mouth < 0))
    expected = below_7_khz(convolved(early, h[0]) + convolved(late, h[1]))
    assert (below_7_khz(audio) - expected).abs().square().mean() < 1e-4 * expected.abs().square().mean()


def spectra(audio):
    """Return the mean cross spectra (M, M, bands) of frames of 512 samples in octave bands from 250 Hz to 4 kHz."""
    frames = torch.fft.rfft(audio.unfold(-1, 512, 256) * torch.hann_window(512))
    cross = torch.einsum("mtf,ntf->mnf", frames, frames.conj())
    edges = [round(f * 512 / FS) for f in (177, 354, 707, 1414, 2828, 5657)]
    return torch.stack([cross[..., a:b].sum(-1) for a, b in itertools.pairwise(edges)], -1)


def reverberation(room, signal, moving, microphones):
    """Return the reflections only."""
    dry = ShoeboxRoom(room.size, 0.0)
    return room.render(signal, moving, microphones, FS) - dry.render(signal, moving, microphones, FS)


@reverberant
def test_a_walking_talker_is_heard_as_loud_as_a_standing_one():
    """Reflections of noise from a walk, against the mean energy of responses from along it: half a decibel less."""
    signal, moving = torch.randn(2 * FS), motion(walk(2 * FS))
    heard = torch.diagonal(spectra(reverberation(ROOM, signal, moving, array()))).T.real.mean(0)
    points = moving.position[::800]
    h, direct = (room.impulse_responses(points, array(), FS) for room in (ROOM, DRY))
    h[..., : direct.shape[-1]] -= direct
    apart = torch.fft.rfft(h, 8192).abs().square().mean((0, 1))
    edges = [177 * 2**k * 8192 // FS for k in range(6)]
    gain = torch.stack([apart[a:b].mean() for a, b in itertools.pairwise(edges)])
    level = 10 * torch.log10(heard / (gain * spectra(signal[None])[0, 0].real))
    assert level[:3].abs().max() < 0.8
    assert level[3:].mean() == pytest.approx(-0.5, abs=0.4)


@reverberant
def test_a_finer_grid_gives_the_same_energy_and_coherence():
    """Of the reflections of noise from a walk: energy in octave bands, complex coherence of all pairs.

    While two points fade into each other, what is not alike in their responses loses up to half its energy: half the
    time at 1 m/s, 0.6 dB on the whole, however fine the grid.
    """
    near = MicrophoneArray([[1.35, 0.29, 1.51], [1.40, 0.31, 1.51], [3.01, 1.95, 1.38]])
    signal = torch.randn(2 * FS)
    coarse, fine = (
        spectra(reverberation(ShoeboxRoom(SIZE, 0.12, spacing=s), signal, motion(walk(2 * FS)), near))
        for s in (0.1, 0.025)
    )
    power = [torch.diagonal(cross).T.real for cross in (coarse, fine)]
    assert (10 * torch.log10(power[0].mean(0) / power[1].mean(0))).abs().max() < 1.0
    coherence = [cross / (p[:, None] * p[None]).sqrt() for cross, p in zip((coarse, fine), power, strict=True)]
    assert (coherence[0] - coherence[1]).abs().max() < 0.1
    assert coherence[1][0, 1, 0].abs() > 0.8  # 5 cm apart at 250 Hz


@reverberant
def test_warm_and_cold_cache_and_none_give_identical_bits(tmp_path, monkeypatch):
    cache, signal = ResponseCache(tmp_path), torch.randn(8000)
    moving = motion(walk(8000), torch.linspace(0, 2, 8000))

    def heard(cache):
        return ROOM.render(signal, moving, array(), FS, directivity=SPEECH, cache=cache)

    none, cold = heard(None), heard(cache)
    monkeypatch.setattr("probtrack.simulation.rooms.shoebox.image_sources", None)  # nothing is computed again
    warm = heard(ResponseCache(tmp_path))
    assert torch.equal(none, cold)
    assert torch.equal(cold, warm)
    assert {path.stem for path in tmp_path.rglob("*.npy")} == {
        "_".join(map(str, node)) for node in ROOM.nodes(moving.position)
    }


def test_every_place_is_within_half_a_cell_of_its_grid_point():
    room = ShoeboxRoom((3.54, 3.1, 2.26), 0.1)
    places = torch.cat([torch.rand(500, 3), torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)]) * torch.tensor(
        room.size
    )
    for place in places:
        (node,) = room.nodes(place)
        assert (torch.tensor(node) * 0.1 - place).abs().max() < 0.05 + 1e-9


@reverberant
def test_points_on_a_wall_are_heard_from_two_centimetres_before_it():
    room = ShoeboxRoom((3.54, 3.1, 2.2), 0.12)
    of = room.responses(array(), FS, None, None)
    inside = torch.tensor([[0.02, 1.7, 1.5], [3.52, 1.7, 1.5]])  # the grid's last is at 3.5
    h = room.impulse_responses(inside, array(), FS)
    direct = ShoeboxRoom(room.size, 0.0).impulse_responses(inside, array(), FS)
    h[..., : direct.shape[-1]] -= direct
    torch.testing.assert_close(of((0, 17, 15))[0].to(h), h[0, :, : of((0, 17, 15)).shape[-1]], rtol=0, atol=1e-3)
    assert of((35, 31, 22)).isfinite().all()


@reverberant
def test_silence_stays_silent():
    assert torch.equal(ROOM.render(torch.zeros(500), standing(500), array(), FS), torch.zeros(3, 500))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((3.5, 3.1), 0.2), "size must be three positive lengths"),
        (((3.5, 3.1, -2.2), 0.2), "size must be three positive lengths"),
        (((3.5, math.nan, 2.2), 0.2), "size must be three positive lengths"),
        ((SIZE, -0.1), "t60 must be finite and not negative, got -0.1"),
        ((SIZE, math.nan), "t60 must be finite and not negative, got nan"),
        ((SIZE, 0.2, 0.0), "spacing must be finite and at least 0.01 m, got 0.0"),
        ((SIZE, 0.2, 0.1, -1.0), r"speed_of_sound must be finite and positive, got -1.0"),
    ],
)
def test_rejects_bad_room(arguments, message):
    with pytest.raises(InputError, match=message):
        ShoeboxRoom(*arguments)


@pytest.mark.parametrize("room", [ROOM, DRY])
def test_rejects_what_is_outside_the_room(room):
    with pytest.raises(InputError, match=r"talker at \(1, 1, 2.3\) m is outside the room of \(3.5, 3.1, 2.2\) m"):
        room.render(torch.randn(5), standing(5, point=[1.0, 1.0, 2.3]), array(), FS)
    with pytest.raises(InputError, match=r"talker at \(1, nan, 1\) m is outside"):
        room.impulse_responses(torch.tensor([[1.0, math.nan, 1.0]]), array(), FS)
    low = MicrophoneArray([[1.0, 1.0, 1.0], [1.0, 1.0, -0.1]], "table")
    with pytest.raises(InputError, match=r"table: microphone at \(1, 1, -0.1\) m is outside"):
        room.render(torch.randn(5), standing(5), low, FS)
    flat = MicrophoneArray([[1.0, 1.0], [1.0, 0.9]], "plane")
    with pytest.raises(InputError, match=r"plane: microphone positions must have shape \(..., 3\), got \(2, 2\)"):
        room.impulse_responses(torch.ones(1, 3), flat, FS)


@pytest.mark.parametrize(
    ("signal", "moving", "fs", "message"),
    [
        (7, standing(6), FS, r"motion must have positions \(7, 3\) and mouths \(7,\), got \(6, 3\) and \(6,\)"),
        (0, standing(0), FS, r"signal must have shape \(S,\) with S > 0, got \(0,\)"),
        (7, standing(7), 0, "fs must be an integer of at least 1, got 0"),
        (7, standing(7, mouth=math.nan), FS, "mouth must be finite"),
    ],
)
def test_rejects_sound_that_does_not_fit(signal, moving, fs, message):
    with pytest.raises(InputError, match=message):
        DRY.render(torch.ones(signal), moving, array(), fs)


def test_a_nan_in_the_signal_goes_no_further():
    with pytest.raises(InputError, match="signal must be finite"):
        DRY.render(torch.full((7,), math.nan), standing(7), array(), FS)
