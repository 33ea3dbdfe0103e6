"""Generalised cross-correlation of all microphone pairs on the lags that the array allows."""

import math

import torch
from torch import Tensor, nn

from probtrack._checks import as_positive, check_event, check_int
from probtrack.audio.frames import band_bins
from probtrack.geometry import SPEED_OF_SOUND, MicrophoneArray

_SMALLEST_POWER = 1e-24  # keeps the weighting of digital silence finite; far below 24-bit noise


class GeneralisedCrossCorrelation(nn.Module):
    r"""Weighted cross-correlation of every microphone pair, scaled so that its sum is a steered power.

    .. math::
        Y_m(f) = \frac{S_m(f)}{|S_m(f)|^{\rho}}, \qquad
        R_{ij}(\tau) = \frac{2 \sum_f w_f \operatorname{Re} Y_i(f) Y_j^*(f) e^{2\pi j f \tau}}
                            {M \sum_m \sum_f w_f |Y_m(f)|^2}

    over the bins f of the band. With :math:`\rho = 1` (the default) it is the phase transform (PHAT). The
    scale makes :math:`P(\ell) = 1/M + \sum_{i<j} R_{ij}(\tau_i(\ell) - \tau_j(\ell))` the output power of a
    delay-and-sum beamformer as a share of its largest possible value, in [0, 1]; S1 eq. (2) is a multiple
    of it. A frame of digital silence gives R = 0.

    The transform is a product with a matrix of waves rather than an inverse FFT: only lags that a
    source outside the array can cause are computed, and the frequency weights learn.

    Args:
        array: The microphones.
        fs: Sampling rate [Hz].
        frame_length: Samples in a frame.
        band: Lowest and highest frequency used [Hz].
        oversampling: Lags per sampling period.
        speed_of_sound: c [m/s].

    Attributes:
        whitening: Exponent rho of the weighting; learnable, 1 is PHAT and 0 plain cross-correlation.
        log_weight: log w_f (F,) of the bins in the band; learnable, 0 at the start.

    Shape:
        spectrum (..., M, frame_length // 2 + 1) complex. Returns (..., P, K): pairs in the order of
        `MicrophoneArray.pairs`, lags from -K // 2 to K // 2 in steps of 1 / (fs * oversampling).

    References:
        C. H. Knapp, G. C. Carter, "The generalized correlation method for estimation of time delay",
        IEEE Trans. ASSP 24(4), 1976, eq. (6) and Table I (PHAT); S1 eq. (2).
    """

    waves: Tensor
    first: Tensor
    second: Tensor

    def __init__(
        self,
        array: MicrophoneArray,
        *,
        fs: int = 16_000,
        frame_length: int = 512,
        band: tuple[float, float] = (300.0, 3000.0),
        oversampling: int = 4,
        speed_of_sound: float = SPEED_OF_SOUND,
    ) -> None:
        super().__init__()
        check_int(oversampling, "oversampling", low=1)
        as_positive(speed_of_sound, "speed_of_sound")
        self.low_bin, self.high_bin = band_bins(band, fs, frame_length)
        self.num_microphones, self.num_bins = array.num_microphones, frame_length // 2 + 1
        self.lag_rate = fs * oversampling
        # one lag beyond the largest delay, so that a look-up at the very end still has a neighbour
        reach = math.ceil(array.diameter / speed_of_sound * self.lag_rate) + 1
        self.num_lags = 2 * reach + 1
        lags = torch.arange(-reach, reach + 1, dtype=torch.float64) / self.lag_rate
        frequencies = torch.arange(self.low_bin, self.high_bin + 1, dtype=torch.float64) * fs / frame_length
        phase = 2 * math.pi * frequencies[:, None] * lags
        dtype = torch.get_default_dtype()
        self.register_buffer("waves", torch.cat([phase.cos(), phase.sin()]).to(dtype), persistent=False)
        self.register_buffer("first", array.pairs[:, 0], persistent=False)
        self.register_buffer("second", array.pairs[:, 1], persistent=False)
        self.log_weight = nn.Parameter(torch.zeros(len(frequencies)))
        self.whitening = nn.Parameter(torch.tensor(1.0))

    def forward(self, spectrum: Tensor) -> Tensor:
        check_event(spectrum, (self.num_microphones, self.num_bins), "spectrum")
        band = spectrum[..., self.low_bin : self.high_bin + 1]
        # real and imaginary parts apart: complex products and their strided views cost twice as much
        real, imag = band.real, band.imag
        power = real.square() + imag.square()
        scale = (power + _SMALLEST_POWER).pow(-self.whitening / 2)
        real, imag = real * scale, imag * scale
        frequency_weight = self.log_weight.exp()
        # the scale of a silent microphone is huge: its square may be more than a float can hold
        total = (frequency_weight * power * scale * scale).sum((-1, -2)).clamp_min(_SMALLEST_POWER)
        weight = 2 * frequency_weight / (total[..., None, None] * self.num_microphones)
        real_1, imag_1 = (x.index_select(-2, self.first) * weight for x in (real, imag))
        real_2, imag_2 = (x.index_select(-2, self.second) for x in (real, imag))
        in_phase = torch.addcmul(real_1 * real_2, imag_1, imag_2)
        quadrature = torch.addcmul(real_1 * imag_2, imag_1, real_2, value=-1)
        return torch.cat([in_phase, quadrature], -1) @ self.waves
