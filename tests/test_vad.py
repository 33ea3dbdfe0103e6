"""Voice activity: levels, clicks, noise floors, silence, streams."""

import math
import subprocess
import sys

import numpy as np
import pytest
import torch

from probtrack.audio import EnergyVoiceActivity, ShortTimeSpectrum, SileroVoiceActivity
from probtrack.audio.frames import Frames
from probtrack.errors import InputError
from probtrack.simulation.voices import SyntheticVoice, SyntheticVoices, TurnTaking

FS, L, H = 16000, 512, 256


def noise(seconds, *batch, level=0.01):
    return level * torch.randn(*batch, 3, round(seconds * FS))


def talk(seconds, seed):
    """One synthetic man, in turns of people."""
    turns = TurnTaking().draw(1, seconds, torch.Generator().manual_seed(seed))
    return SyntheticVoices((SyntheticVoice(),)).speak(turns, duration=seconds, fs=FS, seed=seed)[0]


def heard(samples, detector=None):
    """P(speech) of samples (*batch, M, n)."""
    return (detector or EnergyVoiceActivity())(ShortTimeSpectrum(L, H)(samples))[0].detach()


def frame(seconds):
    """The first frame that begins at or after a time."""
    return math.ceil(seconds * FS / H)


def in_cuts(detector, frames, cuts):
    """P(speech) of frames given to the detector in pieces that end at `cuts`."""
    pieces, state = [], None
    for start, end in zip([0, *cuts], [*cuts, len(frames.samples)], strict=True):
        speech, state = detector(Frames(frames.samples[start:end], frames.spectrum[start:end]), state)
        pieces.append(speech)
    return torch.cat(pieces)


def direct(samples, *, J=3, W=188, b=8.0, a=1.0, band=(10, 96)):
    """Oracle: the docstring's formulas in a loop, for samples (M, n) without digital silence."""
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(L) / L)
    starts = range(0, samples.shape[1] - L + 1, H)
    power = [np.abs(np.fft.rfft(samples[:, s : s + L] * window)[:, band[0] : band[1] + 1]) ** 2 for s in starts]
    e = [10 * np.log10(p.mean()) for p in power]
    e = [e[0]] * (J - 1) + e
    smooth = [np.mean(e[t : t + J]) for t in range(len(power))]
    floor = [min(smooth[max(0, t - W + 1) : t + 1]) for t in range(len(power))]
    return np.array([1 / (1 + math.exp(-a * (s - f - b))) for s, f in zip(smooth, floor, strict=True)])


@pytest.mark.parametrize(
    ("settings", "oracle"),
    [
        ({}, {}),
        ({"memory": 0.4}, {"W": 25}),
        ({"smoothing": 1, "threshold": 5.0, "slope": 0.4}, {"J": 1, "b": 5.0, "a": 0.4}),
        ({"smoothing": 5, "band": (500.0, 2000.0)}, {"J": 5, "band": (16, 64)}),
    ],
)
def test_speech_is_its_formula(settings, oracle):
    samples = noise(5.0) * (1.2 + torch.sin(3 * torch.arange(80000) / FS)) ** 3
    expected = torch.tensor(direct(samples.numpy(), **oracle))
    torch.testing.assert_close(heard(samples, EnergyVoiceActivity(**settings)), expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("level", [1e-5, 40.0])
def test_level_of_the_recording_plays_no_part(level):
    samples = noise(2.0)
    samples[:, 20000:26000] *= 6
    torch.testing.assert_close(heard(level * samples), heard(samples), rtol=1e-6, atol=1e-9)


def test_noise_is_quiet_and_a_burst_over_it_is_speech():
    samples = noise(4.0)
    samples[:, 2 * FS : 3 * FS] *= 10  # 20 dB
    alpha = heard(samples)
    assert alpha[: frame(2.0) - 2].max() < 0.1
    assert alpha[frame(2.0) + 2 : frame(3.0) - 2].min() > 0.99
    assert alpha[frame(3.0) + 2 :].max() < 0.1


@pytest.mark.parametrize(("gains", "loudest"), [([22.0], 0.5), ([10.5, 10.5], 0.5), ([27.0], 0.99), ([15.0] * 2, 0.99)])
def test_a_click_of_one_or_two_frames_is_spread_over_three(gains, loudest):
    frames = ShortTimeSpectrum()(noise(3.0, level=0.01))
    gain = torch.ones(len(frames.spectrum), 1, 1)
    gain[100 : 100 + len(gains), 0, 0] = 10 ** (torch.tensor(gains) / 20)
    alpha = EnergyVoiceActivity()(Frames(frames.samples, gain * frames.spectrum))[0].detach()
    assert loudest - 0.49 < alpha.max() < loudest
    assert alpha[:99].max() < 0.1
    assert alpha[105:].max() < 0.1


def test_a_click_of_a_sample_stays_quiet():
    x = noise(3.0)
    x[:, 30000] = 0.5  # 34 dB over the samples, some 11 over the frames
    assert heard(x).max() < 0.5


def test_speech_over_noise_is_found():
    x, active, _ = talk(12.0, 1)
    alpha = heard(x + noise(12.0, level=0.0007))
    share = active.double().unfold(0, L, H).mean(-1)
    assert alpha[share == 1].mean() > 0.8
    assert alpha[share == 0].mean() < 0.05


def test_the_floor_follows_falling_noise_at_once_and_rising_noise_after_its_memory():
    x = noise(6.0)
    x[:, : 2 * FS] *= 10
    x[:, 4 * FS :] *= 10
    alpha = heard(x, EnergyVoiceActivity(memory=1.0))
    assert alpha[frame(2.0) + 2 : frame(4.0) - 2].max() < 0.1
    assert alpha[frame(4.0) + 2 : frame(4.95)].min() > 0.9
    assert alpha[frame(5.1) :].max() < 0.1


def test_tones_outside_the_band_are_not_heard():
    x, t = noise(3.0), torch.arange(3 * FS) / FS
    loud = 0.5 * (torch.sin(2 * torch.pi * 100 * t) + torch.sin(2 * torch.pi * 6000 * t)) * (t > 1.5)
    alpha = heard(x + loud)
    assert alpha[: frame(1.5) - 2].max() < 0.1
    assert alpha[frame(1.5) + 2 :].max() < 0.1  # all but the frames of the onset


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (2,)])
def test_stream_in_any_cuts_is_bit_identical(dtype, batch):
    samples = noise(5.0, *batch).to(dtype) * (1 + 5 * (torch.arange(5 * FS) % 20000 < 8000).to(dtype))
    samples[..., 40000:50111] = 0
    frames, detector = ShortTimeSpectrum().to(dtype)(samples), EnergyVoiceActivity().to(dtype)
    whole = detector(frames)[0]
    for _ in range(5):
        cuts = torch.randint(0, len(whole), (9,)).sort().values.tolist()  # some pieces are empty
        assert torch.equal(in_cuts(detector, frames, cuts), whole)
    assert torch.equal(in_cuts(detector, frames, list(range(1, len(whole)))), whole)


