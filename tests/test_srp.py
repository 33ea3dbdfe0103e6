"""Steered power from tables: against steering every frequency, at the source, in every shape."""

import numpy as np
import pytest
import torch
from oracles.steering import phat_frames, spherical_wave, steered_power
from properties import assert_gradients

from probtrack.audio import GeneralisedCrossCorrelation, ShortTimeSpectrum, SteeredResponsePower
from probtrack.errors import InputError, ShapeError
from probtrack.geometry import MicrophoneArray, Region

FS, L = 16000, 512
FLAT = [[0.31, -0.2], [0.92, 0.04], [0.27, 0.55], [-0.45, 0.11], [1.2, 0.7]]
LEVEL = [[x, y, 1.3] for x, y in FLAT]
SPATIAL = [[x, y, 1.3 + 0.3 * x * y - 0.1 * i] for i, (x, y) in enumerate(FLAT)]


def beamformer(positions, **settings):
    """Correlator and steered power of an array that fit each other."""
    array = MicrophoneArray(positions)
    gcc = GeneralisedCrossCorrelation(array)
    return gcc, SteeredResponsePower(array, lag_rate=gcc.lag_rate, num_lags=gcc.num_lags, **settings)


def tables(power, *batch):
    """Any numbers as correlations, (*batch, P, K)."""
    return 0.1 * torch.randn(*batch, power.num_pairs, power.num_lags)


def sound(kind, positions, point):
    """Samples (M, 3000) of noise at every microphone, or of one source of noise with a little of it."""
    rng = np.random.default_rng(1)
    noise = rng.standard_normal((len(positions), 3000))
    if kind == "noise":
        return noise
    heard = spherical_wave(rng.standard_normal(3000), point, np.array(positions), FS)
    return heard + 0.05 * noise


CASES = {  # microphones, axes of the points, height they are given by, height they have
    "2-D": (FLAT, 2, None, None),
    "3-D, in the plane of the array": (LEVEL, 2, None, 1.3),
    "3-D, in another plane": (LEVEL, 2, 1.65, 1.65),
    "3-D, in the plane of the centre": (SPATIAL, 2, None, float(np.mean(SPATIAL, 0)[2])),
    "3-D": (SPATIAL, 3, None, None),
}


@pytest.mark.parametrize("kind", ["noise", "source"])
@pytest.mark.parametrize(("positions", "axes", "height", "z"), CASES.values(), ids=CASES)
def test_power_is_that_of_direct_steering(kind, positions, axes, height, z):
    samples = sound(kind, positions, np.array([1.4, 1.7, 1.3 if z is None else z])[: len(positions[0])])
    gcc, power = beamformer(positions, height=height)
    R = gcc(ShortTimeSpectrum(L, 256)(torch.tensor(samples)).spectrum)
    points = torch.rand(80, axes) * 4 - 1
    table = power(R[:, :], points.expand(len(R), 80, axes)).detach().numpy()
    spectra, microphones = phat_frames(samples, L, 256), np.array(positions)
    full = points.numpy() if z is None or axes == 3 else np.c_[points.numpy(), np.full(80, z)]
    direct = np.stack([steered_power(spectra, microphones, p, fs=FS, length=L) for p in full], -1)
    direct /= 87 * len(positions) ** 2  # bins of the band times M^2: all in phase
    assert np.abs(table - direct).max() < 0.005  # of the largest power possible, the class's own claim
    assert np.abs(table - direct).mean() < 0.002 * direct.mean()


@pytest.mark.parametrize(("positions", "axes", "height", "z"), CASES.values(), ids=CASES)
def test_power_peaks_at_the_source(positions, axes, height, z):
    source = np.array([1.4, 1.7, 1.5 if z is None else z])[: len(positions[0])]
    gcc, power = beamformer(positions, height=height)
    R = gcc(ShortTimeSpectrum(L, 256)(torch.tensor(sound("source", positions, source))).spectrum).mean(0)
    at_source = power(R, torch.tensor(source[None, :axes]))
    assert at_source > 0.9
    others = Region((-1.0, -1.0, 0.0)[:axes], (3.0, 3.0, 2.5)[:axes]).grid(2000)
    best = others[power(R, others).argmax()]
    seen, true = (x - torch.tensor(positions).mean(0)[:axes] for x in (best, torch.tensor(source[:axes])))
    assert torch.cosine_similarity(seen, true, dim=0) > np.cos(0.15)  # a cell; an array sees range much worse
    assert power(R, others).max() <= at_source + 0.01


