"""A hidden autoregressive sequence seen through noise: where the exact evidence is known, or figures are published.

Parameters may have one value for each run of a batch, so that one backward pass gives each run's own gradient.
"""

import math

import torch
from torch import Tensor, nn
from torch.distributions import Distribution, Independent, Normal

from probtrack.dynamics import CoordinateUncoupled, Dynamics, Kinematics, Transition
from probtrack.likelihoods import Likelihood

_LOG_ROOT = 0.5 * math.log(2 * math.pi)


class Autoregressive(Dynamics):
    r"""Each of d variables forgets itself and is driven by its own noise:

    .. math:: x' = a\,x + \sigma u, \qquad u \sim \mathcal N(0, I_d) .

    Args:
        coefficient: Initial a, () or (\*batch, 1, 1).
        std: Initial sigma, of the same shape; learnable as `log_std`.
        dim: d.
    """

    def __init__(self, coefficient: Tensor, std: Tensor, dim: int = 1) -> None:
        super().__init__()
        self.coefficient, self.log_std = nn.Parameter(coefficient), nn.Parameter(std.log())
        self.state_dim = self.noise_dim = self.axes = dim

    def forward(self, state: Tensor, dt: float | Tensor) -> Independent:  # noqa: ARG002 - a frame is the unit of time
        coefficient, std = _aligned(self.coefficient, state), _aligned(self.log_std, state).exp()
        law = Normal(coefficient * state, std.expand_as(state), validate_args=False)
        return Independent(law, 1, validate_args=False)

    def transition(self, dt: float | Tensor) -> Transition:  # noqa: ARG002
        coefficient, std = self.coefficient, self.log_std.exp()
        return lambda state, noise: coefficient * state + std * noise

    def matrices(self, dt: float) -> tuple[Tensor, Tensor]:  # noqa: ARG002
        r"""Return F (\*batch, d, d) and G (\*batch, d, d) of a step."""
        eye = torch.eye(self.state_dim).to(self.coefficient)
        return self.coefficient * eye, self.log_std.exp() * eye

    def kinematics(self, state: Tensor) -> Kinematics:
        """Return the variables as a position; they have no velocity."""
        return Kinematics(state, torch.zeros_like(state))

    def from_kinematics(self, kinematics: Kinematics) -> Tensor:
        return kinematics.position


class EachRun(Dynamics):
    """A coordinate-uncoupled model with parameters of its own for each run.

    Args:
        model: Its parameters are where all runs start.
        runs: How many there are.
    """

    def __init__(self, model: CoordinateUncoupled, runs: int) -> None:
        super().__init__()
        self.model, self.runs = model, runs
        self.state_dim, self.noise_dim, self.axes = model.state_dim, model.noise_dim, model.axes
        for part in model.modules():
            for name, value in list(part.named_parameters(recurse=False)):
                setattr(part, name, nn.Parameter(value.detach().expand(runs, 1).clone()))

    def forward(self, state: Tensor, dt: float | Tensor) -> Distribution:
        return self.model(state, self._steps(dt))

    def transition(self, dt: float | Tensor) -> Transition:
        return self.model.transition(self._steps(dt))

    def matrices(self, dt: float) -> tuple[Tensor, Tensor]:
        """Return F (runs, D, D) and G (runs, D, K) of a step."""
        F, G = self.model.matrices(self._steps(dt))
        return F[:, 0], G[:, 0]

    def kinematics(self, state: Tensor) -> Kinematics:
        return self.model.kinematics(state)

    def from_kinematics(self, kinematics: Kinematics) -> Tensor:
        return self.model.from_kinematics(kinematics)

    def _steps(self, dt: float | Tensor) -> Tensor:
        return torch.as_tensor(dt).expand(self.runs, 1)


class NoisyPosition(Likelihood):
    r"""Every variable is seen with its own error, :math:`y = x + \sigma e`, as `GaussianPosition` but for each run.

    Args:
        std: Initial sigma, () or (\*batch, 1); learnable as `log_std`.
    """

    def __init__(self, std: Tensor) -> None:
        super().__init__()
        self.log_std = nn.Parameter(std.log())

    def prepare(self, observations: Tensor) -> Tensor:
        return observations[..., None, :]

    def forward(self, observation: Tensor, kinematics: Kinematics) -> Tensor:
        error = (observation - kinematics.position) * (-self.log_std).exp()[..., None]
        return -0.5 * error.square().sum(-1) - error.shape[-1] * (self.log_std + _LOG_ROOT)


class Volatility(Likelihood):
    r"""A return whose log variance is hidden: :math:`y = \beta e^{x / 2} e, \; e \sim \mathcal N(0, 1)`.

    Args:
        scale: beta, constant.
    """

    def __init__(self, scale: float) -> None:
        super().__init__()
        self.scale = scale

    def prepare(self, observations: Tensor) -> Tensor:
        return observations[..., None, :] / self.scale

    def forward(self, observation: Tensor, kinematics: Kinematics) -> Tensor:
        state = kinematics.position
        return (-0.5 * (observation.square() * (-state).exp() + state)).sum(-1) - _LOG_ROOT - math.log(self.scale)


def _aligned(parameter: Tensor, state: Tensor) -> Tensor:
    """Return `parameter` (*batch, 1, 1) or () with as many dimensions as `state` (*batch, ..., N, D)."""
    if parameter.ndim == 0:
        return parameter
    return parameter.view(*parameter.shape[:-2], *[1] * (state.ndim - parameter.ndim + 2))
