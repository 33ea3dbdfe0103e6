"""Recordings with truth: walks, voices, rooms, noise, and scenes and data sets on disk."""

from probtrack.simulation.data_set import DataSet as DataSet
from probtrack.simulation.data_set import load_data_set as load_data_set
from probtrack.simulation.data_set import make_data_set as make_data_set
from probtrack.simulation.data_set import read_manifest as read_manifest
from probtrack.simulation.faults import Faults as Faults
from probtrack.simulation.motion import Motion as Motion
from probtrack.simulation.presets import demo_scene as demo_scene
from probtrack.simulation.presets import preset as preset
from probtrack.simulation.presets import shipped_scenes as shipped_scenes
from probtrack.simulation.rooms import ResponseCache as ResponseCache
from probtrack.simulation.rooms import default_cache as default_cache
from probtrack.simulation.scene_folder import SceneFolder as SceneFolder
from probtrack.simulation.scene_folder import load_scene as load_scene
from probtrack.simulation.scene_folder import save_scene as save_scene
from probtrack.simulation.scenes import Recording as Recording
from probtrack.simulation.scenes import Scene as Scene
from probtrack.simulation.truth import Truth as Truth
