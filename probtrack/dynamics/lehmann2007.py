"""The motion models of Lehmann and Johansson (2007) with the values of their Table 1."""

import math
from collections.abc import Callable

from probtrack._checks import as_positive
from probtrack.dynamics.base import Dynamics
from probtrack.dynamics.processes import AxisModel, Langevin, RandomWalkVelocity, TimeCorrelatedVelocity
from probtrack.dynamics.uncoupled import CoordinateUncoupled
from probtrack.errors import InputError

_AXIS_MODELS: dict[str, Callable[[float], AxisModel]] = {  # name -> model, given the step [s] of Table 1
    "CU-RWVE": lambda dt: RandomWalkVelocity(diffusion=0.05 / math.sqrt(dt)),
    "CU-TCVE": lambda _: TimeCorrelatedVelocity(speed=0.7, rate=0.3),
    "CU-LAN": lambda _: Langevin(speed=0.7, rate=0.2),
    "CU-LAN-ORIG": lambda _: Langevin(speed=0.8, rate=10.0),
}


def lehmann2007(name: str, axes: int = 2, dt: float = 0.032) -> Dynamics:
    """Return the motion model `name` of Table 1, with the table's values to start from.

    Args:
        name: As in the table: CU-RWVE, CU-TCVE, CU-LAN or CU-LAN-ORIG.
        axes: Number of coordinates A.
        dt: Frame period [s] that the table's sigma per step (CU-RWVE) is understood for; nothing else
            depends on it.

    References:
        E. A. Lehmann, A. M. Johansson, "Dynamics models for acoustic speaker tracking: preliminary results",
        report PRJ-NICTA-PM-023, 2007, Table 1. The frame period is not stated there; 32 ms is assumed.

    >>> lehmann2007("CU-LAN-ORIG")
    CoordinateUncoupled(
      axes=2
      (axis_model): Langevin(rate=10/s, speed=0.8 m/s)
    )
    """
    if name not in _AXIS_MODELS:
        raise InputError(f"name must be one of {', '.join(sorted(_AXIS_MODELS))}, got {name!r}")
    return CoordinateUncoupled(_AXIS_MODELS[name](float(as_positive(dt, "dt"))), axes)