def test_permuting_the_microphones_changes_nothing():
    order, points = [3, 0, 4, 1, 2], torch.rand(40, 2) * 3
    samples = torch.tensor(sound("source", FLAT, np.array([1.4, 1.7])))
    (gcc, power), (gcc_2, power_2) = beamformer(FLAT), beamformer([FLAT[i] for i in order])
    spectrum = ShortTimeSpectrum(L, 256)(samples).spectrum[0]
    torch.testing.assert_close(power_2(gcc_2(spectrum[order]), points), power(gcc(spectrum), points))


def test_moving_array_and_points_together_changes_nothing():
    shift, points = torch.tensor([2.0, -0.7]), torch.rand(40, 2) * 3
    _, power = beamformer(FLAT)
    _, moved = beamformer((torch.tensor(FLAT) + shift).tolist())
    R = tables(power)
    torch.testing.assert_close(moved(R, points + shift), power(R, points))


def test_silence_is_one_over_m_everywhere():
    _, power = beamformer(FLAT)
    P = power(torch.zeros(power.num_pairs, power.num_lags), torch.rand(7, 2))
    torch.testing.assert_close(P, torch.full((7,), 0.2))


BATCHES = [  # of the observation, of the points
    ((), ()),
    ((), (4,)),
    ((), (3, 4)),
    ((1,), (4,)),
    ((3,), (3,)),
    ((3,), ()),
    ((3, 1), (3, 4)),
    ((3, 1), (4,)),
    ((3, 1), (1, 4)),
    ((3, 4), (3, 4)),
    ((1, 4), (3, 1)),
    ((3, 4), ()),
    ((2, 1, 3, 1), (2, 5, 3, 4)),
]


@pytest.mark.parametrize(("observed", "particles"), BATCHES)
def test_batch_agrees_with_one_by_one(observed, particles):
    _, power = beamformer(FLAT[:3])
    R, points = tables(power, *observed), torch.rand(*particles, 6, 2)
    P, batch = power(R, points), torch.broadcast_shapes(observed, particles)
    assert P.shape == (*batch, 6)
    R, points = R.expand(*batch, *R.shape[-2:]), points.expand(*batch, 6, 2)
    for index in np.ndindex(*batch):
        torch.testing.assert_close(P[index], power(R[index], points[index]))


@pytest.mark.parametrize("positions", [FLAT[:2], FLAT, LEVEL])
def test_fixed_points_have_the_power_of_the_nearest_lag(positions):
    gcc, power = beamformer(positions)
    R = gcc(ShortTimeSpectrum(L, 256)(torch.tensor(sound("source", positions, np.array(positions[0]) + 1.1))).spectrum)
    points = torch.rand(300, 2) * 4 - 1
    fixed, exact = power.at(points)(R), power(R, points)
    assert fixed.shape == (len(R), 300)
    # half a lag turns the phase of the mean frequency of the band, 1656 Hz, by 0.081: (M - 1) / M of that at most
    assert (fixed - exact).abs().max() < 0.081 * (1 - 1 / len(positions)) + 0.005
    assert (fixed - exact).mean(-1).abs().max() < 0.002  # independent errors of 300 points


def test_fixed_points_take_each_pair_s_own_row():
    _, power = beamformer(SPATIAL)
    points = torch.rand(9, 3)
    for pair in range(power.num_pairs):
        R = torch.zeros(power.num_pairs, power.num_lags)
        R[pair] = torch.linspace(-1, 1, power.num_lags)  # linear: an interpolation is exact, a rounding half a step
        error = power.at(points)(R) - power(R, points)
        assert error.abs().max() <= 1.001 / (power.num_lags - 1)