def test_recordings_of_a_batch_do_not_mix():
    samples = noise(3.0, 2, 4) * torch.rand(2, 4, 1, 1)
    samples[1, 2, :, 20000:25000] *= 20
    samples[0, 1, :, 15000:30000] = 0
    alpha = heard(samples)
    assert alpha.shape == (186, 2, 4)
    for i, j in [(0, 0), (1, 2), (0, 1)]:
        torch.testing.assert_close(alpha[:, i, j], heard(samples[i, j]))


SILENCES = {"first": (0, 1.3), "midway": (1.2, 1.9), "last": (2.0, 3.0), "throughout": (0, 3.0)}


@pytest.mark.parametrize(("start", "end"), SILENCES.values(), ids=SILENCES)
@pytest.mark.parametrize("shift", [0, 7, 131, 200, 255])  # silence cuts frames anywhere
def test_digital_silence_is_no_speech_and_no_noise_floor(start, end, shift):
    x = noise(3.0)
    x[:, round(start * FS) : round(end * FS) + shift] = 0
    if start:
        x[:, round(start * FS) - shift : round(start * FS)] = 0
    alpha = heard(x)
    assert (alpha[frame(start) : frame(end - L / FS)] == 0).all()
    assert alpha.max() < 0.1  # nor is the noise around it, which would be loud over any dip of the floor


def test_digital_silence_at_one_microphone_is_a_dead_microphone_only():
    x = noise(3.0)
    x[:, FS : 2 * FS] *= 10
    alpha = heard(x)
    x[1] = 0
    assert (heard(x) - alpha)[frame(1.0) + 2 : frame(2.0) - 2].abs().max() < 0.01


