"""Reflections of rectangular rooms, against pyroomacoustics' own summation and a sum over mirrored talkers."""

import builtins
import math

import numpy as np
import pytest
import scipy.signal
import torch
from oracles.mirrored_talkers import SPEECH_BANDS, transfer

from probtrack.geometry import MicrophoneArray
from probtrack.simulation.rooms import LEAD, SPEECH, Directivity, ShoeboxRoom
from probtrack.simulation.rooms.images import DirectionalResponses, Images, harmonics, image_sources

FS = 16000
C = 343.0
SIZE = (3.5, 3.1, 2.2)
ROOM = ShoeboxRoom(SIZE, 0.12)
PLACES = [[1.35, 0.29, 1.51], [2.15, 0.31, 1.42], [3.01, 1.95, 1.38]]
POINTS = [[1.23, 1.71, 1.52], [2.6, 0.55, 0.9]]


def array():
    return MicrophoneArray(PLACES)


def one_image(distance, length=600):
    """Return the response (length,) to a single image at `distance` [m]."""
    images = Images(torch.tensor([[[distance, 0.0, 0.0]]]).float(), torch.ones(1, 1).float())
    return DirectionalResponses(images, None, length, FS, C).at(torch.zeros(3))[0, 0].double()


def at_frequency(response, frequency):
    n = torch.arange(response.shape[-1]) - LEAD
    return (response * torch.exp(-2j * torch.pi * frequency / FS * n)).sum(-1)


def summed_by_pyroomacoustics(point, order):
    """Return the responses (M, L) by pyroomacoustics, reflections filtered as ours are."""
    pra = pytest.importorskip("pyroomacoustics")
    heard = []
    for most in (order, 0):
        material = pra.Material(ROOM.absorption(FS))
        room = pra.ShoeBox(list(SIZE), fs=FS, max_order=most, materials=material, air_absorption=False)
        room.add_source(point)
        room.add_microphone_array(np.array(PLACES).T)
        room.compute_rir()
        heard.append([np.pad(rir[0], (0, 8000 - len(rir[0]))) for rir in room.rir])
    whole, direct = np.array(heard)
    return direct + scipy.signal.lfilter(*scipy.signal.butter(2, 20, "high", fs=FS), whole - direct)


@pytest.mark.parametrize("point", POINTS)
def test_responses_are_those_of_pyroomacoustics(point, monkeypatch):
    """From 5 Hz, so that the high-pass counts, to 6 kHz: its pulses are windowed over 81 samples, ours are not."""
    pra = pytest.importorskip("pyroomacoustics")
    monkeypatch.setitem(pra.parameters._constants, "rir_hpf_enable", False)
    expected = torch.from_numpy(summed_by_pyroomacoustics(point, 24))
    ours = ROOM.impulse_responses(torch.tensor([point]), array(), FS)[0]
    end = ours.shape[-1] - 90  # before the fade
    spectra = [torch.fft.rfft(h[:, :end], 8192) for h in (ours, expected)]
    frequency = torch.fft.rfftfreq(8192, 1 / FS)
    for low, high in ((5, 100), (100, 1000), (1000, 6000)):
        some = (frequency > low) & (frequency < high)
        wanted, error = spectra[1][:, some], (spectra[0] - spectra[1])[:, some]
        assert 10 * torch.log10(error.abs().square().sum(-1) / wanted.abs().square().sum(-1)).max() < -50


class Quadratic(Directivity):
    """A pattern that is a polynomial of the cosine, 0.5 + 0.2 cos + 0.3 cos^2, so that nothing is approximated."""

    def polynomial(self, frequency):
        return frequency.new_tensor([0.5, 0.2, 0.3]).expand(len(frequency), 3)


def quadratic(cosine):
    return 0.5 + 0.2 * cosine + 0.3 * cosine**2


def speech_in(band):
    return lambda cosine: 10 ** (-band[0] * ((1 - cosine) / 2) ** band[1] / 20)


def error_against_mirrored_talkers(directivity, pattern, mouth, frequency):
    """Return the error of all responses at `frequency` relative to their level."""
    mouths = torch.tensor([mouth] * len(POINTS))
    ours = ROOM.impulse_responses(torch.tensor(POINTS), array(), FS, directivity=directivity, mouth=mouths)
    rest = {"end": (ours.shape[-1] - LEAD - 0.5) / FS, "fade": 0.005, "fs": FS, "c": C, "high_pass": 20.0}
    rest["pattern"] = pattern
    expected = torch.tensor(
        [[transfer(frequency, SIZE, ROOM.absorption(FS), p, mouth, m, **rest) for m in PLACES] for p in POINTS]
    )
    return float((at_frequency(ours, frequency) - expected).norm() / expected.norm())


@pytest.mark.parametrize("mouth", [-2.4, 0.5, 1.9])
@pytest.mark.parametrize("frequency", [430.0, 2900.0])
def test_responses_are_those_of_mirrored_talkers(frequency, mouth):
    pytest.importorskip("pyroomacoustics")
    assert error_against_mirrored_talkers(Quadratic((1.0,), (0.0,), (1.0,)), quadratic, mouth, frequency) < 0.003


@pytest.mark.parametrize("mouth", [-2.4, 0.5])
@pytest.mark.parametrize(("frequency", "band"), SPEECH_BANDS.items())
def test_responses_of_speech_are_near_those_of_mirrored_talkers(frequency, band, mouth):
    """The error of the polynomial is 0.7 dB a reflection, 8 %, and less of their sum."""
    pytest.importorskip("pyroomacoustics")
    assert error_against_mirrored_talkers(SPEECH, speech_in(band), mouth, frequency) < 0.08


