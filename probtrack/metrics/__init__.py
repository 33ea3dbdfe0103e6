"""How good a track is.

Everything that needs torch is imported when it is first named: intervals (`bootstrap_interval`, `paired_difference`) do
without, and `probtrack score` without torchmetrics.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from probtrack.metrics.functional import azimuth_error as azimuth_error
    from probtrack.metrics.functional import final_error as final_error
    from probtrack.metrics.functional import position_error as position_error
    from probtrack.metrics.functional import root_mean_square as root_mean_square
    from probtrack.metrics.functional import track_lost as track_lost
    from probtrack.metrics.lehmann2007 import RootMeanSquareError as RootMeanSquareError
    from probtrack.metrics.lehmann2007 import TrackLoss as TrackLoss
    from probtrack.metrics.metric import Parts as Parts
    from probtrack.metrics.metric import TrackMetric as TrackMetric
    from probtrack.metrics.scoring import Score as Score
    from probtrack.metrics.scoring import score as score
    from probtrack.metrics.talkers import Talkers as Talkers

_LATER = {
    "functional": ("azimuth_error", "final_error", "position_error", "root_mean_square", "track_lost"),
    "lehmann2007": ("RootMeanSquareError", "TrackLoss"),
    "metric": ("Parts", "TrackMetric"),
    "scoring": ("Score", "score"),
    "talkers": ("Talkers",),
}
_FILES = {name: file for file, names in _LATER.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _FILES:
        raise AttributeError(f"module 'probtrack.metrics' has no attribute {name!r}")
    globals()[name] = found = getattr(importlib.import_module(f"probtrack.metrics.{_FILES[name]}"), name)
    return found


def __dir__() -> list[str]:
    return sorted(_FILES)
