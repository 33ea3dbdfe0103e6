"""Noise that comes from everywhere alike."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from probtrack._checks import as_positive
from probtrack.geometry import SPEED_OF_SOUND, MicrophoneArray
from probtrack.simulation.noise.base import Noise, unit_power
from probtrack.simulation.noise.files import independent_stretches, load_noise
from probtrack.simulation.noise.spectra import spectral_gain
from probtrack.simulation.rooms.base import Room
from probtrack.simulation.rooms.cache import ResponseCache
from probtrack.simulation.rooms.switching import fast_size

_STEPS = 32  # of the frequency to one turn of the largest distance: the coherence is then within 0.005
_AT_ONCE = 1 << 22  # numbers of the mixing matrices that are held at a time


@dataclass(frozen=True)
class DiffuseNoise(Noise):
    r"""Stationary field of independent plane waves from all directions alike, in open air.

    .. math:: \Gamma_{ij}(f) = \frac{\sin(2 \pi f d_{ij} / c)}{2 \pi f d_{ij} / c}
        \quad\text{or, cylindrical,}\quad J_0(2 \pi f d_{ij} / c)

    is the coherence of microphones i and j at the distance d. Independent noises, one a microphone, are mixed by
    its symmetric square root, frequency by frequency over the whole length, so that the field is stationary and
    its coherence has no error of short frames. Each microphone hears the same power and spectrum.

    Args:
        spectrum: white, pink, speech or fan: see `spectral_gain`. Not heeded with `file`.
        file: Recording whose stretches are the independent noises, the channels averaged; None for Gaussian noise.
        cylindrical: Waves come from all around in the horizontal plane, as where floor and ceiling are damped.
        level_db: Power relative to the other noises of a scene [dB].
        speed_of_sound: [m/s].

    References:
        E. A. P. Habets and S. Gannot, "Generating sensor signals in isotropic noise fields", J. Acoust. Soc. Am.
        122:3464, 2007.

        E. A. P. Habets, I. Cohen and S. Gannot, "Generating nonstationary multisensor signals under a spatial
        coherence constraint", J. Acoust. Soc. Am. 124:2911, 2008. They mix in short frames, by Cholesky factors.
    """

    spectrum: str = "white"
    file: str | None = None
    cylindrical: bool = False
    level_db: float = 0.0
    speed_of_sound: float = SPEED_OF_SOUND

    def __post_init__(self) -> None:
        as_positive(self.speed_of_sound, "speed_of_sound")
        spectral_gain(self.spectrum, torch.zeros(1))

    def draw(
        self,
        room: Room,  # noqa: ARG002
        array: MicrophoneArray,
        size: int,
        fs: int,
        generator: torch.Generator,
        cache: ResponseCache | None = None,  # noqa: ARG002
    ) -> Tensor:
        # what the filters smear beyond the end comes in again at the start, and is cut off
        longer = fast_size(size + math.ceil(4 * array.diameter / self.speed_of_sound * fs))
        spectra = torch.fft.rfft(self._sources(array.num_microphones, longer, fs, generator))
        if self.file is None:
            spectra *= spectral_gain(self.spectrum, torch.fft.rfftfreq(longer, 1 / fs, dtype=torch.float64))
        mixed = torch.fft.irfft(self._mixed(spectra, array, fs / 2), longer)[:, :size]
        return unit_power(mixed, "diffuse noise").to(torch.get_default_dtype())

    def coherence(self, array: MicrophoneArray, frequency: Tensor) -> Tensor:
        """Return the coherence (F, M, M) of the microphones at each `frequency` (F,) [Hz]."""
        x = array.positions.to(frequency)
        cycles = torch.linalg.vector_norm(x[:, None] - x, dim=-1) / self.speed_of_sound * frequency[:, None, None]
        if self.cylindrical:
            return torch.special.bessel_j0(2 * torch.pi * cycles)  # type: ignore[no-any-return]
        coherence: Tensor = torch.sinc(2 * cycles)  # torch's holds the factor pi
        return coherence

    def _sources(self, count: int, size: int, fs: int, generator: torch.Generator) -> Tensor:
        """Return (count, size), independent and of one power."""
        if self.file is None:
            return torch.randn(count, size, generator=generator, dtype=torch.float64)
        sources = independent_stretches(load_noise(self.file, fs).mean(0), size, fs, count, generator)
        return torch.stack([unit_power(source, f"{self.file}: stretch of noise") for source in sources])

    def _mixed(self, spectra: Tensor, array: MicrophoneArray, top: float) -> Tensor:
        """Return the spectra (M, F), which reach from 0 to `top` [Hz], with the coherence of the field."""
        bins, count = spectra.shape[1], len(spectra)
        knots = max(64, math.ceil(_STEPS * array.diameter / self.speed_of_sound * top)) + 1
        root = _square_root(self.coherence(array, torch.linspace(0, top, knots, dtype=torch.float64)))
        mixed = torch.empty_like(spectra)
        for some in torch.arange(bins).split(max(1, _AT_ONCE // count**2)):
            at = some.double() * ((knots - 1) / max(bins - 1, 1))
            left = at.long().clamp(max=knots - 2)
            matrix = torch.lerp(root[left], root[left + 1], (at - left)[:, None, None])
            matrix = torch.nn.functional.normalize(matrix, dim=-1)  # between knots the power would sag
            parts = torch.view_as_real(spectra[:, some].T.contiguous())  # shape: (F, M, 2)
            mixed[:, some] = torch.view_as_complex(matrix @ parts).T
        return mixed


def _square_root(matrices: Tensor) -> Tensor:
    """Return the symmetric square roots (F, M, M), which change as smoothly as the matrices do."""
    values, vectors = torch.linalg.eigh(matrices)
    root: Tensor = (vectors * values.clamp(min=0).sqrt()[:, None]) @ vectors.mT  # rounding may push a 0 below 0
    return root
