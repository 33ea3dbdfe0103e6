"""Correlations of pairs: the delay and its sign, the scale, the weighting, silence."""

import itertools

import numpy as np
import pytest
import torch
from oracles.steering import delayed
from properties import assert_gradients

from probtrack.audio import GeneralisedCrossCorrelation, ShortTimeSpectrum
from probtrack.errors import InputError, ShapeError
from probtrack.geometry import MicrophoneArray

FS, L = 16000, 512
POSITIONS = [[0.31, -0.2], [0.52, 0.04], [0.27, 0.15], [0.05, -0.11]]


def correlation(positions=POSITIONS, **settings):
    return GeneralisedCrossCorrelation(MicrophoneArray(positions), **settings)


def lags(gcc):
    return (torch.arange(gcc.num_lags) - gcc.num_lags // 2) / gcc.lag_rate


def spectra(*shape):
    return torch.randn(*shape, L // 2 + 1, dtype=torch.complex128)


def direct(spectrum, lag, whitening=1.0, weight=1.0, band=(10, 96)):
    """Oracle: the docstring's formula for one frame (M, F) and one lag, (P,)."""
    f = np.arange(band[0], band[1] + 1)
    y = spectrum[:, f] / np.abs(spectrum[:, f]) ** whitening
    phase = np.exp(2j * np.pi * f * FS / L * lag)
    total = len(y) * (weight * np.abs(y) ** 2).sum()
    pairs = itertools.combinations(range(len(y)), 2)
    return np.array([2 * (weight * y[i] * y[j].conj() * phase).real.sum() / total for i, j in pairs])


@pytest.mark.parametrize("whitening", [1.0, 0.0, 0.6])
def test_correlation_is_its_formula_at_every_lag(whitening):
    gcc, spectrum = correlation(), spectra(3, 4)
    with torch.no_grad():
        gcc.whitening.fill_(whitening)
        gcc.log_weight.copy_(0.5 * torch.randn(87))
    R = gcc(spectrum)
    assert R.shape == (3, 6, gcc.num_lags)
    for k in (0, 7, gcc.num_lags - 1):
        exact = direct(spectrum[1].numpy(), float(lags(gcc)[k]), whitening, gcc.log_weight.detach().exp().numpy())
        torch.testing.assert_close(R[1, :, k].detach(), torch.tensor(exact))


def test_lags_reach_one_beyond_the_largest_delay():
    array = MicrophoneArray([[0.1, 0.2], [0.4, 0.6], [0.2, 0.2]])  # 0.5 m
    gcc = GeneralisedCrossCorrelation(array, oversampling=3, speed_of_sound=340.0)
    assert gcc.lag_rate == 48000
    assert lags(gcc)[-1] == pytest.approx((np.ceil(0.5 / 340 * 48000) + 1) / 48000)
    assert lags(gcc)[0] == -lags(gcc)[-1]


@pytest.mark.parametrize("samples", [2.37, -3.81, 0.0])
def test_peak_is_at_the_delay_of_the_first_less_that_of_the_second(samples):
    gcc = correlation([[0.3, 0.1], [0.4, 0.05]], oversampling=16, band=(300.0, 7000.0))
    heard = delayed(torch.randn(8192).numpy(), [[10.0 + samples], [10.0]] / np.array(FS), FS).squeeze()
    R = gcc(ShortTimeSpectrum(L, L)(torch.tensor(heard)).spectrum).mean(0)[0]
    # half a step of the grid; what enters and leaves the frame makes noise far below that
    assert abs(float(lags(gcc)[R.argmax()]) * FS - samples) <= 0.5 / 16 + 1e-9


@pytest.mark.parametrize("whitening", [1.0, 0.0])
def test_power_is_between_nothing_and_all(whitening):
    gcc = correlation()
    with torch.no_grad():
        gcc.whitening.fill_(whitening)
    P = 1 / 4 + gcc(spectra(50, 4)).sum(-2)
    assert P.min() >= 0
    assert P.max() <= 1


@pytest.mark.parametrize("whitening", [1.0, 0.0])
def test_the_same_everywhere_is_all_the_power_at_lag_zero(whitening):
    gcc = correlation()
    with torch.no_grad():
        gcc.whitening.fill_(whitening)
    P = 1 / 4 + gcc(spectra(1, 1).expand(1, 4, L // 2 + 1)).sum(-2)[0]
    torch.testing.assert_close(P[gcc.num_lags // 2], torch.tensor(1.0))


@pytest.mark.parametrize("whitening", [1.0, 0.0, 0.7])
def test_level_of_the_recording_plays_no_part(whitening):
    gcc, spectrum = correlation(), spectra(2, 4)
    with torch.no_grad():
        gcc.whitening.fill_(whitening)
    for level in (1e-5, 300.0):
        torch.testing.assert_close(gcc(level * spectrum), gcc(spectrum), rtol=1e-6, atol=1e-9)


def test_phat_ignores_every_magnitude_and_plain_correlation_does_not():
    gcc, spectrum = correlation(), spectra(2, 4)
    louder = spectrum * torch.rand(2, 4, L // 2 + 1).add(0.1)
    torch.testing.assert_close(gcc(louder), gcc(spectrum))
    with torch.no_grad():
        gcc.whitening.zero_()
    assert (gcc(louder) - gcc(spectrum)).abs().max() > 0.01


def test_only_the_band_is_heard():
    gcc, spectrum = correlation(), spectra(2, 4)
    changed = spectrum.clone()
    changed[..., :10], changed[..., 97:] = 5.0, -1.0
    assert torch.equal(gcc(changed), gcc(spectrum))
    changed[..., 96] *= 1j * torch.randn(2, 4)
    assert not torch.equal(gcc(changed), gcc(spectrum))


def test_a_bin_of_no_weight_is_not_heard():
    gcc, spectrum = correlation(), spectra(2, 4)
    with torch.no_grad():
        gcc.log_weight[20] = -torch.inf
    changed = spectrum.clone()
    changed[..., 30] = torch.randn(2, 4)
    torch.testing.assert_close(gcc(changed), gcc(spectrum))


def test_swapping_two_microphones_turns_their_lag_round():
    gcc, spectrum = correlation([[0.3, 0.1], [0.5, 0.15]]), spectra(3, 2)
    torch.testing.assert_close(gcc(spectrum.flip(-2)), gcc(spectrum).flip(-1))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("whitening", [1.0, 0.0, 2.0])
def test_digital_silence_correlates_with_nothing(dtype, whitening):
    gcc, spectrum = correlation().to(dtype), spectra(2, 4).to(dtype.to_complex())
    with torch.no_grad():
        gcc.whitening.fill_(whitening)
    assert (gcc(torch.zeros_like(spectrum)) == 0).all()
    spectrum[:, 1] = 0  # one dead microphone: pairs 01, 12, 13
    R = gcc(spectrum)
    assert (R[:, [0, 3, 4]] == 0).all()
    assert R[:, [1, 2, 5]].isfinite().all()
    assert (R[:, [1, 2, 5]] != 0).any()


def test_a_dead_microphone_leaves_the_power_between_nothing_and_all():
    gcc = correlation()
    spectrum = spectra(1, 1).repeat(1, 4, 1)
    spectrum[:, 1] = 0
    P = 1 / 4 + gcc(spectrum).sum(-2)
    torch.testing.assert_close(P.max(), torch.tensor(3 / 4))  # three of four microphones agree


def test_gradients():
    gcc = correlation([[0.3, 0.1], [0.4, 0.05], [0.35, 0.2]], fs=2000, frame_length=64, band=(100.0, 900.0))
    with torch.no_grad():
        gcc.whitening.fill_(0.8)
    samples = torch.randn(3, 64)
    assert_gradients(gcc, lambda model, x: model(torch.fft.rfft(x)[None]), samples)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_of_digital_silence_are_finite(dtype):
    gcc, samples = correlation().to(dtype), torch.randn(4, 1500).to(dtype)
    samples[:, 600:] = 0
    samples[2] = 0
    samples.requires_grad_()
    gcc(ShortTimeSpectrum().to(dtype)(samples).spectrum).square().sum().backward()
    for grad in (samples.grad, gcc.whitening.grad, gcc.log_weight.grad):
        assert grad.isfinite().all()
    assert gcc.log_weight.grad.abs().min() > 0
    assert gcc.whitening.grad != 0


def test_float32_is_close_to_float64_at_faint_and_loud_levels():
    gcc, spectrum = correlation(), spectra(5, 4)
    exact = gcc(spectrum)
    for level in (1e-5, 1e4):  # 24-bit noise, full scale
        rough = correlation().float()((level * spectrum).to(torch.complex64))
        torch.testing.assert_close(rough.double(), exact, rtol=0, atol=1e-5)


def test_state_dict_holds_what_is_learnt():
    gcc, spectrum = correlation(), spectra(2, 4)
    with torch.no_grad():
        gcc.whitening.fill_(0.4)
        gcc.log_weight.normal_()
    again = correlation()
    assert set(gcc.state_dict()) == {"whitening", "log_weight"}
    again.load_state_dict(gcc.state_dict())
    assert torch.equal(again(spectrum), gcc(spectrum))


def test_leading_axes_are_any():
    gcc, spectrum = correlation(), spectra(2, 3, 5, 4)
    R = gcc(spectrum)
    assert R.shape == (2, 3, 5, 6, gcc.num_lags)
    torch.testing.assert_close(R[1, 2, 3], gcc(spectrum[1, 2, 3]))
    assert gcc(spectra(0, 4)).shape == (0, 6, gcc.num_lags)


@pytest.mark.parametrize("shape", [(5, L // 2 + 1), (4, 129), (4, 513)])
def test_rejects_a_spectrum_of_other_microphones_or_frames(shape):
    with pytest.raises(ShapeError, match=r"spectrum must have shape \(\.\.\., 4, 257\), got"):
        correlation()(torch.zeros(2, *shape, dtype=torch.complex128))


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"oversampling": 0}, "oversampling must be an integer of at least 1"),
        ({"speed_of_sound": 0.0}, "speed_of_sound must be finite and positive"),
        ({"fs": 4000}, r"band must satisfy 0 <= low < high <= fs / 2 = 2000 Hz, got 300 to 3000"),
    ],
)
def test_rejects_settings(settings, match):
    with pytest.raises(InputError, match=match):
        correlation(**settings)
