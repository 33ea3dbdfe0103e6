"""Are the parameters of a motion model found again from noisy positions, whatever one starts from?

python -m experiments.recovery

Talkers are simulated by Table 1's values; a model that starts elsewhere is fitted by maximising the exact evidence of
the Kalman filter. How well that can be done is a matter of the data: a correlation time is known from the number of
times it passes, and the acceleration of CU-TCAC, correlated over a thirtieth of a second, moves a talker by a
millimetre in that time, so that it is seen only by a finer measurement.
"""

import json
import math
import time
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from experiments.command import run
from probtrack.dynamics import CoordinateUncoupled, lehmann2007
from probtrack.filters import Gaussian, kalman_filter, position_system


class Data(NamedTuple):
    """What is simulated: frames, paths, time step [s], error of a position [m]."""

    frames: int
    paths: int
    dt: float
    error: float


DATA = {
    "CU-LAN": Data(30, 300, 0.5, 0.02),
    "CU-TCAC": Data(60, 60, 0.01, 5e-5),
    "CU-RWVE": Data(30, 60, 0.1, 0.02),
}
FACTORS = {2: ((4.0, 0.3), (0.25, 3.5)), 1: ((0.2,), (5.0,))}  # of the true values, by the number of parameters


@dataclass(frozen=True)
class Config:
    """Fit each model from two wrong starts."""

    seed: int = 0


def main(config: Config) -> dict[str, Any]:
    """Print and return true, starting and fitted values of each model."""
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    result = {name: recover(name, data, config.seed) for name, data in DATA.items()}
    print(json.dumps({"config": asdict(config), "result": result}))
    return result


def recover(name: str, data: Data, seed: int) -> dict[str, Any]:
    """Simulate talkers by the model `name` and fit it to their measured positions from each start."""
    torch.manual_seed(seed)
    truth = lehmann2007(name)
    state, positions = torch.zeros(data.paths, truth.state_dim), []
    step = truth.transition(data.dt)
    with torch.no_grad():
        for _ in range(data.frames):
            state = step(state, torch.randn(data.paths, truth.noise_dim))
            positions.append(truth.kinematics(state).position)
    measured = torch.stack(positions) + data.error * torch.randn(data.frames, data.paths, truth.axes)
    names = [name.rpartition("log_")[2] for name, _ in truth.named_parameters()]
    true = [float(p.detach().exp()) for p in truth.parameters()]
    fits = []
    for factors in FACTORS[len(true)]:
        model = lehmann2007(name)
        assert isinstance(model, CoordinateUncoupled)
        begin, before = [factor * value for factor, value in zip(factors, true, strict=True)], time.perf_counter()
        found = fit(model, begin, measured, data)
        fits.append(
            {"start": _rounded(begin), "fitted": _rounded(found), "seconds": round(time.perf_counter() - before, 1)}
        )
    return {"parameters": names, "true": _rounded(true), "fits": fits}


def fit(model: CoordinateUncoupled, start: list[float], measured: Tensor, data: Data) -> list[float]:
    """Return the parameters that maximise the evidence of `measured` (T, paths, 2), from `start`."""
    with torch.no_grad():
        for parameter, value in zip(model.parameters(), start, strict=True):
            parameter.fill_(math.log(value))
    rest = Gaussian(torch.zeros(model.state_dim), torch.zeros(model.state_dim, model.state_dim))
    optimiser = torch.optim.LBFGS(model.parameters(), line_search_fn="strong_wolfe", max_iter=40, tolerance_change=1e-7)

    def loss() -> Tensor:
        optimiser.zero_grad()
        system = position_system(model, data.dt, data.error)
        value = -kalman_filter(measured, system, rest).increments.mean()
        value.backward()
        return value

    optimiser.step(loss)
    return [float(p.detach().exp()) for p in model.parameters()]


def _rounded(values: list[float]) -> list[float]:
    return [float(f"{value:.4g}") for value in values]


if __name__ == "__main__":
    run(main, Config)
