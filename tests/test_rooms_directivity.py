"""How loud a talker is to the side and back, against the table of the field and polynomials fitted elsewhere."""

import math

import pytest
import torch
from numpy.polynomial import polynomial as numpy_polynomial

from probtrack.errors import InputError
from probtrack.simulation.rooms import SPEECH, Directivity
from probtrack.simulation.rooms.images import harmonics

BANDS = {  # Hz: (A [dB], p), fitted to Monson, Hunter and Story 2012
    125: (3.7, 1.23),
    250: (5.3, 1.20),
    500: (6.5, 1.81),
    1000: (7.4, 1.61),
    2000: (13.5, 1.23),
    4000: (19.3, 1.46),
    8000: (24.4, 1.40),
}


def table(frequency, angle):
    """Return the level [dB] by the formula, A and p interpolated over octaves."""
    octave = min(max(math.log2(frequency / 125), 0.0), 6.0)
    low = min(int(octave), 5)
    (a, p), (b, q) = list(BANDS.values())[low : low + 2]
    share = octave - low
    return -(a + share * (b - a)) * ((1 - math.cos(angle)) / 2) ** (p + share * (q - p))


@pytest.mark.parametrize(
    ("frequency", "angle_deg", "level"),
    [
        (1000.0, 180.0, -7.4),
        (1000.0, 90.0, -2.4242),  # 7.4 / 2^1.61
        (4000.0, 90.0, -7.0153),  # 19.3 / 2^1.46
        (8000.0, 60.0, -3.5035),  # 24.4 / 4^1.40
        (125.0, 0.0, 0.0),
        (2000 * math.sqrt(2), 180.0, -16.4),  # half way between the octaves in A
        (2000 * math.sqrt(2), 90.0, -6.4559),  # 16.4 / 2^1.345
        (40.0, 180.0, -3.7),
        (16000.0, 180.0, -24.4),
    ],
)
def test_level_is_that_of_the_formula(frequency, angle_deg, level):
    cosine = torch.tensor(math.cos(math.radians(angle_deg)))
    assert float(SPEECH.level_db(cosine, torch.tensor(frequency))) == pytest.approx(level, abs=1e-3)


@pytest.mark.parametrize("frequency", [31.0, *BANDS, 177.0, 354.0, 707.0, 1414.0, 2828.0, 5657.0, 12000.0])
def test_polynomial_is_near_the_formula_at_all_angles(frequency):
    d = SPEECH.polynomial(torch.tensor([float(frequency)]))[0].tolist()
    angles = [math.pi * k / 36 for k in range(37)]
    fitted = [20 * math.log10(numpy_polynomial.polyval(math.cos(angle), d)) for angle in angles]
    assert fitted == pytest.approx([table(frequency, angle) for angle in angles], abs=0.7)


def test_polynomial_is_one_in_front():
    frequency = torch.linspace(0, 24000, 50)
    torch.testing.assert_close(SPEECH.polynomial(frequency).sum(-1), torch.ones(50), rtol=0, atol=1e-12)


def test_polynomial_is_smooth_over_frequency():
    amplitude = SPEECH.polynomial(torch.linspace(100, 8000, 800)) @ torch.tensor([[1.0, 0.3, 0.09], [1.0, -1.0, 1.0]]).T
    assert amplitude.diff(dim=0).abs().max() < 0.02


def test_a_pattern_without_depth_is_the_same_in_all_directions():
    flat = Directivity(bands=(500.0,), depth_db=(0.0,), exponent=(1.0,))
    polynomial = flat.polynomial(torch.tensor([100.0, 3000.0]))
    torch.testing.assert_close(polynomial, torch.tensor([[1.0, 0.0, 0.0]] * 2), rtol=0, atol=1e-12)


def test_one_band_holds_at_all_frequencies():
    pattern = Directivity(bands=(500.0,), depth_db=(9.0,), exponent=(2.0,))
    level = pattern.level_db(torch.tensor(0.0), torch.tensor([20.0, 500.0, 9000.0]))
    torch.testing.assert_close(level, torch.full((3,), -2.25))


def test_polynomial_keeps_the_dtype():
    assert SPEECH.polynomial(torch.tensor([500.0], dtype=torch.float32)).dtype == torch.float32


def test_a_cosine_beyond_one_by_rounding_is_the_front():
    assert float(SPEECH.level_db(torch.tensor(1 + 1e-12), torch.tensor(500.0))) == 0


def test_five_harmonics_make_any_polynomial_of_the_cosine():
    mouth, toward, d = torch.tensor([-2.9, 0.4, 1.7]), 0.8, torch.tensor([0.5, 0.3, 0.2])
    wanted = d[0] + d[1] * torch.cos(mouth - toward) + d[2] * torch.cos(mouth - toward) ** 2
    x, y = math.cos(toward), math.sin(toward)
    parts = [d[0] + d[2] / 2, d[1] * x, d[1] * y, d[2] / 2 * (x * x - y * y), d[2] * x * y]
    torch.testing.assert_close(harmonics(mouth) @ torch.stack(parts), wanted)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((500.0, 1000.0), (3.0,), (1.0, 1.0)), "must have one value a band"),
        (((), (), ()), "must have one value a band"),
        (((1000.0, 500.0), (3.0, 3.0), (1.0, 1.0)), r"must be positive and increase \[Hz\], got \(1000.0, 500.0\)"),
        (((500.0, 500.0), (3.0, 3.0), (1.0, 1.0)), "must be positive and increase"),
        (((0.0, 500.0), (3.0, 3.0), (1.0, 1.0)), "must be positive and increase"),
        (((500.0,), (-1.0,), (1.0,)), "depth_db must not be negative"),
        (((500.0,), (3.0,), (0.0,)), "exponent must be positive"),
        (((math.nan,), (3.0,), (1.0,)), "must be finite"),
        (((500.0,), (math.nan,), (1.0,)), "must be finite"),
        (((500.0,), (3.0,), (math.inf,)), "must be finite"),
    ],
)
def test_rejects_what_is_no_pattern(arguments, message):
    with pytest.raises(InputError, match=message):
        Directivity(*arguments)
