import dataclasses
import os
import shutil
import time

import pytest
import torch
import training_scenes
from torch import nn
from torch.utils.data import DataLoader
from training_scenes import MICROPHONES, array, front_end

from probtrack.audio import FrontEnd, GeneralisedCrossCorrelation, Observations, VoiceActivity
from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray
from probtrack.training import Lehmann2007FrontEnd, ObservationFiles, SceneDataset, collate, front_end_key

small_data_set, data_set = training_scenes.small_data_set, training_scenes.data_set


class OwnDetector(VoiceActivity):
    """A detector of a user's, with attributes of all kinds."""

    def __init__(self, *, depth=3, names=("a", "b"), table=None, weights=2.0, act=torch.relu):
        super().__init__()
        self._depth, self.names, self.table, self.act = depth, names, table or {"x": 1.0}, act
        self.net = nn.Sequential(nn.Linear(2, 2, bias=False), nn.Dropout(0.5))
        nn.init.constant_(self.net[0].weight, weights)

    def forward(self, frames, state=None):
        return frames.samples.square().mean((-1, -2)).sigmoid(), state


def with_detector(**settings):
    made = front_end()
    return FrontEnd(made.stft, made.gcc, OwnDetector(**settings))


def files(folder):
    return sorted(path for path in folder.rglob("*") if path.is_file() and "observations" in path.parts)


def same(one, other):
    return all(torch.equal(a, b) for a, b in zip(one.observations, other.observations, strict=True))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_kept_observations_are_the_fresh_ones_bit_for_bit(data_set, dtype, monkeypatch):
    torch.set_default_dtype(dtype)
    fresh = SceneDataset(data_set, front_end())[2]
    assert [path.parent.parent.parent.name for path in files(data_set)] == ["1_+5dB"]
    again = SceneDataset(data_set, front_end())
    monkeypatch.setattr(FrontEnd, "step", None)  # it is not asked again
    assert same(again[2], fresh)
    assert again[2].observations.gcc.dtype == again[2].observations.speech.dtype == dtype


SETTINGS = {
    "frame_length": 480,
    "hop": 200,
    "band_low": 400.0,
    "band_high": 2800.0,
    "vad": "silero",
    "vad_threshold": 8.001,
    "vad_slope": 1.001,
    "speed_of_sound": 300.0,  # less would leave the lags of this small array as they are
}


def test_every_setting_changes_the_key():
    assert set(SETTINGS) == {field.name for field in dataclasses.fields(Lehmann2007FrontEnd)}
    pytest.importorskip("silero_vad")
    keys = {front_end_key(front_end(**{name: value}), 16_000) for name, value in SETTINGS.items()}
    assert len(keys | {front_end_key(front_end(), 16_000)}) == len(SETTINGS) + 1
    assert front_end_key(front_end(vad="silero"), 16_000) == front_end_key(front_end(vad="silero"), 16_000)


def changed(change):
    made = front_end()
    with torch.no_grad():
        change(made)
    return made


def other_array(positions):
    made = front_end()
    return FrontEnd(made.stft, GeneralisedCrossCorrelation(MicrophoneArray(positions)), made.vad)


def oversampled():
    made = front_end()
    return FrontEnd(made.stft, GeneralisedCrossCorrelation(array(), oversampling=8), made.vad)


def test_parts_that_settings_do_not_name_change_the_key():
    made = [
        front_end(),
        oversampled(),
        front_end().float(),
        changed(lambda f: f.gcc.whitening.fill_(0.8)),
        changed(lambda f: f.gcc.log_weight[3].fill_(1e-3)),
        changed(lambda f: f.stft.window[5].add_(1e-6)),
        changed(lambda f: setattr(f.vad, "smoothing", 2)),
        changed(lambda f: setattr(f.vad, "window", f.vad.window + 1)),
        other_array([*MICROPHONES, [1.15, 1.25, 1.3]]),
        other_array([[2 * x for x in point] for point in MICROPHONES]),
        with_detector(),
        with_detector(depth=4),
        with_detector(names=("ab",)),
        with_detector(table={"x": 1.5}),
        with_detector(weights=2.5),
        with_detector(act=torch.tanh),
    ]
    keys = [front_end_key(one, 16_000) for one in made] + [front_end_key(made[0], 8000)]
    assert len(set(keys)) == len(keys)
    assert front_end_key(with_detector(), 16_000) == keys[10]


def test_mode_and_gradients_do_not_change_the_key():
    one = with_detector()
    assert front_end_key(one.eval().requires_grad_(False), 16_000) == front_end_key(with_detector(), 16_000)


def test_code_of_a_detector_changes_the_key(monkeypatch):
    before = front_end_key(with_detector(), 16_000)
    monkeypatch.setattr("inspect.getsource", lambda _: "edited")
    assert front_end_key(with_detector(), 16_000) != before


