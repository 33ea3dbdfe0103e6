"""How loud a source is to its side and back: the directivity of a talker."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from probtrack.errors import InputError

_ANGLES = 181  # over which the polynomial is fitted


@dataclass(frozen=True)
class Directivity:
    r"""Radiation pattern that is symmetric about the axis of the mouth, by octave bands.

    At an angle :math:`\gamma` off the axis the level, relative to that in front, is

    .. math:: L_b(\gamma) = -A_b ((1 - \cos\gamma) / 2)^{p_b} \text{ dB}

    in band b, with A and p interpolated over the logarithm of frequency, and kept beyond the outermost bands.
    Rooms use the amplitude as a polynomial of degree 2 in the cosine, `polynomial`, within 0.7 dB of this for
    speech at all angles: a product with the direction of every reflection, so that one set of responses
    serves all directions of the mouth.

    Args:
        bands: Octave-band centres [Hz], increasing.
        depth_db: A, the loss straight behind in each band [dB].
        exponent: p in each band.
    """

    bands: tuple[float, ...]
    depth_db: tuple[float, ...]
    exponent: tuple[float, ...]

    def __post_init__(self) -> None:
        if not len(self.bands) == len(self.depth_db) == len(self.exponent) >= 1:
            raise InputError("directivity: bands, depth_db and exponent must have one value a band")
        if not all(math.isfinite(value) for value in self.bands + self.depth_db + self.exponent):
            raise InputError("directivity: bands, depth_db and exponent must be finite")
        if min(self.bands) <= 0 or list(self.bands) != sorted(set(self.bands)):
            raise InputError(f"directivity: bands must be positive and increase [Hz], got {self.bands}")
        if min(self.depth_db) < 0 or min(self.exponent) <= 0:
            raise InputError("directivity: depth_db must not be negative, and exponent must be positive")

    def level_db(self, cosine: Tensor, frequency: Tensor) -> Tensor:
        """Return the level [dB] at angles of that `cosine` (...), at `frequency` (...) [Hz]; both broadcast."""
        depth, exponent = self._at(frequency)
        return -depth * ((1 - cosine) / 2).clamp(min=0) ** exponent

    def polynomial(self, frequency: Tensor) -> Tensor:
        """Return (F, 3): the amplitude at `frequency` (F,) [Hz] is d0 + d1 cos + d2 cos^2; in front it is 1.

        The fit is least squares of the relative error, angles weighted by the solid angle they stand for.
        """
        cosine = torch.cos(torch.linspace(0, torch.pi, _ANGLES, dtype=torch.float64))
        wanted = 10 ** (self.level_db(cosine, frequency.double()[:, None]) / 20)  # (F, angles)
        weight = ((1 - cosine.square()).sqrt() + 0.02).sqrt() / wanted  # of a ring on the sphere; the poles count too
        basis = torch.stack([cosine - 1, cosine.square() - 1], -1)  # 1 + d1 (cos - 1) + d2 (cos^2 - 1) is 1 in front
        fit = torch.linalg.lstsq(basis * weight[..., None], ((wanted - 1) * weight)[..., None]).solution
        d1, d2 = fit[..., 0].unbind(-1)
        return torch.stack([1 - d1 - d2, d1, d2], -1).to(frequency.dtype)

    def _at(self, frequency: Tensor) -> tuple[Tensor, Tensor]:
        place = frequency.clamp(self.bands[0], self.bands[-1]).log()
        if len(self.bands) == 1:
            return torch.full_like(place, self.depth_db[0]), torch.full_like(place, self.exponent[0])
        bands = place.new_tensor(self.bands).log()
        right = torch.searchsorted(bands, place.contiguous()).clamp(1, len(bands) - 1)
        share = (place - bands[right - 1]) / (bands[right] - bands[right - 1])
        return tuple(  # type: ignore[return-value]
            torch.lerp(values[right - 1], values[right], share)
            for values in (place.new_tensor(self.depth_db), place.new_tensor(self.exponent))
        )


SPEECH = Directivity(
    bands=(125.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0, 8000.0),
    depth_db=(3.7, 5.3, 6.5, 7.4, 13.5, 19.3, 24.4),
    exponent=(1.23, 1.20, 1.81, 1.61, 1.23, 1.46, 1.40),
)
"""A talker: fitted to the octave bands, in the horizontal plane, of B. B. Monson, E. J. Hunter and B. H. Story,
"Horizontal directivity of low- and high-frequency energy in speech and singing", J. Acoust. Soc. Am. 132:433, 2012;
within 1.3 dB rms of their measurements."""
