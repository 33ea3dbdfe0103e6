"""The motion models of Lehmann and Johansson (2007) with the values of their Table 1."""

import math
from collections.abc import Callable
from typing import Literal

from probtrack._checks import as_positive
from probtrack.dynamics.axis_models import DrivenAcceleration, DrivenVelocity
from probtrack.dynamics.base import Dynamics
from probtrack.dynamics.curvilinear import Curvilinear
from probtrack.dynamics.discretisation import Discretisation, euler, exact, single_noise
from probtrack.dynamics.processes import RandomWalk, ScalarProcess, TimeCorrelated, WhiteNoise
from probtrack.dynamics.turning import NormalAcceleration, TurnAngle, Turning
from probtrack.dynamics.uncoupled import CoordinateUncoupled
from probtrack.errors import InputError

Lehmann2007Model = Literal[
    "CU-RWVE", "CU-TCVE", "CU-TCAC", "CU-LAN", "CU-LAN-ORIG",
    "CL-RWVE-RWTU", "CL-TCVE-TCTU", "CL-RWVE-RAAC", "CL-RWVE-RWAC", "CL-TCVE-TCAC",
]  # fmt: skip
"""Names of Table 1."""

_Axis = tuple[type[DrivenVelocity] | type[DrivenAcceleration], ScalarProcess, Discretisation]

# name -> parts, given the square root of the step of Table 1: its random walks are per step
_UNCOUPLED: dict[str, Callable[[float], _Axis]] = {
    "CU-RWVE": lambda root: (DrivenVelocity, RandomWalk(0.05 / root), single_noise),
    "CU-TCVE": lambda _: (DrivenVelocity, TimeCorrelated(rate=0.3, std=0.7), single_noise),
    "CU-TCAC": lambda _: (DrivenAcceleration, TimeCorrelated(rate=30.0, std=2.0), single_noise),
    "CU-LAN": lambda _: (DrivenVelocity, TimeCorrelated(rate=0.2, std=0.7), euler),
    "CU-LAN-ORIG": lambda _: (DrivenVelocity, TimeCorrelated(rate=10.0, std=0.8), euler),
}
_CURVILINEAR: dict[str, Callable[[float], tuple[ScalarProcess, Turning]]] = {
    "CL-RWVE-RWTU": lambda root: (RandomWalk(0.7 / root), TurnAngle(RandomWalk(2.0 / root))),
    "CL-TCVE-TCTU": lambda _: (TimeCorrelated(rate=0.2, std=0.9), TurnAngle(TimeCorrelated(rate=2.0, std=3.0))),
    "CL-RWVE-RAAC": lambda root: (RandomWalk(0.07 / root), NormalAcceleration(WhiteNoise(1.5 * root))),
    "CL-RWVE-RWAC": lambda root: (RandomWalk(0.3 / root), NormalAcceleration(RandomWalk(2.0 / root))),
    "CL-TCVE-TCAC": lambda _: (TimeCorrelated(rate=0.15, std=3.0), NormalAcceleration(TimeCorrelated(1.0, 3.0))),
}


def lehmann2007(name: str, axes: int = 2, dt: float = 0.032, *, printed: bool = True) -> Dynamics:
    """Return the motion model `name` of Table 1, with the table's values to start from.

    Args:
        name: As in the table: CU-RWVE, CU-TCVE, CU-TCAC, CU-LAN, CU-LAN-ORIG, CL-RWVE-RWTU, CL-TCVE-TCTU,
            CL-RWVE-RAAC, CL-RWVE-RWAC or CL-TCVE-TCAC.
        axes: Number of coordinates A.
        dt: Frame period [s] that the table's sigma per step (random walks and white noise) is understood for;
            nothing else depends on it.
        printed: Whether a coordinate-uncoupled model takes the steps that S1 prints (eq. 17, 18, 20, 21) or
            `exact` ones, which have a density. Curvilinear models have the printed step only.

    Raises:
        InputError: for a name that is not in the table, or an exact step that does not exist.

    References:
        S1 Table 1. The frame period is not stated there; 32 ms is assumed.

    >>> lehmann2007("CU-LAN-ORIG")
    CoordinateUncoupled(
      axes=2
      (axis_model): DrivenVelocity(
        discretise=euler
        (process): TimeCorrelated(rate=10/s, std=0.8)
      )
    )
    """
    root = math.sqrt(float(as_positive(dt, "dt")))
    known = [*_UNCOUPLED, *_CURVILINEAR]
    if name not in known:
        raise InputError(f"name must be one of {', '.join(known)}, got {name!r}")
    if name in _UNCOUPLED:
        driven, process, discretise = _UNCOUPLED[name](root)
        return CoordinateUncoupled(driven(process, discretise if printed else exact), axes)
    if not printed:
        raise InputError(f"printed must be True for {name}: a curvilinear motion has no exact step in closed form")
    return Curvilinear(*_CURVILINEAR[name](root), axes=axes)
