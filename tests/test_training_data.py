import importlib
import sys

import pytest
import soundfile
import torch
import training_scenes
from training_scenes import MICROPHONES, array, front_end

import probtrack
from probtrack.audio import ShortTimeSpectrum
from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray, Region, wrap_angle
from probtrack.simulation import SceneFolder
from probtrack.track_files import TrackTable
from probtrack.trackers import lehmann2007
from probtrack.training import SceneDataset, collate, front_end_key, truth_at

small_data_set, data_set, float32 = training_scenes.small_data_set, training_scenes.data_set, training_scenes.float32


def test_item_is_the_sound_of_the_file(data_set):
    item = SceneDataset(data_set)[3]
    samples, fs = soundfile.read(data_set / item.name / "audio.wav", dtype="float32")
    assert item.audio.dtype == torch.float32
    assert (fs, item.name, item.grid.fs) == (16_000, "1_+20dB", 16_000)
    torch.testing.assert_close(item.audio, torch.from_numpy(samples.T), rtol=0, atol=0)
    torch.testing.assert_close(item.array.double(), array().positions.double(), rtol=0, atol=1e-6)


@pytest.mark.parametrize("settings", [None, {}, {"hop": 512}, {"hop": 100, "frame_length": 300}])
def test_truth_at_a_frame_is_the_motion_of_the_scene_at_its_centre(data_set, settings):
    dataset = SceneDataset(data_set, None if settings is None else front_end(**settings))
    item, scene = dataset[2], SceneFolder(dataset.folders[2].path).scene
    truth, motion = item.truth, scene.motion().every((item.time * scene.fs).round().long())
    exact = settings is None or "frame_length" not in settings
    assert truth.known.all()
    assert truth.position.shape == (item.num_frames, 2, 3)
    # between rows 16 ms apart: a dt^2 / 8 for a speed that changes by 2 m/s in 0.3 s, and the ends held for 7 ms
    inside = slice(2, -4)
    near = {"rtol": 0, "atol": 2e-6 if exact else 5e-4}
    torch.testing.assert_close(truth.position[inside].double(), motion.position[inside].double(), **near)
    assert (truth.velocity - motion.velocity).abs()[inside].max() < (2e-6 if exact else 0.01)
    for angle, wanted in ((truth.heading, motion.mouth), (truth.body, motion.body)):
        assert wrap_angle(angle.double() - wanted)[inside].abs().max() < (2e-6 if exact else 2e-3)
    offset = motion.position.double() - array().centre.double()
    azimuth = torch.atan2(offset[..., 1], offset[..., 0])
    assert azimuth.diff(dim=0).abs().max() > 6  # it jumps at pi, and does not go round in between
    assert wrap_angle(truth.azimuth.double() - azimuth)[inside].abs().max() < (2e-6 if exact else 2e-3)
    held = (truth.position.double() - motion.position).abs().max()
    assert held < 0.02


