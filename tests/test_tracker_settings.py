"""Trackers as settings: what they make, in Python and in configurations, and the parameters they begin with."""

from pathlib import Path

import pytest
import torch
import training_scenes
from jsonargparse import ArgumentParser

from probtrack.dynamics import lehmann2007
from probtrack.errors import InputError
from probtrack.filters import Adaptive, Relocation, StopGradient, resampling
from probtrack.geometry import MicrophoneArray, Region, shipped_arrays
from probtrack.likelihoods import GaussianPosition
from probtrack.parameters import physical_values, write_parameters
from probtrack.trackers import lehmann2007 as tracker_of
from probtrack.training import Lehmann2007FrontEnd, Lehmann2007Settings, TrackerSettings

one_talker = training_scenes.one_talker


def same_parameters(one, other):
    mine, theirs = dict(one.named_parameters()), dict(other.named_parameters())
    assert mine.keys() == theirs.keys()
    return all(torch.equal(mine[name], theirs[name]) for name in mine)


def test_standard_settings_make_the_tracker_of_the_paper():
    made, path = Lehmann2007Settings().make(), shipped_arrays()["lehmann2007"]
    array, region = MicrophoneArray.from_yaml(path), Region.from_yaml(path)
    exact = tracker_of(array, region, num_particles=75)
    assert same_parameters(made, exact)
    assert made.region == exact.region
    assert made.fs == exact.fs
    assert made.filter.resample == exact.filter.resample
    assert torch.equal(made.filter.origin, exact.filter.origin)
    sound = torch.randn(array.num_microphones, 4000)
    with torch.no_grad():
        for one, other in zip(made(sound, seeds=3), exact(sound, seeds=3), strict=True):
            assert (one is None and other is None) or torch.equal(one, other)


def test_every_setting_reaches_its_part(one_talker):
    front_end = Lehmann2007FrontEnd(300, 200, 500.0, 2500.0, "energy", 5.0, 0.7, 340.0)
    dynamics, relocation = lehmann2007("CU-TCVE"), Relocation(rate=0.9)
    resample = Adaptive(StopGradient(resampling.stratified), 0.4)
    made = Lehmann2007Settings(
        str(one_talker / "three.yaml"),
        low=(0.5, 0.4),
        high=(2.0, 2.5),
        num_particles=19,
        keep_out=0.3,
        exponent=3.5,
        front_end=front_end,
        fs=12_000,
        relocation=relocation,
        dynamics=dynamics,
        resample=resample,
    ).make()
    assert made.region == Region((0.5, 0.4), (2.0, 2.5))
    assert made.filter.dynamics is dynamics
    assert made.filter.relocation is relocation
    assert made.filter.resample is resample
    assert made.filter.num_particles == 19
    assert made.filter.likelihood.keep_out == 0.3
    assert made.filter.likelihood.log_exponent.exp().item() == pytest.approx(3.5)
    assert made.dt == pytest.approx(200 / 12_000)
    assert made.front_end.stft.frame_length == 300
    assert (made.front_end.gcc.low_bin, made.front_end.gcc.high_bin) == (13, 62)  # of 40 Hz
    assert made.front_end.vad.threshold.item() == 5.0
    assert made.front_end.vad.log_slope.exp().item() == pytest.approx(0.7)
    likelihood = GaussianPosition(0.2)
    of_my_own = Lehmann2007Settings(str(one_talker / "three.yaml"), likelihood=likelihood).make()
    assert of_my_own.filter.likelihood is likelihood
    assert of_my_own.region == Region(training_scenes.LOW, training_scenes.HIGH)


def test_likelihood_is_for_the_lags_and_the_speed_of_sound_of_the_front_end(one_talker):
    for speed, fs in ((300.0, 16_000), (343.0, 8000)):
        front_end = Lehmann2007FrontEnd(speed_of_sound=speed, band_high=2000.0)
        made = Lehmann2007Settings(str(one_talker / "three.yaml"), front_end=front_end, fs=fs).make()
        exact = tracker_of(
            MicrophoneArray.from_yaml(one_talker / "three.yaml"),
            Region(training_scenes.LOW, training_scenes.HIGH),
            speed_of_sound=speed,
            fs=fs,
            band_high=2000.0,
        )
        assert made.front_end.gcc.num_lags == made.filter.likelihood.power.num_lags
        assert torch.equal(made.filter.likelihood.power.steering, exact.filter.likelihood.power.steering)
        sound = torch.randn(3, 3000)
        with torch.no_grad():
            heard = made.front_end.step(None, sound)[1]
            one, other = (x.filter.likelihood.prepare(heard) for x in (made, exact))
        assert torch.equal(one.target, other.target)