def test_an_attribute_that_cannot_be_told_apart_is_refused():
    for thing in (object(), lambda x: x):
        with pytest.raises(InputError, match=r"front end: vad.act is a .*, by which") as error:
            front_end_key(with_detector(act=thing), 16_000)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("damage", [lambda b: b[:100], lambda b: b[: len(b) // 2], lambda b: b[:-20], lambda _: b""])
def test_a_file_cut_short_is_made_again(data_set, damage):
    dataset = SceneDataset(data_set, front_end())
    fresh, (path,) = dataset[0], files(data_set)
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    assert same(dataset[0], fresh)
    assert len(path.read_bytes()) == len(whole)


@pytest.mark.parametrize("content", [{"gcc": torch.zeros(3, 2, 5)}, [1, 2], {"gcc": torch.zeros(3), "speech": 1}])
def test_other_content_is_made_again(data_set, content):
    dataset = SceneDataset(data_set, front_end())
    fresh, (path,) = dataset[0], files(data_set)
    torch.save(content, path)
    assert same(dataset[0], fresh)


def test_other_formats_are_not_found(monkeypatch):
    before = front_end_key(front_end(), 16_000)
    monkeypatch.setattr("probtrack.training.observation_files.FORMAT", 2)
    assert front_end_key(front_end(), 16_000) != before
    monkeypatch.setattr("probtrack.__version__", "9.9")
    assert front_end_key(front_end(), 16_000) != before


def test_a_scene_made_anew_in_its_place_is_heard_anew(data_set):
    dataset = SceneDataset(data_set, front_end())
    before, other = dataset[0], dataset[3]
    sound, donor = data_set / "0_+5dB" / "audio.wav", data_set / "1_+20dB" / "audio.wav"
    date = sound.stat()
    shutil.copy(donor, sound)
    os.utime(sound, ns=(date.st_atime_ns, date.st_mtime_ns))  # same size, same date
    assert not same(dataset[0], before)
    assert same(dataset[0], other)


def test_a_copied_scene_is_found_in_a_common_folder(data_set, tmp_path, monkeypatch):
    shutil.copytree(data_set / "0_+5dB", tmp_path / "copy")
    fresh = SceneDataset(data_set, front_end(), cache=tmp_path / "kept")[0]
    assert files(data_set) == []
    assert len(list((tmp_path / "kept").rglob("*.pt"))) == 1
    monkeypatch.setattr(FrontEnd, "step", None)
    assert same(SceneDataset([tmp_path / "copy"], front_end(), cache=tmp_path / "kept")[0], fresh)


def test_a_folder_that_cannot_be_written_is_named(data_set, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"file.*: cannot keep observations: .*: name another folder") as error:
        SceneDataset(data_set, front_end(), cache=tmp_path / "file")[0]
    assert "\n" not in str(error.value)


def test_a_writer_that_fails_leaves_nothing_and_old_leavings_are_swept(data_set, monkeypatch):
    dataset = SceneDataset(data_set, front_end())
    fresh, (path,) = dataset[0], files(data_set)
    path.unlink()

    def full(_, file):
        file.write(b"half of it")
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(torch, "save", full)
        with pytest.raises(InputError, match="No space left"):
            dataset[0]
    assert files(data_set) == []
    old, young = path.with_name(".a.tmp"), path.with_name(".b.tmp")
    for left in (old, young):
        left.write_bytes(b"")
    os.utime(old, (time.time() - 7200,) * 2)
    assert same(dataset[0], fresh)
    assert files(data_set) == sorted([young, path])


def test_infinite_correlations_are_refused(data_set):
    made = changed(lambda f: f.gcc.log_weight.fill_(float("nan")))
    with pytest.raises(InputError, match="correlations must be finite"):
        SceneDataset(data_set, made)[0]


def test_a_front_end_that_learns_later_changes_nothing(data_set):
    made = front_end()
    dataset = SceneDataset(data_set, made)
    with torch.no_grad():
        made.gcc.whitening.fill_(0.3)
    assert same(dataset[0], SceneDataset(data_set, front_end())[0])
    assert made.gcc.whitening.requires_grad
    assert made.training


def test_changing_an_item_does_not_change_what_is_kept(data_set):
    dataset = SceneDataset(data_set, front_end().half().float())
    item = dataset[0]
    kept = [column.clone() for column in item.observations]
    for column in item.observations:
        column.zero_()
    assert all(torch.equal(a, b) for a, b in zip(dataset[0].observations, kept, strict=True))


@pytest.mark.slow
def test_workers_give_the_same_and_write_at_once(data_set):
    dataset = SceneDataset([data_set / "0_+5dB"] * 6, front_end())  # all want the same file
    alone = collate([SceneDataset(data_set, front_end(), cache=data_set / "elsewhere")[0]])
    for batch in DataLoader(dataset, num_workers=2, collate_fn=collate):
        assert torch.equal(batch.observations.gcc, alone.observations.gcc)
    assert len(files(data_set / "0_+5dB")) == 1


def test_precision_of_files_is_half(data_set):
    kept = ObservationFiles("k", data_set / "kept")
    gcc = torch.randn(40, 3, 7) * 0.01
    found = kept.put(data_set / "kept" / "x.pt", Observations(gcc, torch.rand(40)))
    assert (found.gcc - gcc).abs().max() <= 0.05 * 2**-11
    assert torch.equal(kept.get(data_set / "kept" / "x.pt").gcc, found.gcc)


def test_recordings_of_two_data_sets_have_names_of_their_own(data_set, tmp_path):
    again = shutil.copytree(data_set, tmp_path / "again")
    first, second = (sorted(path.parent for path in folder.rglob("scene.yaml"))[0] for folder in (data_set, again))
    assert first.name == second.name
    dataset = SceneDataset([first, second])
    assert len({dataset[0].name, dataset[1].name}) == 2