@pytest.mark.parametrize(("dtype", "hop"), [(torch.float32, 256), (torch.float64, 256), (torch.float32, 400)])
def test_observations_are_what_the_tracker_hears(data_set, dtype, hop):
    torch.set_default_dtype(dtype)
    tracker = lehmann2007(array(), Region.around(array()), hop=hop)
    item, sound = SceneDataset(data_set, tracker.front_end)[4], SceneDataset(data_set)[4].audio
    gcc, speech = tracker.front_end(sound.to(dtype))
    assert item.audio is None
    assert item.observations.gcc.dtype == item.truth.position.dtype == dtype
    torch.testing.assert_close(item.observations.speech, speech.detach(), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(item.observations.gcc, gcc.detach(), rtol=2**-11 * 1.01, atol=2e-7)
    track = tracker(sound.to(dtype)[None], torch.tensor([0]))
    torch.testing.assert_close(item.time, track.time, rtol=0, atol=0)
    if hop == 256:
        truth = SceneFolder(data_set / item.name).truth[0]
        torch.testing.assert_close(item.time, truth.time, rtol=0, atol=1e-6)


def test_sound_can_come_on_other_frames(data_set):
    item = SceneDataset(data_set, stft=ShortTimeSpectrum(400, 160))[0]
    assert item.time[1] - item.time[0] == pytest.approx(0.01)
    assert len(item.truth.known) == item.num_frames == (item.audio.shape[-1] - 400) // 160 + 1


def test_crop_is_a_piece_of_the_whole(data_set):
    whole, pieces = SceneDataset(data_set, front_end()), SceneDataset(data_set, front_end(), crop=20, seed=3)
    starts = set()
    for draw in range(6):
        item, part = whole[1], pieces[1, draw]
        here = slice(part.start, part.start + 20)
        starts.add(part.start)
        for piece, all_of_it in zip(part.observations, item.observations, strict=True):
            assert torch.equal(piece, all_of_it[here])
        assert torch.equal(part.truth.position, item.truth.position[here])
        assert torch.equal(part.time, item.time[here])
    assert len(starts) > 2
    assert pieces[1, 2].start == SceneDataset(data_set, crop=20, seed=3)[1, 2].start
    assert [pieces[1, d].start for d in range(6)] != [SceneDataset(data_set, crop=20)[1, d].start for d in range(6)]


def test_cropped_sound_has_the_samples_of_its_frames(data_set):
    part, whole = SceneDataset(data_set, crop=20)[1, 5], SceneDataset(data_set)[1]
    assert part.start > 0
    assert part.num_frames == 20
    assert torch.equal(part.audio, whole.audio[:, part.start * 256 : part.start * 256 + 19 * 256 + 512])
    assert torch.equal(part.truth.position, whole.truth.position[part.start : part.start + 20])


def test_crops_reach_both_ends(data_set):
    dataset = SceneDataset(data_set, crop=77)  # of 80 frames
    starts = {dataset[0, draw].start for draw in range(40)}
    assert starts == set(range(SceneDataset(data_set).num_frames(0) - 77 + 1))


def test_folder_without_truth_and_other_rates(data_set, tmp_path):
    (tmp_path / "own").mkdir()
    array().to_yaml(tmp_path / "own" / "array.yaml")
    soundfile.write(tmp_path / "own" / "audio.flac", torch.randn(8000, 3).clamp(-1, 1).numpy() * 0.1, 8000)
    item = SceneDataset([tmp_path / "own"])[0]
    assert item.truth is None
    assert item.audio.shape == (3, 16_000)
    assert SceneDataset([tmp_path / "own"], fs=8000)[0].audio.shape == (3, 8000)
    with pytest.raises(InputError, match=r"own: has no truth.csv"):
        SceneDataset([data_set / "0_+5dB", tmp_path / "own"], require_truth=True)


def table(**columns):
    return TrackTable("truth.csv", {k: torch.tensor(v, dtype=torch.float64) for k, v in columns.items()})


def test_angles_go_the_short_way_and_speech_is_that_of_the_nearer_row():
    truth = table(time=[1.0, 2.0], azimuth=[3.0, -3.0], heading=[-0.2, 0.4], speech=[0.0, 1.0])
    found = truth_at([truth], torch.tensor([1.0, 1.25, 1.75, 2.0], dtype=torch.float64))
    step = (2 * torch.pi - 6) / 4
    wanted = torch.tensor([3.0, 3.0 + step, -3.0 - step, -3.0])
    torch.testing.assert_close(found.azimuth[:, 0].double(), wanted, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.heading[:, 0], torch.tensor([-0.2, -0.05, 0.25, 0.4]).float())
    assert found.speech[:, 0].tolist() == [False, False, True, True]
    assert found.position is found.velocity is found.body is None


def test_what_the_truth_does_not_say_is_marked_and_finite():
    nan = float("nan")
    truth = table(time=[1.0, 1.5, 2.0, 4.0, 4.5], x=[1.0, 2.0, 3.0, 4.0, nan], y=[0.0, 1.0, nan, 5.0, 6.0])
    time = torch.tensor([0.9, 0.97, 1.0, 1.25, 1.5000005, 1.8, 4.0, 4.03, 4.2], dtype=torch.float64)
    found = truth_at([truth], time)
    assert found.known[:, 0].tolist() == [False, True, True, True, True, False, True, True, False]
    assert found.position.isfinite().all()
    assert found.position[:5, 0].tolist() == [[1, 0], [1, 0], [1, 0], [1.5, 0.5], [2, 1]]
    assert found.position[6:, 0].tolist() == [[4, 5]] * 3


def test_truth_without_anything_and_talkers_of_different_columns_are_refused():
    with pytest.raises(InputError, match="no row without an empty cell"):
        truth_at([table(time=[0.0, 1.0], x=[1.0, float("nan")], y=[float("nan"), 1.0])], torch.zeros(1))
    both = [table(time=[0.0], x=[1.0], y=[1.0]), table(time=[0.0], azimuth=[1.0])]
    with pytest.raises(InputError, match="same columns"):
        truth_at(both, torch.zeros(1))


def test_batch_has_time_first_and_recordings_second(data_set):
    dataset = SceneDataset(data_set, front_end(), crop=30)
    items = [dataset[i, 7] for i in (4, 0, 3)]
    batch = collate(items)
    assert batch.names == ("2_+5dB", "0_+5dB", "1_+20dB")
    assert batch.observations.gcc.shape[:3] == (30, 3, 3)
    assert batch.truth.position.shape == (30, 3, 2, 3)
    assert batch.truth.speech.shape == (30, 3, 2)
    for b, item in enumerate(items):
        assert torch.equal(batch.observations.gcc[:, b], item.observations.gcc)
        assert torch.equal(batch.truth.azimuth[:, b], item.truth.azimuth)
        assert torch.equal(batch.time[:, b], item.time)
        assert torch.equal(batch.array[b], item.array)


@pytest.mark.parametrize("observed", [True, False])
def test_batch_is_cropped_to_the_shortest(data_set, observed):
    ends = front_end() if observed else None
    short, whole = SceneDataset(data_set, ends, crop=20)[0], SceneDataset(data_set, ends)[1]
    batch = collate([whole, short])
    assert batch.num_frames == len(batch.truth.known) == 20
    if not observed:
        assert torch.equal(batch.audio[0], whole.audio[:, : 19 * 256 + 512])


@pytest.mark.usefixtures("float32")
def test_filter_follows_a_batch(data_set):
    tracker = lehmann2007(array(), Region((0.0, 0.0, 0.0), (3.6, 3.1, 2.4)))
    dataset = SceneDataset(data_set, tracker.front_end)
    batch = collate([dataset[1], dataset[3]])
    state = tracker.begin(torch.tensor([0, 1]))
    _, track = tracker.filter.advance(state.belief, batch.observations, tracker.dt, state.noise)
    assert track.position.shape == (batch.num_frames, 2, 2)
    assert track.position.dtype == batch.truth.position.dtype == torch.float32


def test_other_scenes_in_one_batch_are_refused(data_set, tmp_path):
    scene = SceneDataset(data_set)[0]
    wrong = {
        "sampling rates": scene._replace(grid=scene.grid._replace(fs=8000)),
        "frame lengths and hops": scene._replace(grid=scene.grid._replace(hop=128)),
        "numbers of microphones": scene._replace(array=scene.array[:2]),
        "contents": SceneDataset(data_set, front_end(), cache=tmp_path)[0],
        "numbers of talkers": scene._replace(truth=type(scene.truth)(*(c[:, :1] for c in scene.truth))),
        "columns of truth": scene._replace(truth=scene.truth._replace(body=None)),
    }
    for message, other in wrong.items():
        with pytest.raises(InputError, match=f"^batch: {message}.* must be equal, got .* of 0_.5dB") as error:
            collate([scene, other])
        assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="numbers of talkers"):
        collate([scene, scene._replace(truth=None)])


