"""How long a room rings: the reverberation time of responses, and the absorption that gives a wanted one."""

import functools
import math

import torch
from torch import Tensor

from probtrack.errors import InputError

COMPLETE = 40.0
"""Decay over which all image sources are there [dB]."""

_RANGE = (-5.0, -35.0)  # dB of the decay to which the reverberation time is fitted: T30 of ISO 3382-1
_MOST_IMAGES = 2_000_000  # of a microphone: two gigabytes, and a second for each place of a small array
_PROBES = ((0.31, 0.42, 0.57), (0.63, 0.27, 0.44), (0.22, 0.71, 0.61), (0.74, 0.66, 0.36))  # of the size


def reverberation_time(response: Tensor, fs: float) -> Tensor:
    r"""Return the T60 [s] of impulse responses (..., L): a line through the Schroeder decay, 5 to 35 dB down.

    .. math:: E(t) = \int_t^\infty h^2(\tau) d\tau

    References:
        M. R. Schroeder, "New method of measuring reverberation time", J. Acoust. Soc. Am. 37:409, 1965.

    Raises:
        InputError: for a response that is not finite, or does not decay.
    """
    time = _decay_time(response.double().square(), fs).to(response.dtype)
    if not time.isfinite().all():
        raise InputError(
            "response must be finite and decay by 35 dB over several samples, to have a reverberation time"
        )
    return time


def reach(t60: float, speed_of_sound: float) -> float:
    """Return how far sound goes until it has decayed by 40 dB [m]."""
    return speed_of_sound * t60 * COMPLETE / 60


def max_order(size: tuple[float, float, float], t60: float, speed_of_sound: float) -> int:
    """Return the order of the image sources within which all are that sound reaches before it has decayed.

    An image n rooms away along an axis is at least n - 1 lengths of that axis from any place, hence the 2 more.

    Raises:
        InputError: for so many that they would fill the memory.
    """
    order = math.ceil(reach(t60, speed_of_sound) * math.hypot(*(1 / s for s in size))) + 2
    if 4 / 3 * order**3 > _MOST_IMAGES:  # as many are in the octahedron |l| + |m| + |n| <= order
        longest = t60 * ((3 / 4 * _MOST_IMAGES) ** (1 / 3) - 3) / (order - 2)
        raise InputError(
            f"room: t60 of {t60:g} s in a room of {size} m needs {4 / 3 * order**3:.1g} image sources: "
            f"the longest that can be computed there is about {longest:.3g} s"
        )
    return order


@functools.lru_cache(maxsize=64)
def wall_absorption(size: tuple[float, float, float], t60: float, fs: int, speed_of_sound: float) -> float:
    """Return the share of the energy that each wall swallows, in (0, 1), for which the decay is that of `t60` [s].

    Formulas (Sabine's, Eyring's) miss it in small rooms by up to a quarter, so it is found by bisection on the decay
    of the energy of the very image sources that are used, cut off where the responses are.
    """
    length = math.ceil(t60 * COMPLETE / 60 * fs)
    energy = _image_energy(size, max_order(size, t60, speed_of_sound), length, fs, speed_of_sound)
    order = torch.arange(energy.shape[-1], dtype=energy.dtype)
    low, high = 1e-3, 1 - 1e-3
    for _ in range(30):
        middle = (low + high) / 2
        decay = _decay_time(energy @ (1 - middle) ** order, fs).mean()
        low, high = (middle, high) if decay > t60 else (low, middle)
    if not 2e-3 < middle < 1 - 2e-3:
        raise InputError(f"room: no absorption of its walls gives a t60 of {t60:g} s in a room of {size} m")
    return middle


def _image_energy(size: tuple[float, ...], max_order: int, length: int, fs: float, speed_of_sound: float) -> Tensor:
    """Return the energy (probes, length [samples], order) that images of a source send with hard walls."""
    extent, probes = torch.tensor(size, dtype=torch.float64), torch.tensor(_PROBES, dtype=torch.float64)
    steps = torch.arange(-max_order, max_order + 1)
    index = torch.cartesian_prod(steps, steps, steps)
    order = index.abs().sum(-1)
    index, order = index[order <= max_order], order[order <= max_order]
    source, receivers = probes[0] * extent, probes[1:] * extent
    image = torch.where(index % 2 == 0, index * extent + source, (index + 1) * extent - source)
    distance = torch.cdist(receivers, image)
    arrival = (distance / speed_of_sound * fs).long().clamp(max=length)
    energy = torch.zeros(len(receivers), length + 1, max_order + 1, dtype=torch.float64)
    row = torch.arange(len(receivers))[:, None].expand_as(arrival)
    energy.index_put_((row, arrival, order.expand_as(arrival)), distance**-2, accumulate=True)
    return energy[:, :length]


def _decay_time(energy: Tensor, fs: float) -> Tensor:
    """Return T60 [s] of the energy (..., L) that arrives in each sample, by a line through its decay."""
    left = energy.flip(-1).cumsum(-1).flip(-1)
    level = 10 * torch.log10(left / left[..., :1] + 1e-12)
    weight = ((level <= _RANGE[0]) & (level >= _RANGE[1])).double()
    time = torch.arange(energy.shape[-1], dtype=torch.float64) / fs
    count = weight.sum(-1)
    time_mean, level_mean = (weight * time).sum(-1) / count, (weight * level).sum(-1) / count
    off = weight * (time - time_mean[..., None])
    slope = (off * (level - level_mean[..., None])).sum(-1) / (off * time).sum(-1)
    return -60 / slope
