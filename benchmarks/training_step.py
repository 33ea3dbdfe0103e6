"""One training step through the particle filter: 32 sequences x 100 frames x 100 particles, 4-D Langevin motion.

The models are `lehmann2007("CU-LAN")` at 32 ms and `GaussianPosition` of 0.1 m, float32. A step draws the first cloud
and all random numbers, filters with resampling in every frame, and takes the gradient of the mean log evidence in the
three parameters. PyDPF does the same with the same matrices. Memory is the peak resident set of a step over what the
process held before it, in a process of its own.
"""

import math
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchmarks.pairs import Row, missing_row, peer, ratio_row, spread
from probtrack.dynamics import CoordinateUncoupled, lehmann2007
from probtrack.filters import ParticleFilter, Resampler, StopGradient
from probtrack.filters.resampling import OptimalTransport, Soft, systematic
from probtrack.likelihoods import GaussianPosition

_SEQUENCES, _FRAMES, _PARTICLES = 32, 100, 100
_DT, _STD = 0.032, 0.1  # s, m
_CLOUD, _SPEED = 0.1, 0.5  # m, m/s: standard deviations of the first cloud


class _Scheme(NamedTuple):
    """Our way of resampling, PyDPF's filter with the same, and how many times as fast we want to be."""

    ours: Resampler
    theirs: Callable[[Any, Any, torch.Generator], Any]
    target: float | None


_SCHEMES = {
    "naive": _Scheme(systematic, lambda pydpf, model, random: pydpf.DPF(model, random), None),
    "soft": _Scheme(Soft(systematic, 0.7), lambda pydpf, model, random: pydpf.SoftDPF(model, 0.7, random), 2.0),
    "stop-gradient": _Scheme(
        StopGradient(systematic), lambda pydpf, model, random: pydpf.StopGradientDPF(model, random), 2.0
    ),
    # PyDPF's cost lacks our 1/2: the same problem at twice our epsilon
    "optimal transport": _Scheme(
        OptimalTransport(epsilon=0.25),
        lambda pydpf, model, _: pydpf.OptimalTransportDPF(model, regularisation=0.5),
        1.5,
    ),
}
_LIGHT = ("soft", "stop-gradient")  # whose memory is bounded

Work = Callable[[], object]


def run(quick: bool = False) -> list[Row]:
    """Compare each scheme with PyDPF, and measure how its step grows with T and N and what memory it takes."""
    pairs = 3 if quick else 9
    pydpf = _peer_in_silence("pydpf")
    rows = []
    for name, (scheme, _, target) in _SCHEMES.items():
        what = f"{name}: times as fast"
        if pydpf is None:
            rows.append(missing_row(what, "pydpf", target))
        else:
            theirs = pydpf_step(pydpf, name)
            rows.append(ratio_row(what, our_step(scheme), "pydpf", theirs, pairs=pairs, target=target, faster=True))
    rows += [missing_row(f"{name}: times as fast", "torchfilter (not on PyPI)", 3) for name in _LIGHT]
    for name in _LIGHT:
        scheme = _SCHEMES[name].ours
        once, frames, particles = our_step(scheme), our_step(scheme, frames=2), our_step(scheme, particles=2)
        rows.append(ratio_row(f"{name}: T = 200 over T = 100", frames, "T = 100", once, pairs=pairs, target=2.2))
        rows.append(ratio_row(f"{name}: N = 200 over N = 100", particles, "N = 100", once, pairs=pairs, target=2.2))
    return [*rows, *(_memory(name, 1 if quick else 3) for name in _LIGHT)]


def our_step(scheme: Resampler, *, frames: int = 1, particles: int = 1) -> Work:
    """Return a training step of ours with `scheme`, with so many times as many `frames` and `particles`."""
    particle_filter = ParticleFilter(
        lehmann2007("CU-LAN"), GaussianPosition(_STD), num_particles=particles * _PARTICLES, resample=scheme
    )
    seeds, seen = torch.arange(_SEQUENCES), observations(frames * _FRAMES)

    def work() -> object:
        particle_filter.zero_grad()
        noise = particle_filter.noise(seeds)
        belief = particle_filter.spread_around(torch.zeros(_SEQUENCES, 2), noise, _CLOUD, _SPEED)
        belief, _ = particle_filter.run(belief, seen, _DT, noise)
        loss = -belief.log_evidence.mean()
        loss.backward()
        return loss

    return work