def test_what_is_wrong_on_disk_is_said_in_one_line(data_set, tmp_path):
    other = tmp_path / "two"
    other.mkdir()
    MicrophoneArray(MICROPHONES[:2]).to_yaml(other / "array.yaml")
    soundfile.write(other / "audio.wav", torch.zeros(8000, 2).numpy(), 16_000)
    wrong = [
        (r"manifest.csv: cannot read the manifest", lambda: SceneDataset(tmp_path)),
        (r"nowhere: there is no such scene folder", lambda: SceneDataset([data_set / "0_+5dB", tmp_path / "nowhere"])),
        (r"got none", lambda: SceneDataset([])),
        (r"front end is for 3 microphones, the scene has 2", lambda: SceneDataset([other], front_end())),
        (r"has 30 frames, wanted are at least 31", lambda: SceneDataset([other], crop=31)),
        (r"crop must be an integer of at least 1", lambda: SceneDataset([other], crop=0)),
        (r"stft must not be given", lambda: SceneDataset([other], front_end(), stft=ShortTimeSpectrum())),
    ]
    for message, make in wrong:
        with pytest.raises(InputError, match=message) as error:
            make()
        assert "\n" not in str(error.value)
    soundfile.write(other / "audio.wav", torch.zeros(8000, 4).numpy(), 16_000)
    with pytest.raises(InputError, match=r"two: the recording has 4 channels, the array 2"):
        SceneDataset([other])


def test_settings_make_the_front_end_of_the_tracker():
    tracker = lehmann2007(array(), Region.around(array()), hop=128, band_low=500.0, vad_slope=2.0)
    made = front_end(hop=128, band_low=500.0, vad_slope=2.0)
    assert front_end_key(made, 16_000) == front_end_key(tracker.front_end, 16_000)
    default = lehmann2007(array(), Region.around(array())).front_end
    assert front_end_key(front_end(), 16_000) == front_end_key(default, 16_000)


def test_data_sets_need_no_lightning_and_the_module_says_what_does(monkeypatch):
    monkeypatch.setattr(probtrack, "training", None, raising=False)
    for name in [name for name in sys.modules if name.startswith("probtrack.training")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "lightning", None)
    room = importlib.import_module("probtrack.training")
    assert room.SceneDataset.__name__ == "SceneDataset"
    with pytest.raises(ImportError, match=r"pip install 'probtrack\[train\]'"):
        _ = room.SceneDataModule
