"""What one coordinate of a talker does between two frames, when the other coordinates play no part."""

import abc

from torch import Tensor, nn

from probtrack.dynamics.discretisation import Discretisation, exact
from probtrack.dynamics.processes import ScalarProcess


class AxisModel(nn.Module, abc.ABC):
    """Linear motion of one coordinate driven by standard normal numbers, s' = matrix s + gain u.

    The state of the coordinate is its position and K - 1 derivatives, K at least 2.
    """

    @abc.abstractmethod
    def forward(self, dt: float | Tensor) -> tuple[Tensor, Tensor]:
        """Return the matrix (..., K, K) and the gain (..., K, J) of a step of `dt` (...) [s]."""


class DrivenVelocity(AxisModel):
    r"""A coordinate whose velocity is a scalar process: :math:`dx = \dot x\,dt, \; \dot x = \xi`.

    With a random walk that is "nearly constant velocity" (CU-RWVE), with a time-correlated process CU-TCVE,
    or, by `euler` steps, Langevin motion (CU-LAN).

    Args:
        process: What the velocity does [m/s].
        discretise: `exact` by default: only then the step has a density, and a fit at one frame rate is right
            at every other. It costs two noise numbers where S1's `single_noise` and `euler` cost one.

    Shape:
        dt: float or (...) [s]. Returns (..., 2, 2) and (..., 2, J), J = 2 if exact, else 1.

    References:
        S1 eq. 17, 18 (`single_noise`) and 21 (`euler`).

    >>> from probtrack.dynamics import TimeCorrelated, euler
    >>> matrix, gain = DrivenVelocity(TimeCorrelated(rate=2.0, std=0.7), discretise=euler)(0.5)
    >>> [round(x, 4) for x in (*matrix.flatten().tolist(), *gain.flatten().tolist())]
    [1.0, 0.1839, 0.0, 0.3679, 0.3255, 0.6509]
    """

    def __init__(self, process: ScalarProcess, discretise: Discretisation = exact) -> None:
        super().__init__()
        self.process, self.discretise = process, discretise

    def forward(self, dt: float | Tensor) -> tuple[Tensor, Tensor]:
        return self.discretise(self.process, 2, dt)

    def extra_repr(self) -> str:
        return f"discretise={_name(self.discretise)}"


class DrivenAcceleration(AxisModel):
    r"""A coordinate whose acceleration is a scalar process: :math:`dx = \dot x\,dt, \; d\dot x = \xi\,dt`.

    With a time-correlated process that is Singer's manoeuvring target (CU-TCAC), with a random walk the
    Wiener-process acceleration model.

    Args:
        process: What the acceleration does [m/s^2].
        discretise: `exact` by default, for the reasons given at `DrivenVelocity`; three noise numbers a step
            where `single_noise` and `euler` have one.

    Shape:
        dt: float or (...) [s]. Returns (..., 3, 3) and (..., 3, J), J = 3 if exact, else 1.

    References:
        S1 eq. 19, 20 (`single_noise`). R. A. Singer, "Estimating optimal tracking filter performance for manned
        maneuvering targets", IEEE Trans. Aerospace and Electronic Systems 6(4):473-483, 1970.

    >>> from probtrack.dynamics import TimeCorrelated, single_noise
    >>> matrix, gain = DrivenAcceleration(TimeCorrelated(rate=2.0, std=0.5), discretise=single_noise)(0.5)
    >>> [round(x, 4) for x in matrix[0].tolist()]
    [1.0, 0.5, 0.092]
    """

    def __init__(self, process: ScalarProcess, discretise: Discretisation = exact) -> None:
        super().__init__()
        self.process, self.discretise = process, discretise

    def forward(self, dt: float | Tensor) -> tuple[Tensor, Tensor]:
        return self.discretise(self.process, 3, dt)

    def extra_repr(self) -> str:
        return f"discretise={_name(self.discretise)}"


def _name(function: Discretisation) -> str:
    return getattr(function, "__name__", repr(function))
