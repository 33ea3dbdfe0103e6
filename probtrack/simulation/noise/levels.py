"""How loud noise is: several noises in one scene, and the signal-to-noise ratio of a recording."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from probtrack.errors import InputError, NotFiniteError, ShapeError
from probtrack.geometry import MicrophoneArray
from probtrack.simulation.noise.base import Noise, unit_power
from probtrack.simulation.rooms.base import Room
from probtrack.simulation.rooms.cache import ResponseCache


def mixed(
    noises: Sequence[Noise],
    room: Room,
    array: MicrophoneArray,
    size: int,
    fs: int,
    generator: torch.Generator,
    cache: ResponseCache | None = None,
) -> Tensor:
    """Return (M, size), the sum of `noises`, each at its `level_db` over a mean power of 1; without noises, zeros.

    Each noise has random numbers of its own: one that is added at the end leaves those before it as they are.
    """
    total = torch.zeros(array.num_microphones, size)
    for noise in noises:
        if not math.isfinite(noise.level_db):
            raise InputError(f"level_db must be finite, got {noise.level_db}")
        own = torch.Generator().manual_seed(int(torch.randint(2**62, (), generator=generator)))
        total += noise.draw(room, array, size, fs, own, cache) * 10 ** (noise.level_db / 20)
    return total


def at_snr(clean: Tensor, noise: Tensor, snr_db: float, active: Tensor) -> Tensor:
    r"""Return `noise` (M, S), scaled so that the ratio of `clean` to it is `snr_db`: add it to `clean`.

    .. math:: \mathrm{SNR} = 10 \log_{10} \frac{\mathrm{mean}_{m,\, s \in active}\ clean^2}
        {\mathrm{mean}_{m,\, s}\ noise^2}

    Pauses of the speech do not count, since they would make the ratio depend on how much is said; the noise
    counts throughout, since it does not know of the speech.

    Args:
        clean: (M, S), what the microphones hear of all talkers, reverberation included.
        noise: (M, S), all noises together, at any level.
        snr_db: Ratio of the powers [dB].
        active: (S,) bool, where a talker speaks.

    Raises:
        InputError: without active speech, or with silent speech or noise.
    """
    if clean.ndim != 2 or noise.shape != clean.shape:
        raise ShapeError(f"noise must have the shape of clean (M, S), got {tuple(noise.shape)}, {tuple(clean.shape)}")
    if active.shape != clean.shape[1:] or active.dtype != torch.bool:
        raise ShapeError(
            f"active must be bool and have shape ({clean.shape[1]},), got {active.dtype} {tuple(active.shape)}"
        )
    if not math.isfinite(snr_db):
        raise InputError(f"snr_db must be finite, got {snr_db}")
    if not clean.isfinite().all():
        raise NotFiniteError("clean must be finite, got NaN or infinite samples")
    power = clean[:, active].double().square().mean() if active.any() else clean.new_zeros(())
    if not power > 0:
        raise InputError("clean must hold speech where active, or the signal-to-noise ratio has no meaning")
    scale = power.sqrt() * 10 ** (-snr_db / 20)
    return (unit_power(noise.double(), "noise") * scale).to(clean)


def add_noise(audio: Tensor, snr_db: float, speech: Tensor | None = None, *, generator: torch.Generator) -> Tensor:
    """Return `audio` (M, S) with white Gaussian noise, independent at each microphone: see `at_snr`.

    Args:
        audio: What the microphones hear of the talker, reverberation included.
        snr_db: Power of `audio`, where `speech` holds, over that of the noise [dB].
        speech: (S,) bool; all samples by default.
        generator: Draws the noise.
    """
    noise = torch.randn(audio.shape, generator=generator, dtype=torch.float64)
    return audio + at_snr(
        audio, noise, snr_db, torch.ones_like(audio[0], dtype=torch.bool) if speech is None else speech
    )
