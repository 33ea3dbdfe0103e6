"""Motion models: transition densities p(x_t | x_{t-1})."""

from probtrack.dynamics.base import Dynamics as Dynamics
from probtrack.dynamics.base import Kinematics as Kinematics
from probtrack.dynamics.base import Transition as Transition
from probtrack.dynamics.lehmann2007 import lehmann2007 as lehmann2007
from probtrack.dynamics.processes import AxisModel as AxisModel
from probtrack.dynamics.processes import Langevin as Langevin
from probtrack.dynamics.processes import RandomWalkVelocity as RandomWalkVelocity
from probtrack.dynamics.processes import TimeCorrelatedVelocity as TimeCorrelatedVelocity
from probtrack.dynamics.uncoupled import CoordinateUncoupled as CoordinateUncoupled