def pydpf_step(pydpf: ModuleType, name: str) -> Work:
    """Return the same training step by `pydpf` with its scheme `name`, in the way its manual writes models."""
    motion, error = lehmann2007("CU-LAN"), torch.nn.Parameter(torch.tensor(_STD).log())
    assert isinstance(motion, CoordinateUncoupled)
    generator = torch.Generator().manual_seed(0)

    class Prior(pydpf.Module):  # type: ignore[misc, name-defined]
        def sample(self, batch_size: int, n_particles: int, **_: Any) -> Tensor:
            spread = torch.tensor([_CLOUD, _CLOUD, _SPEED, _SPEED])
            return spread * torch.randn(batch_size, n_particles, 4, generator=generator)

    class Motion(pydpf.Module):  # type: ignore[misc, name-defined]
        def __init__(self) -> None:
            super().__init__()
            self.model = motion

        @pydpf.cached_property  # type: ignore[untyped-decorator]
        def matrices(self) -> tuple[Tensor, Tensor]:
            return self.model.matrices(_DT)

        def sample(self, prev_state: Tensor, **_: Any) -> Tensor:
            matrix, gain = self.matrices
            noise = torch.randn(*prev_state.shape[:-1], 2, generator=generator)
            return prev_state @ matrix.mT + noise @ gain.mT

    class Position(pydpf.Module):  # type: ignore[misc, name-defined]
        def __init__(self) -> None:
            super().__init__()
            self.log_std = error

        def fitness(self, state: Tensor, observation: Tensor, **_: Any) -> Tensor:
            squares = (state[..., :2] - observation[:, None]).square().sum(-1)
            return -0.5 * squares * (-2 * self.log_std).exp() - 2 * self.log_std - math.log(2 * math.pi)

    model = pydpf.FilteringModel(dynamic_model=Motion(), observation_model=Position(), prior_model=Prior())
    particle_filter = _SCHEMES[name].theirs(pydpf, model, generator)
    seen, evidence = observations(_FRAMES), pydpf.LogLikelihoodFactors()

    def work() -> object:
        particle_filter.update()
        particle_filter.zero_grad()
        factors = particle_filter(_PARTICLES, _FRAMES - 1, evidence, observation=seen)
        loss = -factors.sum(0).mean()
        loss.backward()
        return loss

    return work


def observations(frames: int) -> Tensor:
    """Return measured positions (T, 32, 2) [m] of talkers who walk by the model, with the model's error."""
    generator = torch.Generator().manual_seed(1)
    step = lehmann2007("CU-LAN").transition(_DT)
    state, path = torch.zeros(_SEQUENCES, 1, 4), []
    with torch.no_grad():
        for _ in range(frames):
            state = step(state, torch.randn(_SEQUENCES, 1, 2, generator=generator))
            path.append(state[:, 0, :2])
    return torch.stack(path) + _STD * torch.randn(frames, _SEQUENCES, 2, generator=generator)


def print_peak(name: str) -> None:
    """Print by how much a step with the scheme `name` raises the peak resident set of this process [MB] (Linux)."""
    torch.set_num_threads(1)
    small = ParticleFilter(lehmann2007("CU-LAN"), GaussianPosition(_STD), num_particles=2, resample=_SCHEMES[name].ours)
    noise = small.noise(0)
    # loads what torch loads at the first backward pass
    small.run(small.spread_around(torch.zeros(2), noise), observations(2)[:, 0], _DT, noise)[0].log_evidence.backward()
    work, before = our_step(_SCHEMES[name].ours), _status("VmRSS")
    work()
    print(_status("VmHWM") - before)


def _memory(name: str, repeats: int) -> Row:
    code = f"from benchmarks.training_step import print_peak; print_peak({name!r})"
    peaks = [
        float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
        for _ in range(repeats)
    ]
    return Row(f"{name}: peak memory of a step", spread(peaks), 60, unit="MB")


def _status(field: str) -> float:
    """Return a size that Linux keeps of this process [MB]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1000 for line in lines if line.startswith(field))


def _peer_in_silence(name: str) -> ModuleType | None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns of every computer without a GPU
        return peer(name)