def test_fixed_points_beyond_the_tables_take_the_last_lag():
    array = MicrophoneArray(FLAT)
    power = SteeredResponsePower(array, lag_rate=64000, num_lags=21)  # too few for this array
    R, points = tables(power, 2), torch.rand(20, 2) * 4
    smooth = R.cumsum(-1) / 21
    assert (power.at(points)(smooth) - power(smooth, points)).abs().max() < 0.1
    ends = torch.cat([smooth[..., :1], smooth[..., -1:]], -1)
    far = power(smooth, torch.tensor([[500.0, 3.0]]))
    assert far.abs().max() <= ends.abs().amax(-1).sum(-1).max() + 0.2


@pytest.mark.parametrize("batch", [(0,), (3, 0), (2, 3)])
def test_fixed_points_keep_every_leading_axis(batch):
    _, power = beamformer(FLAT[:3])
    R = tables(power, *batch)
    assert power.at(torch.rand(5, 2))(R).shape == (*batch, 5)


@pytest.mark.parametrize(("positions", "axes"), [(FLAT[:3], 2), (LEVEL[:3], 2), (SPATIAL[:3], 3)])
def test_gradients(positions, axes):
    array = MicrophoneArray(positions)
    power = torch.nn.Module()
    power.gain = torch.nn.Parameter(torch.tensor(1.3))
    table = SteeredResponsePower(array, lag_rate=8000, num_lags=61)
    assert_gradients(power, lambda m, R, x: table(m.gain * R, x), tables(table, 2), torch.rand(2, 3, axes) + 0.3)


def test_gradient_at_a_microphone_is_finite():
    _, power = beamformer(FLAT)
    points = torch.tensor(FLAT).requires_grad_()
    power(tables(power), points).sum().backward()
    assert points.grad.isfinite().all()


def test_float32_is_close_to_float64():
    _, power = beamformer(SPATIAL)
    R, points = tables(power, 3).cumsum(-1) / 10, torch.rand(3, 50, 3) * 4
    rough = beamformer(SPATIAL)[1].float()(R.float(), points.float())
    torch.testing.assert_close(rough.double(), power(R, points), rtol=0, atol=1e-4)


def test_speed_of_sound_scales_the_delays():
    array, points = MicrophoneArray(FLAT), torch.rand(5, 2)
    power = SteeredResponsePower(array, lag_rate=64000, num_lags=501, speed_of_sound=343.0)
    faster = SteeredResponsePower(array, lag_rate=64000 * 346.0 / 343.0, num_lags=501, speed_of_sound=346.0)
    R = tables(power)
    torch.testing.assert_close(faster(R, points), power(R, points))


def test_rejects_tables_and_points_of_another_array():
    _, power = beamformer(FLAT)
    with pytest.raises(ShapeError, match=rf"gcc must have shape \(\.\.\., 10, {power.num_lags}\), got \(10, 5\)"):
        power(torch.zeros(10, 5), torch.zeros(4, 2))
    with pytest.raises(ShapeError, match=r"points must have shape \(\.\.\., 2\), got \(4, 3\)"):
        power(tables(power), torch.zeros(4, 3))
    with pytest.raises(ShapeError, match=r"points must have shape \(\.\.\., 3\), got \(4, 1\)"):
        beamformer(SPATIAL)[1].at(torch.zeros(4, 1))


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"height": float("nan")}, "height must be finite, got nan"),
        ({"speed_of_sound": -1.0}, "speed_of_sound must be finite and positive, got -1"),
        ({"lag_rate": 0.0}, "lag_rate must be finite and positive, got 0"),
        ({"num_lags": 1}, "num_lags must be an integer of at least 2, got 1"),
    ],
)
def test_rejects_settings(settings, match):
    with pytest.raises(InputError, match=match):
        SteeredResponsePower(MicrophoneArray(LEVEL), **{"lag_rate": 64000.0, "num_lags": 301, **settings})
