"""Training: data as batches, losses, and what turns both into better parameters.

What needs Lightning (extra `train`) is imported when it is first named.
"""

import importlib
from typing import TYPE_CHECKING

from probtrack.parameters import physical as physical
from probtrack.parameters import physical_summary as physical_summary
from probtrack.parameters import physical_values as physical_values
from probtrack.parameters import read_parameters as read_parameters
from probtrack.parameters import unconstrained as unconstrained
from probtrack.parameters import write_parameters as write_parameters
from probtrack.training.batches import SceneBatch as SceneBatch
from probtrack.training.batches import SceneSampler as SceneSampler
from probtrack.training.batches import collate as collate
from probtrack.training.losses import CloudLikelihood as CloudLikelihood
from probtrack.training.losses import Loss as Loss
from probtrack.training.losses import NegativeLogEvidence as NegativeLogEvidence
from probtrack.training.losses import Outcome as Outcome
from probtrack.training.losses import ProposalLoss as ProposalLoss
from probtrack.training.losses import SquaredError as SquaredError
from probtrack.training.losses import WeightedSum as WeightedSum
from probtrack.training.observation_files import ObservationFiles as ObservationFiles
from probtrack.training.observation_files import front_end_key as front_end_key
from probtrack.training.scene_data import FrameGrid as FrameGrid
from probtrack.training.scene_data import SceneDataset as SceneDataset
from probtrack.training.scene_data import SceneItem as SceneItem
from probtrack.training.settings import FrontEndSettings as FrontEndSettings
from probtrack.training.settings import Lehmann2007FrontEnd as Lehmann2007FrontEnd
from probtrack.training.settings import Lehmann2007Settings as Lehmann2007Settings
from probtrack.training.settings import TrackerSettings as TrackerSettings
from probtrack.training.trajectories import Trajectory as Trajectory
from probtrack.training.trajectories import TrajectoryBatch as TrajectoryBatch
from probtrack.training.trajectories import TrajectoryDataset as TrajectoryDataset
from probtrack.training.trajectories import check_trajectory as check_trajectory
from probtrack.training.trajectories import collate_trajectories as collate_trajectories
from probtrack.training.trajectories_paths import FixedPaths as FixedPaths
from probtrack.training.trajectories_reading import read_trajectories as read_trajectories
from probtrack.training.trajectories_sampled import SampledTrajectories as SampledTrajectories
from probtrack.training.trajectories_sampled import TrajectorySource as TrajectorySource
from probtrack.training.trajectories_sampled import WalkedTrajectories as WalkedTrajectories
from probtrack.training.truth_at import TruthFrames as TruthFrames
from probtrack.training.truth_at import truth_at as truth_at
from probtrack.training.windows import run_in_windows as run_in_windows

if TYPE_CHECKING:
    from probtrack.training.data_module import SceneDataModule as SceneDataModule
    from probtrack.training.fit import Fit as Fit
    from probtrack.training.likelihood_fit import LikelihoodFit as LikelihoodFit
    from probtrack.training.scene_fit import SceneFit as SceneFit
    from probtrack.training.trajectories_data_module import TrajectoryDataModule as TrajectoryDataModule
    from probtrack.training.trajectories_fit import TrajectoryFit as TrajectoryFit


_LIGHTNING = {
    "SceneDataModule": "data_module",
    "Fit": "fit",
    "LikelihoodFit": "likelihood_fit",
    "SceneFit": "scene_fit",
    "TrajectoryDataModule": "trajectories_data_module",
    "TrajectoryFit": "trajectories_fit",
}


def __getattr__(name: str) -> object:
    if name in _LIGHTNING:
        return getattr(importlib.import_module(f"probtrack.training.{_LIGHTNING[name]}"), name)
    if name == "bayesian":  # loads pyro's inference
        return importlib.import_module("probtrack.training.bayesian")
    raise AttributeError(f"module 'probtrack.training' has no attribute {name!r}")
