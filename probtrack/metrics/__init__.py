"""How good a track is."""

from probtrack.metrics.functional import azimuth_error as azimuth_error
from probtrack.metrics.functional import final_error as final_error
from probtrack.metrics.functional import position_error as position_error
from probtrack.metrics.functional import root_mean_square as root_mean_square
from probtrack.metrics.functional import track_lost as track_lost
from probtrack.metrics.score import Score as Score
from probtrack.metrics.score import score as score
