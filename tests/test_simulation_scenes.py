import csv
import dataclasses
import math

import pytest
import soundfile
import torch

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray, Region
from probtrack.simulation import Scene, demo_scene, smooth_path

POINTS = ((0.9, 2.3, 1.5), (1.3, 1.1, 1.4), (2.4, 1.3, 1.6))


def quick_scene(**changes):
    """Anechoic, so without pyroomacoustics and in a moment."""
    return dataclasses.replace(Scene(path=POINTS, duration=3.0, t60=0.0, seed=3), **changes)


def rows(folder):
    with (folder / "truth.csv").open() as file:
        return list(csv.DictReader(file))


def test_path_passes_through_its_points():
    walk = smooth_path(POINTS, 5.0, 1000.0)
    assert torch.cdist(torch.tensor(POINTS), walk.positions).amin(-1).max() < 1e-3


def test_path_velocity_is_the_change_of_position():
    walk = smooth_path(POINTS, 5.0, 1000.0)
    change = (walk.positions[2:] - walk.positions[:-2]) * 500
    torch.testing.assert_close(change, walk.velocities[1:-1], rtol=0, atol=1e-3)
    moving = slice(1, None)
    angle = torch.atan2(walk.velocities[moving, 1], walk.velocities[moving, 0])
    torch.testing.assert_close(angle, walk.heading[moving])


def test_path_keeps_one_speed_between_soft_ends():
    speed = torch.linalg.vector_norm(smooth_path(POINTS, 5.0, 1000.0).velocities, dim=-1)
    torch.testing.assert_close(speed[800:4200], speed[2500].expand(3400), rtol=1e-9, atol=0)
    assert speed[0] == 0
    assert speed[-1] < 1e-4
    assert speed.diff().abs().max() < 1.1 * math.pi / 2 * speed.max() / 800  # the steepest of half a cosine


@pytest.mark.parametrize(
    ("points", "duration", "message"),
    [
        (POINTS[:1], 5.0, "points must be"),
        (((0.0, 1.0), (0.0, math.nan)), 5.0, "points must be"),
        ((POINTS[0], POINTS[0]), 5.0, "must differ"),
        (POINTS, 1.0, "duration must be more than 1.6 s"),
    ],
)
def test_path_rejects(points, duration, message):
    with pytest.raises(InputError, match=message):
        smooth_path(points, duration, 100.0)


def test_truth_follows_the_path(tmp_path):
    quick_scene().save(tmp_path)
    truth, walk = rows(tmp_path), smooth_path(POINTS, 3.0, 16000)
    array = MicrophoneArray.from_yaml(tmp_path / "array.yaml")
    assert list(truth[0]) == ["time", "track", "x", "y", "z", "azimuth", "heading", "speech"]
    assert len(truth) == 1 + (48000 - 512) // 256
    for t, row in enumerate(truth):
        assert float(row["time"]) == (t * 256 + 256) / 16000
        place = walk.positions[t * 256 + 256]
        torch.testing.assert_close(torch.tensor([float(row[k]) for k in "xyz"]), place, rtol=0, atol=1e-6)
        dx, dy = (place - array.positions.mean(0)).tolist()[:2]
        assert float(row["azimuth"]) == pytest.approx(math.atan2(dy, dx), abs=1e-5)
        assert float(row["heading"]) == pytest.approx(float(walk.heading[t * 256 + 256]), abs=1e-6)


def test_truth_says_when_it_speaks(tmp_path):
    quick_scene(snr_db=40.0).save(tmp_path)
    audio, _ = soundfile.read(tmp_path / "audio.wav")
    frames = torch.from_numpy(audio[:, 0]).unfold(0, 512, 256).square().mean(-1).sqrt()
    speech = torch.tensor([row["speech"] == "1" for row in rows(tmp_path)])
    assert set(speech.tolist()) == {True, False}
    assert frames[speech].median() > 20 * frames[~speech].median()


