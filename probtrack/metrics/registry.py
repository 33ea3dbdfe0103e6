"""The metrics that studies know by name."""

from probtrack.metrics.agreement import AzimuthDisagreement, AzimuthSpread, PositionDisagreement, PositionSpread
from probtrack.metrics.azimuth import AzimuthError, AzimuthRootMeanSquareError
from probtrack.metrics.calibration import Coverage50, Coverage90, NormalisedSquareError
from probtrack.metrics.evers2020 import DetectionRate, FalseAlarmRate, FragmentationRate, Latency, SwapRate
from probtrack.metrics.fallon2006 import HeadingMeanSpread, HeadingMeanSquareError, MeanSpread, MeanSquareError
from probtrack.metrics.lehmann2007 import RootMeanSquareError, TrackLoss
from probtrack.metrics.metric import TrackMetric
from probtrack.metrics.set_distances import GeneralisedSubPatternAssignment, OptimalSubPatternAssignment
from probtrack.metrics.smoothness import AzimuthJumps, LargestJump, Locked

_CLASSES: tuple[type[TrackMetric], ...] = (
    RootMeanSquareError, TrackLoss,
    MeanSquareError, MeanSpread, HeadingMeanSquareError, HeadingMeanSpread,
    AzimuthError, AzimuthRootMeanSquareError,
    Coverage50, Coverage90, NormalisedSquareError,
    DetectionRate, FalseAlarmRate, Latency, FragmentationRate, SwapRate,
    OptimalSubPatternAssignment, GeneralisedSubPatternAssignment,
    AzimuthJumps, LargestJump, Locked, AzimuthDisagreement, AzimuthSpread, PositionDisagreement, PositionSpread,
)  # fmt: skip


def known() -> dict[str, type[TrackMetric]]:
    """Return the metrics by name, all of which can be made without arguments.

    >>> list(known())[:2], known()["rmse"].unit
    (['rmse', 'track_loss'], 'm')
    """
    return {one.name: one for one in _CLASSES}
