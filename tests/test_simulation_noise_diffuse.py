"""Sound fields from everywhere: their coherence, power and colour, measured."""

import math

import pytest
import soundfile
import torch

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray
from probtrack.simulation.noise import DiffuseNoise
from probtrack.simulation.rooms import ShoeboxRoom

ROOM = ShoeboxRoom((4.0, 3.0, 2.5), 0.0)
FS, FRAME = 4000, 256


def array():
    return MicrophoneArray([[1.1, 0.9, 1.2], [1.15, 0.93, 1.2], [1.31, 0.8, 1.33]])


def generator(seed=3):
    return torch.Generator().manual_seed(seed)


def cross_spectra(audio, frame=FRAME):
    """Averages (F, M, M) over frames that do not overlap, and how many they are."""
    frames = audio.unfold(-1, frame, frame) * torch.hann_window(frame, periodic=False)
    spectra = torch.fft.rfft(frames)  # (M, K, F)
    return torch.einsum("mkf,nkf->fmn", spectra, spectra.conj()) / spectra.shape[1], spectra.shape[1]


def measured_coherence(audio, frame=FRAME):
    cross, count = cross_spectra(audio, frame)
    power = torch.diagonal(cross, dim1=1, dim2=2).real
    return cross / (power[:, :, None] * power[:, None]).sqrt(), count


def plane_waves(array, frequency, cylindrical):
    """Mean of exp(i k d) over directions: over the sphere by its height and turn, or around the circle."""
    turn = (torch.arange(400) + 0.5) / 400 * 2 * torch.pi
    height = torch.zeros(1) if cylindrical else (torch.arange(400) + 0.5) / 200 - 1
    radius = (1 - height[:, None] ** 2).sqrt()
    ways = radius * turn.cos(), radius * turn.sin(), height[:, None].expand(-1, 400)
    x = array.positions
    lag = torch.stack(ways, -1).reshape(-1, 3) @ (x[:, None] - x).reshape(-1, 3).T / 343.0
    return torch.cos(2 * torch.pi * frequency * lag).mean(0).reshape(len(x), len(x))


@pytest.mark.parametrize("cylindrical", [False, True])
@pytest.mark.parametrize("frequency", [0.0, 170.0, 633.0, 1900.0])
def test_formula_is_the_mean_over_plane_waves(frequency, cylindrical):
    flat = MicrophoneArray(array().positions * torch.tensor([1.0, 1.0, 0.0]))  # cylindrical waves see no height
    coherence = DiffuseNoise(cylindrical=cylindrical).coherence(flat, torch.tensor([frequency]))[0]
    torch.testing.assert_close(coherence, plane_waves(flat, frequency, cylindrical), rtol=0, atol=1e-4)


@pytest.mark.parametrize("cylindrical", [False, True])
def test_coherence_of_every_pair_is_that_of_the_field(cylindrical):
    noise = DiffuseNoise(cylindrical=cylindrical)
    audio = noise.draw(ROOM, array(), 4000 * FRAME, FS, generator())
    measured, count = measured_coherence(audio)
    expected = noise.coherence(array(), torch.fft.rfftfreq(FRAME, 1 / FS))
    spread = ((1 - expected**2) / (2 * count)).sqrt()  # of either part, Carter 1987; there are 3 pairs x 129 bins
    bias = 0.01  # sound that takes 0.8 ms from one to the other falls out of frames of 64 ms
    edge = slice(2, -2)  # where the mirrored frequencies leak in
    assert ((measured.real - expected).abs() < 5 * spread + bias)[edge].all()
    assert (measured.imag.abs() < 5 * spread + bias)[edge].all()


def test_coherence_of_wide_arrays_follows_its_fast_turns():
    wide = MicrophoneArray([[0.5, 0.5, 1.0], [3.2, 1.9, 1.0], [3.4, 2.0, 1.1]])
    frame = 2048
    audio = DiffuseNoise().draw(ROOM, wide, 1500 * frame, FS, generator())
    measured, count = measured_coherence(audio, frame)
    d = float(torch.dist(wide.positions[0], wide.positions[1]))
    argument = 2 * torch.pi * torch.fft.rfftfreq(frame, 1 / FS)[2:-2] * d / 343
    error = measured[2:-2, 0, 1] - torch.sin(argument) / argument
    assert error.abs().max() < 5 / math.sqrt(count) + 0.01
    # the mean over the turns is 30 times as sharp
    weight = torch.sin(argument) / argument
    assert abs((error.real * weight).sum() / weight.square().sum()) < 0.05