def test_an_image_is_a_band_limited_pulse():
    distance = 2.0 + torch.linspace(0, 0.3, 57)
    pulses = torch.stack([one_image(d) for d in distance])
    for frequency, atol in ((300.0, 0.002), (3000.0, 0.004), (7000.0, 0.02)):
        exact = torch.exp(-2j * torch.pi * frequency / C * distance) / distance
        ratio = at_frequency(pulses, frequency) / exact
        high_pass = scipy.signal.freqz(*scipy.signal.butter(2, 20, "high", fs=FS), [frequency], fs=FS)[1][0]
        torch.testing.assert_close(ratio, torch.full_like(ratio, complex(high_pass)), rtol=0, atol=atol)
        assert abs(complex(ratio.mean()) - complex(high_pass)) < 0.005  # as a whole the splitting takes nothing


def test_reflections_fall_softly_towards_half_the_rate():
    """Half a cosine from 0.45 to 0.5 of the rate: a steep end rings before and after every arrival."""
    response = one_image(1.0)
    gain = torch.stack([at_frequency(response, f * FS).abs() for f in (0.4, 0.475, 0.49, 0.5)])
    torch.testing.assert_close(gain, torch.tensor([1.0, 0.5, 0.0955, 0.0]), rtol=0, atol=0.01)


def test_reflections_have_no_constant_pressure():
    pytest.importorskip("pyroomacoustics")
    image = image_sources(SIZE, ROOM.absorption(FS), 20, 27.0, torch.tensor(PLACES))
    h = DirectionalResponses(image, None, 3000, FS, C).at(torch.tensor(POINTS[0]))[0]
    assert h.sum(-1).abs().max() < 1e-3 * h.abs().sum(-1).min()


def test_what_arrives_late_is_left_out():
    assert one_image(13.0).abs().max() < 1e-6  # 606 samples and LEAD
    assert one_image(11.99).abs().max() < 0.01  # at the last sample: faded


def test_what_is_near_grows_no_louder_than_at_five_centimetres():
    near, far = (one_image(d, 200) for d in (0.0, 0.05))
    torch.testing.assert_close(near, far)
    assert float(near.max()) < 25


@pytest.mark.parametrize("length", [50, 200, 1500])
def test_responses_end_softly(length):
    pytest.importorskip("pyroomacoustics")
    images = image_sources(SIZE, 0.05, 30, 60.0, torch.tensor(PLACES))
    h = DirectionalResponses(images, None, length, FS, C).at(torch.tensor(POINTS[0]))[0]
    assert h.shape == (3, length)
    assert h[:, -1].abs().max() <= 1e-3 * h[:, -40:-20].abs().max()


def test_nothing_arrives_before_the_first_reflection():
    pytest.importorskip("pyroomacoustics")
    images = image_sources(SIZE, 0.3, 20, 25.0, torch.tensor(PLACES))
    h = DirectionalResponses(images, SPEECH, 1200, FS, C).at(torch.tensor(POINTS[0]))
    first = (images.position - torch.tensor(POINTS[0])).square().sum(-1).sqrt()
    for m, distance in enumerate(first.masked_fill(images.amplitude == 0, torch.inf).amin(-1).tolist()):
        assert h[:, m, : LEAD + int(distance / C * FS) - 20].abs().max() < 0.03 * h[0, m].abs().max()


def test_microphones_are_no_images_of_themselves():
    pytest.importorskip("pyroomacoustics")
    images = image_sources(SIZE, 0.3, 4, 9.0, torch.tensor(PLACES))
    gap = (images.position - torch.tensor(PLACES)[:, None]).square().sum(-1).sqrt()
    assert gap.masked_fill(images.amplitude == 0, torch.inf).min() > 0.1
    number = images.amplitude[images.amplitude > 0].log() / math.log(math.sqrt(0.7))  # of reflections
    torch.testing.assert_close(number, number.round().clamp(1, 4), rtol=0, atol=1e-5)


def test_a_microphone_may_be_in_a_corner():
    pytest.importorskip("pyroomacoustics")
    h = ROOM.impulse_responses(torch.tensor([[0.01, 0.02, 0.0]]), MicrophoneArray([[0.0, 0.0, 0.0], SIZE]), FS)
    assert h.isfinite().all()
    assert h.abs().max() < 255  # what the cache can hold


def test_five_responses_hold_for_every_direction_of_the_mouth():
    pytest.importorskip("pyroomacoustics")
    responses = ROOM.responses(array(), FS, SPEECH, None)((12, 17, 15))
    mouths = torch.tensor([-2.0, -0.6, 0.1, 1.3, 2.8, 3.1])
    heard = torch.einsum("kc,cml->kml", harmonics(mouths), responses.double())
    point = torch.tensor([[1.2, 1.7, 1.5]]).expand(6, 3)
    wanted = ROOM.impulse_responses(point, array(), FS, directivity=SPEECH, mouth=mouths)
    direct = ShoeboxRoom(SIZE, 0.0).impulse_responses(point, array(), FS, directivity=SPEECH, mouth=mouths)
    wanted = wanted.clone()
    length = min(direct.shape[-1], wanted.shape[-1])
    wanted[..., :length] -= direct[..., :length]
    torch.testing.assert_close(heard, wanted[..., : heard.shape[-1]], rtol=0, atol=2e-3)


def test_numbers_do_not_depend_on_the_default_dtype():
    pytest.importorskip("pyroomacoustics")
    in_double = ROOM.responses(array(), FS, SPEECH, None)((12, 17, 15))
    torch.set_default_dtype(torch.float32)
    torch.testing.assert_close(ROOM.responses(array(), FS, SPEECH, None)((12, 17, 15)), in_double)


def test_missing_extra_names_its_install_line(monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "pyroomacoustics":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r"pip install 'probtrack\[simulation\]'"):
        ROOM.impulse_responses(torch.ones(1, 3), array(), FS)
