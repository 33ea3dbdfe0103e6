"""Sound in a rectangular room as a sum over mirrored talkers, one frequency at a time, in double precision.

The talker and its mouth are mirrored in the walls, microphones stay where they are: J. B. Allen and D. A. Berkley,
"Image method for efficiently simulating small-room acoustics", J. Acoust. Soc. Am. 65:943, 1979.
"""

import itertools
import math

import numpy as np
import scipy.signal

SPEECH_BANDS = {  # Hz: (A [dB], p) of the level -A ((1 - cos) / 2)^p
    500: (6.5, 1.81),
    1000: (7.4, 1.61),
    2000: (13.5, 1.23),
    4000: (19.3, 1.46),
}


def mirrored(size, talker, mouth, most):
    """Return positions (I, 3), directions of the mouth (I, 3) and numbers of reflections (I,)."""
    ahead = (math.cos(mouth), math.sin(mouth), 0.0)
    axes = []
    for length, place, direction in zip(size, talker, ahead, strict=True):
        pairs = itertools.product(range(-most, most + 1), (0, 1))
        axes.append(
            [((1 - 2 * u) * place + 2 * n * length, (1 - 2 * u) * direction, abs(n - u) + abs(n)) for n, u in pairs]
        )
    grids = [np.meshgrid(*([one[k] for one in axis] for axis in axes), indexing="ij") for k in range(3)]
    position, direction, reflections = (np.stack([g.ravel() for g in grid], -1) for grid in grids)
    return position, direction, reflections.sum(-1)


def transfer(frequency, size, absorption, talker, mouth, microphone, *, pattern, end, fade, fs, c, high_pass):
    """Return the complex response at `frequency` [Hz], of what arrives before `end` [s], fading over `fade` [s].

    `pattern` gives the amplitude at a cosine off the mouth, None for 1. Reflections go through a
    Butterworth `high_pass` [Hz].
    """
    position, direction, reflections = mirrored(size, talker, mouth, math.ceil(c * end / min(size) / 2) + 1)
    away = np.asarray(microphone) - position
    distance = np.sqrt((away**2).sum(-1))
    amplitude = np.sqrt(1 - absorption) ** reflections / distance
    if pattern is not None:
        cosine = (away * direction).sum(-1) / distance
        amplitude = amplitude * pattern(cosine)
    left = np.clip((end - distance / c) / fade, 0, 1)
    waves = amplitude * (1 - np.cos(np.pi * left)) / 2 * np.exp(-2j * np.pi * frequency * distance / c)
    direct = reflections == 0
    b, a = scipy.signal.butter(2, high_pass, "high", fs=fs)
    filtered = scipy.signal.freqz(b, a, [frequency], fs=fs)[1][0]
    return waves[direct].sum() + filtered * waves[~direct].sum()
