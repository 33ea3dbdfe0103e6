"""What microphones hear of sources in rooms, simulated or measured."""

from probtrack.simulation.rooms.base import Room as Room
from probtrack.simulation.rooms.cache import ResponseCache as ResponseCache
from probtrack.simulation.rooms.cache import default_cache as default_cache
from probtrack.simulation.rooms.direct import LEAD as LEAD
from probtrack.simulation.rooms.directivity import SPEECH as SPEECH
from probtrack.simulation.rooms.directivity import Directivity as Directivity
from probtrack.simulation.rooms.measured import MeasuredRoom as MeasuredRoom
from probtrack.simulation.rooms.reverberation import reverberation_time as reverberation_time
from probtrack.simulation.rooms.shoebox import ShoeboxRoom as ShoeboxRoom