@pytest.mark.parametrize(("start", "end"), SILENCES.values(), ids=SILENCES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_around_digital_silence(start, end, dtype):
    x = noise(3.0).to(dtype)
    x[:, round(start * FS) : round(end * FS)] = 0
    x.requires_grad_()
    detector = EnergyVoiceActivity().to(dtype)
    detector(ShortTimeSpectrum().to(dtype)(x))[0].square().sum().backward()
    for grad in (x.grad, detector.threshold.grad, detector.log_slope.grad):
        assert grad.isfinite().all()


def test_gradients():
    samples = (noise(0.3) * (1 + torch.arange(4800) / 2000)).requires_grad_()
    stft, detector = ShortTimeSpectrum(64, 40), EnergyVoiceActivity(frame_length=64, hop=40, threshold=2.0)

    def speech(threshold, log_slope, gain):
        state = {"threshold": threshold, "log_slope": log_slope}
        ramp = 1 + gain * torch.arange(4800) / 2000
        return torch.func.functional_call(detector, state, (stft(samples.detach() * ramp),))[0]

    leaves = [p.detach().clone().requires_grad_() for p in detector.parameters()]
    assert torch.autograd.gradcheck(speech, [*leaves, torch.tensor(0.7, requires_grad=True)])


def test_threshold_and_slope_learn():
    detector, frames = EnergyVoiceActivity(threshold=14.0), ShortTimeSpectrum()(noise(2.0))
    detector(frames)[0].sum().backward()
    assert detector.threshold.grad < 0  # a higher threshold hears less
    assert detector.log_slope.grad != 0


def test_no_frames_change_nothing():
    detector, frames = EnergyVoiceActivity(), ShortTimeSpectrum()(noise(1.0))
    _, state = detector(frames)
    speech, same = detector(ShortTimeSpectrum()(noise(0.001)), state)
    assert speech.shape == (0,)
    assert all(torch.equal(a, b) for a, b in zip(state, same, strict=True))


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"band": (3000.0, 300.0)}, "band must satisfy"),
        ({"memory": 0.0}, "memory must be finite and positive"),
        ({"slope": -1.0}, "slope must be finite and positive"),
        ({"threshold": math.nan}, "threshold must be finite, got nan"),
        ({"smoothing": 0}, "smoothing must be an integer of at least 1"),
    ],
)
def test_rejects_settings(settings, match):
    with pytest.raises(InputError, match=match):
        EnergyVoiceActivity(**settings)


@pytest.fixture
def silero():
    pytest.importorskip("silero_vad")
    return SileroVoiceActivity()


def test_silero_hears_speech_over_noise(silero):
    x, active, _ = talk(8.0, 2)
    alpha = heard((x + noise(8.0, level=0.0007))[:1], silero)
    share = active.double().unfold(0, L, H).mean(-1)
    assert ((alpha >= 0) & (alpha <= 1)).all()
    assert alpha[share == 1].mean() > alpha[share == 0].mean() + 0.3


def test_silero_stream_in_any_cuts_is_the_whole(silero):
    x = talk(3.0, 2).samples
    frames = ShortTimeSpectrum()(torch.stack([x, 0.5 * x + 0.01 * torch.randn(len(x))])[:, None])
    whole = silero(frames)[0]
    assert whole.shape == (186, 2)
    for cuts in ([1, 2, 5, 50, 50, 177], torch.randint(0, 186, (12,)).sort().values.tolist()):
        torch.testing.assert_close(in_cuts(silero, frames, cuts), whole, rtol=0, atol=1e-6)
    torch.testing.assert_close(silero(Frames(*(a[:, 1] for a in frames)))[0], whole[:, 1], rtol=0, atol=1e-5)


@pytest.mark.parametrize("hop", [256, 512, 160])
def test_silero_frame_has_the_last_chunk_that_ended_by_its_end(silero, hop):
    x = talk(2.0, 2).samples.float()
    network, expected = silero.network, [0.0]
    memory, context = torch.zeros(2, 1, 128).float(), torch.zeros(1, 64).float()
    for chunk in x.split(512)[: len(x) // 512]:
        speech, memory = network(torch.cat([context, chunk[None]], 1), memory)
        context = chunk[None, -64:]
        expected.append(float(speech))
    detector = SileroVoiceActivity(hop=hop)
    alpha = detector(ShortTimeSpectrum(512, hop).float()(x[None]))[0]
    ends = [512 + t * hop for t in range(len(alpha))]
    torch.testing.assert_close(alpha, torch.tensor([expected[e // 512] for e in ends]).float(), rtol=0, atol=1e-6)


def test_silero_works_in_a_module_of_any_precision(silero):
    frames = ShortTimeSpectrum()(noise(0.5))
    assert torch.equal(silero.double()(frames)[0], silero.float()(frames)[0])


def test_silero_trains_nothing(silero):
    assert not any(p.requires_grad for p in silero.parameters())


def test_silero_rejects_another_rate():
    with pytest.raises(InputError, match=r"silero-vad works at fs = 16000 Hz, got 8000"):
        SileroVoiceActivity(fs=8000)


def test_silero_missing_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "silero_vad", None)
    with pytest.raises(ImportError, match=r"pip install 'probtrack\[vad\]'"):
        SileroVoiceActivity()


@pytest.mark.slow
@pytest.mark.usefixtures("silero")
def test_silero_leaves_the_number_of_threads_alone():
    code = "import torch; torch.set_num_threads(3); from probtrack.audio import SileroVoiceActivity as S; S(); "
    result = subprocess.run([sys.executable, "-c", code + "print(torch.get_num_threads())"], capture_output=True)
    assert result.stdout.strip() == b"3", result.stderr
