"""Motion models: transition densities p(x_t | x_{t-1})."""

from probtrack.dynamics.axis_models import AxisModel as AxisModel
from probtrack.dynamics.axis_models import DrivenAcceleration as DrivenAcceleration
from probtrack.dynamics.axis_models import DrivenVelocity as DrivenVelocity
from probtrack.dynamics.base import Dynamics as Dynamics
from probtrack.dynamics.base import Kinematics as Kinematics
from probtrack.dynamics.base import Move as Move
from probtrack.dynamics.base import Transition as Transition
from probtrack.dynamics.curvilinear import Curvilinear as Curvilinear
from probtrack.dynamics.discretisation import euler as euler
from probtrack.dynamics.discretisation import exact as exact
from probtrack.dynamics.discretisation import single_noise as single_noise
from probtrack.dynamics.heading import WithHeading as WithHeading
from probtrack.dynamics.lehmann2007 import Lehmann2007Model as Lehmann2007Model
from probtrack.dynamics.lehmann2007 import lehmann2007 as lehmann2007
from probtrack.dynamics.processes import RandomWalk as RandomWalk
from probtrack.dynamics.processes import ScalarProcess as ScalarProcess
from probtrack.dynamics.processes import TimeCorrelated as TimeCorrelated
from probtrack.dynamics.processes import WhiteNoise as WhiteNoise
from probtrack.dynamics.turning import NormalAcceleration as NormalAcceleration
from probtrack.dynamics.turning import TurnAngle as TurnAngle
from probtrack.dynamics.turning import Turning as Turning
from probtrack.dynamics.uncoupled import CoordinateUncoupled as CoordinateUncoupled