def test_saved_audio_is_the_recording(tmp_path):
    recording = quick_scene().save(tmp_path)
    audio, fs = soundfile.read(tmp_path / "audio.wav")
    assert fs == recording.fs == 16000
    torch.testing.assert_close(torch.from_numpy(audio).T, recording.audio, rtol=0, atol=5e-5)
    assert recording.audio.abs().max() == pytest.approx(0.9)


def test_same_seed_same_bytes(tmp_path):
    for folder, seed in (("a", 3), ("b", 3), ("c", 4)):
        quick_scene(seed=seed).save(tmp_path / folder)
    content = {f: [p.read_bytes() for p in sorted((tmp_path / f).iterdir())] for f in "abc"}
    assert content["a"] == content["b"]
    assert content["a"] != content["c"]


def test_saved_scene_gives_itself_again(tmp_path):
    array = tmp_path / "mine.yaml"
    MicrophoneArray([[0.5, 0.5, 1.0], [0.7, 0.5, 1.1], [0.6, 0.9, 1.2]], "mine").to_yaml(array)
    quick_scene(array=str(array)).save(tmp_path / "a")
    array.unlink()
    Scene.from_yaml(tmp_path / "a" / "scene.yaml").save(tmp_path / "b")
    for name in ("audio.wav", "truth.csv", "scene.yaml", "array.yaml"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_speech_file_is_heard(tmp_path):
    t = torch.arange(48000) / 16000
    soundfile.write(tmp_path / "own.wav", (0.3 * torch.sin(2 * torch.pi * 700 * t)).numpy(), 16000)
    audio = quick_scene(speech=str(tmp_path / "own.wav")).simulate().audio
    peak = torch.fft.rfft(audio[0] * torch.hann_window(audio.shape[-1])).abs().argmax() / 3
    assert float(peak) == pytest.approx(700, abs=2)


@pytest.mark.parametrize("seed", range(5))
def test_demo_pauses_twice_and_once_while_walking(seed):
    scene = demo_scene(seed)
    recording = dataclasses.replace(scene, t60=0.0).simulate()
    walk = smooth_path(scene.path, scene.duration, scene.fs)
    starts = (recording.truth.speech.int().diff() == -1).nonzero()[:, 0]
    assert len(starts) >= 2
    speed = torch.linalg.vector_norm(walk.velocities, dim=-1)[(recording.truth.time * scene.fs).long()]
    assert speed[starts].max() > 0.2


def test_demo_walks_among_the_microphones():
    scene = demo_scene()
    walk = smooth_path(scene.path, scene.duration, 100.0)
    square = Region((0.49, 0.29, 1.5), (3.01, 2.81, 1.52))
    assert square.contains(walk.positions).all()
    assert 0.2 < torch.linalg.vector_norm(walk.velocities, dim=-1).mean() < 0.5


@pytest.mark.slow
def test_reverberant_demo_is_the_same_twice():
    pytest.importorskip("pyroomacoustics")
    scene = dataclasses.replace(demo_scene(), duration=2.0, spacing=0.5)
    first, second = scene.simulate(), scene.simulate()
    assert torch.equal(first.audio, second.audio)
    assert first.audio.isfinite().all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"snr_db": math.inf}, "snr_db must be finite"),
        ({"duration": 0.0}, "duration must be at least 512 samples"),
        ({"array": "nowhere.yaml"}, "nowhere.yaml: cannot read array file"),
        ({"path": ((0.9, 2.3, 1.5), (1.3, 9.0, 1.4))}, "outside the room"),
        ({"speech": "nowhere.wav"}, "nowhere.wav: cannot read speech"),
    ],
)
def test_rejects(changes, message):
    with pytest.raises(InputError, match=message):
        quick_scene(**changes).simulate()


@pytest.mark.parametrize("content", ["- 1", "{duration: 3.0}", "{path: 1, room: 2, duration: 3}", "a: ["])
def test_rejects_what_is_no_scene(tmp_path, content):
    (tmp_path / "scene.yaml").write_text(content)
    with pytest.raises(InputError, match=r"scene.yaml: not a scene"):
        Scene.from_yaml(tmp_path / "scene.yaml")


def test_rejects_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write scene"):
        quick_scene().save(tmp_path / "file")
