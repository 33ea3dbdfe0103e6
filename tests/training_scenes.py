"""Small data sets on disk for the tests of training: two talkers in three scenes at two SNRs, or one talker in two."""

import functools
import shutil

import pytest
import torch

from probtrack.geometry import MicrophoneArray, Region
from probtrack.simulation import DataSet, Scene, make_data_set
from probtrack.simulation.rooms import ShoeboxRoom
from probtrack.simulation.trajectories import Arc, GivenPaths, Through
from probtrack.simulation.voices import SyntheticVoices
from probtrack.training import Lehmann2007FrontEnd, SceneDataset, collate

# the first walks round the microphones behind their back, so that its azimuth goes through pi
WAYS = (Arc((1.1, 1.2, 1.4), 0.5, 2.5, 3.9, 0.3), Through(((2.4, 2.6, 1.6), (2.9, 1.3, 1.6)), 0.3))
LOW, HIGH = (0.0, 0.0), (3.6, 3.1)
MICROPHONES = [[1.1, 1.2, 1.3], [1.3, 1.2, 1.3], [1.2, 1.35, 1.38]]


def array():
    """In the precision of the test."""
    return MicrophoneArray(MICROPHONES, "three")


def front_end(**settings):
    """For the array, at 16 kHz."""
    return Lehmann2007FrontEnd(**settings).make(array(), 16_000)


def small_scene(file, **changes):
    """Anechoic, so without pyroomacoustics and in a moment."""
    room = ShoeboxRoom(size=(3.6, 3.1, 2.4), t60=0.0)
    settings = {"duration": 1.3, "trajectories": GivenPaths(WAYS), "num_talkers": 2, "array": str(file)}
    return Scene(room=room, voices=SyntheticVoices(), **(settings | changes))


@functools.cache  # a fixture of a session is made once in every file that takes it from here
def _made(folder):
    file = folder / "three.yaml"
    array().to_yaml(file)
    for _ in make_data_set(DataSet((small_scene(file),), 3, (5.0, 20.0), 4), folder / "set", None):
        pass
    return folder / "set"


@pytest.fixture(scope="session")
def small_data_set(tmp_path_factory):
    """A data set that no test may change."""
    folder = tmp_path_factory.getbasetemp() / "small"
    folder.mkdir(exist_ok=True)
    return _made(folder)


@functools.cache
def _made_for_one(folder):
    file = folder / "three.yaml"
    array().to_yaml(file, Region(LOW, HIGH))
    one = small_scene(file, duration=0.9, num_talkers=1, trajectories=GivenPaths(WAYS[1:]))
    for _ in make_data_set(DataSet((one,), 2, (20.0,), 4), folder / "set", None):
        pass
    return folder


@pytest.fixture(scope="session")
def one_talker(tmp_path_factory):
    """A folder with a data set, `set`, of two scenes with one talker, and their array with its region, `three.yaml`."""
    folder = tmp_path_factory.getbasetemp() / "one"
    folder.mkdir(exist_ok=True)
    return _made_for_one(folder)


@pytest.fixture
def data_set(small_data_set, tmp_path):
    """A copy of one's own."""
    return shutil.copytree(small_data_set, tmp_path / "set")


@pytest.fixture
def float32():
    """The precision that users have."""
    torch.set_default_dtype(torch.float32)


def one_batch(folder, tracker, *numbers):
    """Recordings of `one_talker`, all if none is named, as sound on the frames of `tracker`."""
    dataset = SceneDataset(folder / "set", stft=tracker.front_end.stft)
    return collate([dataset[number] for number in numbers or range(len(dataset))])