def test_parameters_of_a_file_replace_what_it_names(one_talker, tmp_path):
    plain = {"array": str(one_talker / "three.yaml"), "relocation": Relocation()}
    learned = Lehmann2007Settings(**plain, exponent=4.5, front_end=Lehmann2007FrontEnd(vad_threshold=3.0)).make()
    for name, parameter in learned.named_parameters():
        parameter.requires_grad_("likelihood" in name or "vad" in name)
    write_parameters(tmp_path / "first.yaml", learned, {})
    made = Lehmann2007Settings(**plain, exponent=1.2, parameters=str(tmp_path / "first.yaml")).make()
    assert same_parameters(made, learned)
    moved = Lehmann2007Settings(**plain, model="CU-TCVE", parameters=str(tmp_path / "first.yaml")).make()
    assert physical_values(moved)["filter.likelihood.exponent"] == pytest.approx(4.5)
    names = {name for name, _ in moved.named_parameters()}
    assert names >= {"filter.dynamics.axis_model.process.log_rate"}


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"array": "none.yaml"}, "^none.yaml: cannot read array file: No such file"),
        ({"array": "bare.yaml"}, "^bare.yaml: has no region: give low and high"),
        ({"low": (0.0, 0.0)}, "^low and high must be given together"),
        ({"high": (2.0, 2.0)}, "^low and high must be given together"),
        ({"low": (2.0, 0.0), "high": (1.0, 1.0)}, "low must be below high on axis x"),
        ({"model": "CU-NONE"}, "^model must be one of .*, got 'CU-NONE'"),
        ({"num_particles": 0}, "num_particles must be an integer of at least 1, got 0"),
        ({"exponent": -1.0}, "exponent must be finite and positive"),
        ({"keep_out": -0.1}, "keep_out must be finite and at least 0"),
        ({"fs": 0}, "fs must be an integer of at least 1, got 0"),
        ({"front_end": Lehmann2007FrontEnd(hop=600)}, "hop must be at most frame_length = 512, got 600"),
        ({"front_end": Lehmann2007FrontEnd(band_high=9000.0)}, "band must satisfy 0 <= low < high <= fs / 2"),
        ({"parameters": "none.yaml"}, "^none.yaml: cannot read parameter file: No such file"),
        ({"parameters": "bare.yaml"}, "^bare.yaml: a parameter file must have 'parameters'"),
        ({"parameters": "other.yaml"}, "^other.yaml: parameters of another model: unknown filter.wings"),
        ({"parameters": "wrong.yaml"}, "filter.likelihood.exponent must be finite and positive, got -2"),
    ],
)
def test_refuses_what_cannot_be_in_one_line(tmp_path, monkeypatch, changes, match):
    monkeypatch.chdir(tmp_path)
    training_scenes.array().to_yaml("bare.yaml")
    Path("other.yaml").write_text("parameters: {filter.wings: 2.0}\n")
    Path("wrong.yaml").write_text("parameters: {filter.likelihood.exponent: -2.0}\n")
    with pytest.raises(InputError, match=match) as error:
        Lehmann2007Settings(**changes).make()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "scheme", ["probtrack.filters.resampling.systematic", {"class_path": "probtrack.filters.resampling.systematic"}]
)
def test_configuration_names_every_part(one_talker, scheme):
    parser = ArgumentParser(exit_on_error=False)
    parser.add_argument("--tracker", type=TrackerSettings)
    carried = {"class_path": "probtrack.filters.StopGradient", "init_args": {"resampler": scheme}}
    arguments = {
        "array": str(one_talker / "three.yaml"),
        "front_end": {"hop": 128},
        "relocation": {"class_path": "probtrack.filters.Relocation", "init_args": {"share": 0.2}},
        "dynamics": {"class_path": "probtrack.dynamics.lehmann2007", "init_args": {"name": "CU-TCVE"}},
        "likelihood": {"class_path": "probtrack.likelihoods.GaussianPosition", "init_args": {"std": 0.3}},
        "resample": {"class_path": "probtrack.filters.Adaptive", "init_args": {"resampler": carried, "threshold": 0.4}},
    }
    content = {"class_path": "probtrack.training.Lehmann2007Settings", "init_args": arguments}
    made = parser.instantiate(parser.parse_object({"tracker": content})).tracker
    assert made.front_end == Lehmann2007FrontEnd(hop=128)
    tracker = made.make()
    assert tracker.filter.resample == Adaptive(StopGradient(resampling.systematic), 0.4)
    assert tracker.filter.relocation.logit_share.sigmoid().item() == pytest.approx(0.2)
    assert tracker.filter.likelihood.log_std.exp().item() == pytest.approx(0.3)
    assert same_parameters(tracker.filter.dynamics, lehmann2007("CU-TCVE"))