def test_mixing_has_the_coherence_between_its_knots_too():
    wide = MicrophoneArray([[0.5, 0.5, 1.0], [3.2, 1.9, 1.0], [0.6, 0.5, 1.1]])
    bins, noise = 5001, DiffuseNoise()
    each = torch.eye(3, dtype=torch.complex128)[:, :, None].expand(3, 3, bins)
    mixing = torch.stack([noise._mixed(one, wide, 2000.0) for one in each], -1).real  # (M, F, sources)
    mixing = mixing.transpose(0, 1)
    power = mixing @ mixing.mT
    torch.testing.assert_close(torch.diagonal(power, dim1=1, dim2=2), torch.ones(bins, 3))
    expected = noise.coherence(wide, torch.linspace(0, 2000, bins))
    torch.testing.assert_close(power, expected, rtol=0, atol=0.005)


def test_power_and_spectrum_are_those_of_each_microphone():
    audio = DiffuseNoise(spectrum="pink").draw(ROOM, array(), 4000 * FRAME, FS, generator())
    cross, count = cross_spectra(audio)
    power = torch.diagonal(cross, dim1=1, dim2=2).real  # (F, M)
    frequency = torch.fft.rfftfreq(FRAME, 1 / FS)[4:-2]
    level = 10 * torch.log10(power[4:-2] * frequency[:, None])
    assert (level - level.mean()).abs().max() < 4.34 * 5 / math.sqrt(count) + 0.1
    assert audio.square().mean() == pytest.approx(1.0)


def test_every_microphone_hears_the_same_power():
    eight = MicrophoneArray(torch.rand(8, 3))
    audio = DiffuseNoise().draw(ROOM, eight, 8 * 16000, 16000, generator())
    torch.testing.assert_close(audio.square().mean(1), torch.ones(8), rtol=0, atol=5 * math.sqrt(2 / 128000))


def test_a_recording_is_spread_over_the_field(tmp_path):
    coloured = torch.randn(20 * FS).cumsum(0) * 0.01
    soundfile.write(tmp_path / "hum.wav", (coloured - coloured.mean()).diff(append=coloured[-1:]).numpy(), FS)
    noise = DiffuseNoise(file=str(tmp_path / "hum.wav"))
    audio = noise.draw(ROOM, array(), 6 * FS, FS, generator())
    measured, count = measured_coherence(audio, 128)
    expected = noise.coherence(array(), torch.fft.rfftfreq(128, 1 / FS))
    assert (measured.real - expected)[2:-2].abs().max() < 5 / math.sqrt(2 * count) + 0.03
    torch.testing.assert_close(audio.square().mean(1), torch.ones(3), rtol=0, atol=0.05)


def test_two_axes_and_three_give_the_same_field():
    flat = [[0.3, 0.1], [0.35, 0.2], [0.1, 0.4]]
    deep = MicrophoneArray([[*row, 1.3] for row in flat])
    two, three = (DiffuseNoise().draw(ROOM, a, 900, FS, generator()) for a in (MicrophoneArray(flat), deep))
    torch.testing.assert_close(two, three)


def test_a_seed_gives_the_same_noise():
    one, again, other = (DiffuseNoise("speech").draw(ROOM, array(), 800, FS, generator(s)) for s in (1, 1, 2))
    assert torch.equal(one, again)
    assert abs((one * other).mean()) < 0.5


def test_what_cannot_be_is_said(tmp_path):
    with pytest.raises(InputError, match="spectrum must be one of white, pink, speech, fan, got 'blue'"):
        DiffuseNoise(spectrum="blue")
    with pytest.raises(InputError, match="speed_of_sound must be finite and positive"):
        DiffuseNoise(speed_of_sound=0.0)
    soundfile.write(tmp_path / "short.wav", torch.randn(FS).numpy(), FS)
    with pytest.raises(InputError, match=r"at least 1\.5 s to sound independent at 3 microphones, got 1 s"):
        DiffuseNoise(file=str(tmp_path / "short.wav")).draw(ROOM, array(), 800, FS, generator())
