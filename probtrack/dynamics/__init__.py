"""Motion models: transition densities p(x_t | x_{t-1})."""

from probtrack.dynamics.base import Dynamics as Dynamics
from probtrack.dynamics.base import Kinematics as Kinematics
from probtrack.dynamics.base import Transition as Transition
