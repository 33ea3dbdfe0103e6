"""What microphones hear of talkers in rooms, simulated or measured."""

from probtrack.simulation.rooms.base import Room as Room
from probtrack.simulation.rooms.shoebox import LEAD as LEAD
from probtrack.simulation.rooms.shoebox import ShoeboxRoom as ShoeboxRoom
from probtrack.simulation.rooms.shoebox import add_noise as add_noise
from probtrack.simulation.rooms.shoebox import reverberation_time as reverberation_time
