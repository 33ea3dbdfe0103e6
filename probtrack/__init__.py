"""Probabilistic tracking of speakers with microphone arrays: who is speaking, where, and which way they face.

The rooms of the package are imported when they are first named, so that a command which only prints the
list of commands does not wait for torch:

>>> import probtrack as pt
>>> pt.geometry.Region(low=(0.0, 0.0), high=(3.5, 3.1)).volume
10.85
"""

import importlib
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from probtrack import audio as audio
    from probtrack import distributions as distributions
    from probtrack import dynamics as dynamics
    from probtrack import errors as errors
    from probtrack import evaluation as evaluation
    from probtrack import filters as filters
    from probtrack import geometry as geometry
    from probtrack import likelihoods as likelihoods
    from probtrack import metrics as metrics
    from probtrack import parameters as parameters
    from probtrack import plotting as plotting
    from probtrack import simulation as simulation
    from probtrack import switching as switching
    from probtrack import track_files as track_files
    from probtrack import trackers as trackers
    from probtrack import tracks as tracks
    from probtrack import training as training

__version__ = "0.1.0"

_ROOMS = (
    "audio", "distributions", "dynamics", "errors", "evaluation", "filters", "geometry", "likelihoods",
    "metrics", "parameters", "plotting", "simulation", "switching", "track_files", "trackers", "tracks", "training",
)  # fmt: skip


def __getattr__(name: str) -> ModuleType:
    if name in _ROOMS:
        return importlib.import_module(f"probtrack.{name}")
    raise AttributeError(f"module 'probtrack' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*_ROOMS, "__version__"])
