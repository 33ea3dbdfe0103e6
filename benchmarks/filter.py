"""The bootstrap filter alone: 4-D Langevin motion, measured positions, 250 frames, resampling on N_eff < N / 2.

The models are `lehmann2007("CU-LAN")` at 32 ms and `GaussianPosition` of 0.1 m, float32, under
`torch.inference_mode()`. Our filter draws its numbers, predicts, weights, reports (mean, standard deviation,
heading, N_eff and evidence of every frame) and resamples systematically.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from benchmarks.pairs import Row, missing_row, peer, ratio_row
from probtrack import dynamics
from probtrack.filters import Adaptive, ParticleFilter, resampling
from probtrack.likelihoods import GaussianPosition

_FRAMES = 250
_DT = 0.032  # s
_STD = 0.1  # m
_THRESHOLD = 0.5  # of N: below this N_eff a cloud is resampled, here and by the peer

Work = Callable[[], object]


def run(quick: bool = False) -> list[Row]:
    """Compare with the floor in a batch and at 1e5 particles, and with filterpy at 75."""
    repeats = 5 if quick else 15
    rows = [
        ratio_row(what, ours(runs, n), "floor", floor(runs, n), pairs=repeats, target=target)
        for what, runs, n, target in (
            ("240 runs x 75 particles", 240, 75, 3.5),
            ("one run of 100 000 particles", None, 100_000, 2.2),
        )
    ]
    what, target = "one run of 75 particles", 1.5
    filterpy = peer("filterpy.monte_carlo")
    if filterpy is None:
        return [*rows, missing_row(what, "filterpy", target)]
    loop = filterpy_loop(filterpy.systematic_resample, 75)
    return [*rows, ratio_row(what, ours(None, 75), "filterpy and NumPy", loop, pairs=4 * repeats, target=target)]


def observations() -> torch.Tensor:
    """Return measured positions (T, 2) [m] of a talker who walks by the model, with the model's error."""
    generator = torch.Generator().manual_seed(1)
    step = dynamics.lehmann2007("CU-LAN").transition(_DT)
    state, path = torch.zeros(4), []
    with torch.no_grad():
        for _ in range(_FRAMES):
            state = step(state, torch.randn(2, generator=generator))
            path.append(state[:2])
    return torch.stack(path) + _STD * torch.randn(_FRAMES, 2, generator=generator)


def ours(runs: int | None, num_particles: int) -> Work:
    """Return a run of our filter over the frames, with its noise drawn and the cloud spread within it."""
    particle_filter = ParticleFilter(
        dynamics.lehmann2007("CU-LAN"),
        GaussianPosition(_STD),
        num_particles=num_particles,
        resample=Adaptive(resampling.systematic, _THRESHOLD),
    )
    batch = () if runs is None else (runs,)
    seeds = 0 if runs is None else torch.arange(runs)
    seen = observations().view(_FRAMES, *[1] * len(batch), 2)

    @torch.inference_mode()
    def work() -> object:
        noise = particle_filter.noise(seeds)
        belief = particle_filter.spread_around(torch.zeros(*batch, 2), noise)
        return particle_filter.advance(belief, seen, _DT, noise)

    return work


def floor(runs: int | None, num_particles: int) -> Work:
    """Return the least that any such filter in torch does: its random numbers and one pass over the state.

    Each frame draws two normal numbers a particle and one uniform number a run, from one generator into
    fresh tensors, and makes a new state of the old one by one elementwise sum.
    """
    batch = () if runs is None else (runs,)

    @torch.inference_mode()
    def work() -> object:
        generator = torch.Generator().manual_seed(0)
        state = torch.zeros(*batch, num_particles, 4)
        for _ in range(_FRAMES):
            torch.randn(*batch, num_particles, 2, generator=generator)
            torch.rand(*batch, 1, generator=generator)
            state = state + 1.0
        return state

    return work


def filterpy_loop(systematic_resample: Callable[[Any], Any], num_particles: int) -> Work:
    """Return the loop that filterpy's users write: NumPy arrays over the particles, its resampling.

    The same model, noise, threshold and frames as ours in float64, and its mean and standard deviation.
    """
    motion = dynamics.lehmann2007("CU-LAN")
    assert isinstance(motion, dynamics.CoordinateUncoupled)
    matrix, gain = (x.detach().double().numpy() for x in motion.matrices(_DT))
    seen = observations().double().numpy()

    def work() -> object:
        random = np.random.default_rng(0)
        np.random.seed(0)  # noqa: NPY002 - filterpy draws from it
        state = np.zeros((num_particles, 4))
        state[:, :2] = 0.1 * random.standard_normal((num_particles, 2))
        state[:, 2:] = 0.5 * random.standard_normal((num_particles, 2))
        weights = np.full(num_particles, 1 / num_particles)
        means, spreads = [], []
        for position in seen:
            state = state @ matrix.T + random.standard_normal((num_particles, 2)) @ gain.T
            squares = ((state[:, :2] - position) ** 2).sum(1)
            weights = weights * np.exp(-0.5 / _STD**2 * squares)
            weights += 1e-300  # as its tutorial does, against a sum of zero
            weights /= weights.sum()
            mean = weights @ state
            means.append(mean)
            spreads.append(np.sqrt(weights @ (state - mean) ** 2))
            if 1 / np.sum(weights**2) < _THRESHOLD * num_particles:
                state = state[systematic_resample(weights)]
                weights = np.full(num_particles, 1 / num_particles)
        return np.array(means), np.array(spreads)

    return work
