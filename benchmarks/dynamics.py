"""A step of 1e5 particles of every motion model, over its random numbers and one pass over its state.

Float32, `torch.inference_mode()`, a step of 32 ms; the numbers of the step are drawn within it. Coordinate-uncoupled
models take S1's printed steps and exact ones, which have two or three times the noise. A switching model is held
against the dearest of its models alone: S times its step plus 30 % is the target for S models. Clouds are in memory
variables first, as a filter keeps them, and every step follows the last, so that the modes mix.
"""

from typing import get_args

import torch
from torch import Tensor

from benchmarks.filter import Work
from benchmarks.pairs import Row, ratio_row
from probtrack.dynamics import Dynamics, Kinematics, Lehmann2007Model, lehmann2007
from probtrack.switching import MarkovChain, SwitchingDynamics, odas

_PARTICLES, _DT, _STEPS = 100_000, 0.032, 20


def run(quick: bool = False) -> list[Row]:
    """Return a row for each model, and two of switching."""
    pairs = 5 if quick else 15
    rows = []
    for name in get_args(Lehmann2007Model):
        curvilinear = name.startswith("CL")
        for printed in (True,) if curvilinear else (True, False):
            model = lehmann2007(name, printed=printed)
            what = f"{name}, {'printed' if printed else 'exact'} step"
            target = 3.0 if curvilinear else 1.5
            rows.append(ratio_row(what, steps_of(model), "floor", floor(model), pairs=pairs, target=target))
    two = [lehmann2007("CU-LAN"), lehmann2007("CL-RWVE-RAAC")]
    mixed = SwitchingDynamics(two, MarkovChain([0.5, 0.5], [[0.95, 0.05], [0.05, 0.95]]))
    three = odas()
    for what, switching, dearest, modes in (
        ("CU-LAN and CL-RWVE-RAAC, 5 % changing a frame", mixed, two[1], 2),
        ("three regimes of ODAS, drawn anew in every frame", three, three.models[0], 3),
    ):
        assert isinstance(dearest, Dynamics)
        against, target = f"dearest of {modes}", 1.3 * modes
        rows.append(ratio_row(what, steps_of(switching), against, steps_of(dearest), pairs=pairs, target=target))
    return rows


def steps_of(model: Dynamics) -> Work:
    """Return some steps of a cloud that is uniform over a room and moves at half a metre a second."""
    generator = torch.Generator().manual_seed(0)
    position, velocity = 4 * torch.rand(2, _PARTICLES, generator=generator), torch.full((2, _PARTICLES), 0.5)
    with torch.inference_mode():
        start = variables_first(model.from_kinematics(Kinematics(position.mT, velocity.mT)))

    @torch.inference_mode()
    def work() -> object:
        state, move = start, next(iter(model.moves(None, _DT)))
        for _ in range(_STEPS):
            state, _ = move(state, torch.randn(model.noise_dim, _PARTICLES, generator=generator).mT)
        return state

    return work


def floor(model: Dynamics) -> Work:
    """Return the least that such steps do: their random numbers and a new state by one elementwise sum."""

    @torch.inference_mode()
    def work() -> object:
        generator = torch.Generator().manual_seed(0)
        state = torch.zeros(model.state_dim, _PARTICLES)
        for _ in range(_STEPS):
            torch.randn(model.noise_dim, _PARTICLES, generator=generator)
            state = state + 1.0
        return state

    return work


def variables_first(state: Tensor) -> Tensor:
    """Return `state` (N, D) laid out in memory as (D, N)."""
    return state.mT.contiguous().mT
