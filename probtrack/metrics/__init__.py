"""How good a track is.

What needs torch is imported when it is first named: intervals (`bootstrap_interval`, `paired_difference`) do
without it, and `score` does without torchmetrics.
"""

import importlib
from typing import TYPE_CHECKING

from probtrack.metrics.bootstrap import Interval as Interval
from probtrack.metrics.bootstrap import PairedDifference as PairedDifference
from probtrack.metrics.bootstrap import bootstrap_interval as bootstrap_interval
from probtrack.metrics.bootstrap import paired_difference as paired_difference

if TYPE_CHECKING:
    from probtrack.metrics.agreement import AzimuthDisagreement as AzimuthDisagreement
    from probtrack.metrics.agreement import AzimuthSpread as AzimuthSpread
    from probtrack.metrics.agreement import PositionDisagreement as PositionDisagreement
    from probtrack.metrics.agreement import PositionSpread as PositionSpread
    from probtrack.metrics.agreement import azimuth_disagreement as azimuth_disagreement
    from probtrack.metrics.agreement import position_disagreement as position_disagreement
    from probtrack.metrics.association import associate as associate
    from probtrack.metrics.association import best_pairs as best_pairs
    from probtrack.metrics.azimuth import AzimuthError as AzimuthError
    from probtrack.metrics.azimuth import AzimuthRootMeanSquareError as AzimuthRootMeanSquareError
    from probtrack.metrics.calibration import Coverage as Coverage
    from probtrack.metrics.calibration import Coverage50 as Coverage50
    from probtrack.metrics.calibration import Coverage90 as Coverage90
    from probtrack.metrics.calibration import NormalisedSquareError as NormalisedSquareError
    from probtrack.metrics.calibration import inside_region as inside_region
    from probtrack.metrics.calibration import normalised_square_error as normalised_square_error
    from probtrack.metrics.episodes import detected as detected
    from probtrack.metrics.episodes import fragments as fragments
    from probtrack.metrics.episodes import latencies as latencies
    from probtrack.metrics.episodes import swaps as swaps
    from probtrack.metrics.evers2020 import DetectionRate as DetectionRate
    from probtrack.metrics.evers2020 import FalseAlarmRate as FalseAlarmRate
    from probtrack.metrics.evers2020 import FragmentationRate as FragmentationRate
    from probtrack.metrics.evers2020 import Latency as Latency
    from probtrack.metrics.evers2020 import SwapRate as SwapRate
    from probtrack.metrics.fallon2006 import HeadingMeanSpread as HeadingMeanSpread
    from probtrack.metrics.fallon2006 import HeadingMeanSquareError as HeadingMeanSquareError
    from probtrack.metrics.fallon2006 import MeanSpread as MeanSpread
    from probtrack.metrics.fallon2006 import MeanSquareError as MeanSquareError
    from probtrack.metrics.fallon2006 import mean_square_error as mean_square_error
    from probtrack.metrics.fallon2006 import position_std as position_std
    from probtrack.metrics.functional import azimuth_error as azimuth_error
    from probtrack.metrics.functional import final_error as final_error
    from probtrack.metrics.functional import position_error as position_error
    from probtrack.metrics.functional import root_mean_square as root_mean_square
    from probtrack.metrics.functional import track_lost as track_lost
    from probtrack.metrics.lehmann2007 import RootMeanSquareError as RootMeanSquareError
    from probtrack.metrics.lehmann2007 import TrackLoss as TrackLoss
    from probtrack.metrics.metric import Parts as Parts
    from probtrack.metrics.metric import TrackMetric as TrackMetric
    from probtrack.metrics.registry import known as known
    from probtrack.metrics.scoring import Score as Score
    from probtrack.metrics.scoring import score as score
    from probtrack.metrics.set_distances import GeneralisedSubPatternAssignment as GeneralisedSubPatternAssignment
    from probtrack.metrics.set_distances import OptimalSubPatternAssignment as OptimalSubPatternAssignment
    from probtrack.metrics.sets import Gospa as Gospa
    from probtrack.metrics.sets import gospa as gospa
    from probtrack.metrics.sets import ospa as ospa
    from probtrack.metrics.sets import ospa_as_released as ospa_as_released
    from probtrack.metrics.smoothness import AzimuthJumps as AzimuthJumps
    from probtrack.metrics.smoothness import LargestJump as LargestJump
    from probtrack.metrics.smoothness import Locked as Locked
    from probtrack.metrics.smoothness import largest_jump as largest_jump
    from probtrack.metrics.talkers import Talkers as Talkers

_FILES = {
    "agreement": (
        "AzimuthDisagreement",
        "AzimuthSpread",
        "PositionDisagreement",
        "PositionSpread",
        "azimuth_disagreement",
        "position_disagreement",
    ),
    "association": ("associate", "best_pairs"),
    "azimuth": ("AzimuthError", "AzimuthRootMeanSquareError"),
    "calibration": (
        "Coverage",
        "Coverage50",
        "Coverage90",
        "NormalisedSquareError",
        "inside_region",
        "normalised_square_error",
    ),
    "episodes": ("detected", "fragments", "latencies", "swaps"),
    "evers2020": ("DetectionRate", "FalseAlarmRate", "FragmentationRate", "Latency", "SwapRate"),
    "fallon2006": (
        "HeadingMeanSpread",
        "HeadingMeanSquareError",
        "MeanSpread",
        "MeanSquareError",
        "mean_square_error",
        "position_std",
    ),
    "functional": ("azimuth_error", "final_error", "position_error", "root_mean_square", "track_lost"),
    "lehmann2007": ("RootMeanSquareError", "TrackLoss"),
    "metric": ("Parts", "TrackMetric"),
    "registry": ("known",),
    "scoring": ("Score", "score"),
    "set_distances": ("GeneralisedSubPatternAssignment", "OptimalSubPatternAssignment"),
    "sets": ("Gospa", "gospa", "ospa", "ospa_as_released"),
    "smoothness": ("AzimuthJumps", "LargestJump", "Locked", "largest_jump"),
    "talkers": ("Talkers",),
}
_LATER = {name: file for file, names in _FILES.items() for name in names}


def __getattr__(name: str) -> object:
    if name not in _LATER:
        raise AttributeError(f"module 'probtrack.metrics' has no attribute {name!r}")
    globals()[name] = found = getattr(importlib.import_module(f"probtrack.metrics.{_LATER[name]}"), name)
    return found


def __dir__() -> list[str]:
    return sorted([*_LATER, "Interval", "PairedDifference", "bootstrap_interval", "paired_difference"])
