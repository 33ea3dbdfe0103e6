"""A cell of a study: 60 runs of 75 particles on one sequence of measured positions, scored; runs per second.

250 frames of `lehmann2007("CU-LAN")` at 32 ms, positions measured to 0.1 m, resampling on N_eff < 3/4 N, RMSE (S1
eq. 7) and track loss (eq. 8) of each run. Stone Soup's runs go one after the other, as it has no batch: its time is
that of four runs, scaled to 60. The last rows say how the time of one of our runs falls with their number, on the
steered power of one recording.
"""

import datetime
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import sounds
from benchmarks.filter import observations
from benchmarks.pairs import Row, Spread, missing_row, peer, spread, thread_seconds
from probtrack import dynamics
from probtrack.audio import Recording
from probtrack.filters import Adaptive, ParticleFilter, resampling
from probtrack.geometry import MicrophoneArray, Region
from probtrack.likelihoods import GaussianPosition
from probtrack.metrics import RootMeanSquareError, Talkers, TrackLoss
from probtrack.trackers import lehmann2007

_DT = 0.032  # s
_STD = 0.1  # m
_RUNS, _PARTICLES, _SHARE = 60, 75, 0.75
_THEIR_RUNS = 4
_BATCHES = (1, 4, 15, 60, 240)

Work = Callable[[], object]


def run(quick: bool = False) -> list[Row]:
    """Compare with Stone Soup, and measure runs of several batches."""
    pairs = 2 if quick else 5
    what = f"a cell of {_RUNS} runs x {_PARTICLES} particles, runs per second"
    rows = []
    if peer("stonesoup") is None:
        rows.append(missing_row(what, "Stone Soup", None))
    else:
        ours, theirs = cell(), stone_soup()
        ours(), theirs()
        times = [(thread_seconds(ours) / _RUNS, thread_seconds(theirs) / _THEIR_RUNS) for _ in range(pairs)]
        rate, other = (spread([1 / pair[i] for pair in times]) for i in (0, 1))
        ratio = spread([b / a for a, b in times])
        rows.append(Row(what, ratio, None, unit="times", ours=str(rate), against=f"Stone Soup: {other}"))
    return [*rows, *batches(_BATCHES[:3] if quick else _BATCHES, pairs)]


def cell() -> Work:
    """Return our cell: all runs in one call, and their scores."""
    particle_filter = ParticleFilter(
        dynamics.lehmann2007("CU-LAN"),
        GaussianPosition(_STD),
        num_particles=_PARTICLES,
        resample=Adaptive(resampling.systematic, _SHARE),
    )
    seen = observations()
    truth = Talkers(torch.arange(len(seen)) * _DT, seen[:, None, None, :].double())
    metrics = (RootMeanSquareError(), TrackLoss())

    @torch.inference_mode()
    def work() -> object:
        noise = particle_filter.noise(torch.arange(_RUNS))
        belief = particle_filter.spread_around(torch.zeros(_RUNS, 2), noise)
        estimate = Talkers.of_track(particle_filter(seen[:, None], belief, _DT, noise))
        return [metric.parts(estimate, truth) for metric in metrics]

    return work


def stone_soup() -> Work:
    """Return the runs that Stone Soup's users write: its predictor, updater and resampler in a loop, scored."""
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
    from stonesoup.predictor.particle import ParticlePredictor
    from stonesoup.resampler.particle import ESSResampler, SystematicResampler
    from stonesoup.types.array import StateVectors
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import ParticleState
    from stonesoup.updater.particle import ParticleUpdater

    motion = dynamics.lehmann2007("CU-LAN")
    assert isinstance(motion, dynamics.CoordinateUncoupled)
    matrix, gain = (x.detach().double().numpy() for x in motion.matrices(_DT))
    transition = LinearGaussianTimeInvariantTransitionModel(matrix, gain @ gain.T)
    predictor = ParticlePredictor(transition)
    model = LinearGaussian(4, [0, 1], np.eye(2) * _STD**2)
    updater = ParticleUpdater(model, ESSResampler(_SHARE * _PARTICLES, SystematicResampler()))
    seen = observations().double().numpy()
    begin = datetime.datetime(2026, 1, 1)
    times = [begin + datetime.timedelta(seconds=_DT * k) for k in range(len(seen))]

    def one(seed: int) -> tuple[float, bool]:
        random = np.random.default_rng(seed)
        state = np.concatenate(
            [0.1 * random.standard_normal((2, _PARTICLES)), 0.5 * random.standard_normal((2, _PARTICLES))]
        )
        weight = np.full(_PARTICLES, 1 / _PARTICLES)
        belief: Any = ParticleState(StateVectors(state), weight=weight, timestamp=begin)
        error = []
        for time, position in zip(times, seen, strict=True):
            prediction = predictor.predict(belief, timestamp=time)
            detection = Detection(position[:, None], timestamp=time, measurement_model=model)
            belief = updater.update(SingleHypothesis(prediction, detection))
            error.append(np.linalg.norm(np.asarray(belief.mean).ravel()[:2] - position))
        return float(np.sqrt(np.mean(np.square(error)))), bool(np.mean(error[-16:]) > 0.1)

    return lambda: [one(seed) for seed in range(_THEIR_RUNS)]


def batches(sizes: tuple[int, ...], repeats: int) -> list[Row]:
    """Return what a run of 8 s of sound takes, observations included, for several numbers of runs at once."""
    with tempfile.TemporaryDirectory() as folder:
        samples = Recording.open(sounds.write(Path(folder) / "talker.wav", 8.0)).read()
    region = Region.from_yaml(sounds.ARRAY)
    assert region is not None  # the shipped array has one
    tracker = lehmann2007(MicrophoneArray.from_yaml(sounds.ARRAY), region, num_particles=_PARTICLES)
    start = torch.tensor([1.0, 1.0])

    @torch.inference_mode()
    def took(runs: int) -> Spread:
        tracker(samples, torch.arange(runs), start)
        work = lambda: tracker(samples, torch.arange(runs), start)  # noqa: E731
        return spread([1e3 * thread_seconds(work) / runs for _ in range(repeats)])

    return [Row(f"8 s of sound, {n} run{'s' if n > 1 else ''} at once: a run", took(n), None, unit="ms") for n in sizes]
