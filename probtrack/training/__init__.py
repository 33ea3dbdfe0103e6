"""Scenes on disk as batches to train and test trackers with.

`SceneDataModule` needs Lightning (extra `train`), which is imported when it is first named.
"""

import importlib
from typing import TYPE_CHECKING, Any

from probtrack.training.batches import SceneBatch as SceneBatch
from probtrack.training.batches import SceneSampler as SceneSampler
from probtrack.training.batches import collate as collate
from probtrack.training.observation_files import ObservationFiles as ObservationFiles
from probtrack.training.observation_files import front_end_key as front_end_key
from probtrack.training.scene_data import FrameGrid as FrameGrid
from probtrack.training.scene_data import SceneDataset as SceneDataset
from probtrack.training.scene_data import SceneItem as SceneItem
from probtrack.training.settings import FrontEndSettings as FrontEndSettings
from probtrack.training.settings import Lehmann2007FrontEnd as Lehmann2007FrontEnd
from probtrack.training.truth_at import TruthFrames as TruthFrames
from probtrack.training.truth_at import truth_at as truth_at

if TYPE_CHECKING:
    from probtrack.training.data_module import SceneDataModule as SceneDataModule


def __getattr__(name: str) -> Any:
    if name == "SceneDataModule":
        return importlib.import_module("probtrack.training.data_module").SceneDataModule
    raise AttributeError(f"module 'probtrack.training' has no attribute {name!r}")
