"""Trackers with printed, learned and given parameters."""

import pytest
import torch
import yaml

from probtrack.errors import InputError
from probtrack.filters import Relocation
from probtrack.geometry import MicrophoneArray, Region, shipped_arrays
from probtrack.parameters import physical_values, write_parameters
from probtrack.trackers import lehmann2007
from probtrack.trackers.lehmann2007 import learned_models


@pytest.fixture
def array():
    return MicrophoneArray.from_yaml(shipped_arrays()["lehmann2007"])


REGION = Region((0.0, 0.0), (3.5, 3.1))


def shipped(array, model):
    return lehmann2007(array, REGION, model, parameters="learned")


SHIPPED = ["CU-LAN", "CU-TCVE"]


def test_what_ships():
    assert sorted(learned_models()) == SHIPPED


@pytest.mark.parametrize("model", SHIPPED)
def test_learned_parameters_are_those_of_the_file(array, model):
    values = yaml.safe_load(learned_models()[model].read_text(encoding="utf-8"))["parameters"]
    tracker = shipped(array, model)
    there = physical_values(tracker)
    for name, value in values.items():
        torch.testing.assert_close(there[name], torch.tensor(value), rtol=1e-6, atol=0.0)


@pytest.mark.parametrize("model", SHIPPED)
def test_learned_files_say_what_made_them(model):
    made_by = yaml.safe_load(learned_models()[model].read_text(encoding="utf-8"))["made_by"]
    assert made_by["command"].startswith("python -m experiments.")
    assert {"data", "seed", "model"} <= made_by.keys()


def test_learned_trackers_find_a_talker_again(array):
    assert isinstance(shipped(array, "CU-LAN").filter.relocation, Relocation)
    assert lehmann2007(array, REGION).filter.relocation is None


def test_a_learned_tracker_follows_sound(array):
    tracker = shipped(array, "CU-LAN")
    noise = torch.randn(8, 8000)
    track = tracker(noise, torch.arange(2), torch.tensor([1.7, 1.5]))
    assert track.position.isfinite().all()


def test_a_file_of_ones_own(array, tmp_path):
    tracker = lehmann2007(array, REGION)
    with torch.no_grad():
        tracker.filter.likelihood.log_exponent.fill_(1.5)
    write_parameters(tmp_path / "mine.yaml", tracker, {})
    again = lehmann2007(array, REGION, parameters=str(tmp_path / "mine.yaml"))
    torch.testing.assert_close(again.filter.likelihood.log_exponent.detach(), torch.tensor(1.5))
    assert again.filter.relocation is None


def test_a_model_without_learned_parameters(array):
    with pytest.raises(InputError, match=r"parameters: none are learned for odas: there are those of .*CU-LAN"):
        shipped(array, "odas")


def test_a_file_of_another_model(array, tmp_path):
    write_parameters(tmp_path / "other.yaml", lehmann2007(array, REGION, "CU-RWVE"), {})
    with pytest.raises(InputError, match=r"parameters of another model: unknown filter.dynamics.*diffusion"):
        lehmann2007(array, REGION, "CU-LAN", parameters=str(tmp_path / "other.yaml"))


def test_a_file_that_is_not_there(array):
    with pytest.raises(InputError, match=r"nowhere\.yaml: cannot read parameter file"):
        lehmann2007(array, REGION, parameters="nowhere.yaml")
