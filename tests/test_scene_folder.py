"""Scene folders: there whole or not at all, read back as written, and made again from their own description."""

import csv
import errno
import os
import pathlib
import subprocess
import sys

import pytest
import soundfile
import torch
from quick_scenes import HARD, quick, two_talkers, write_scene

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray
from probtrack.simulation import Faults, ResponseCache, SceneFolder, Truth, load_scene, save_scene, scene_folder
from probtrack.simulation.noise import Interferer, WhiteNoise
from probtrack.simulation.rooms.measured import MeasuredRoom

ALWAYS = {"audio.wav", "array.yaml", "truth.csv", "scene.yaml"}


def save(folder, scene, cache=None):
    recording = scene.simulate(cache)
    save_scene(folder, scene, recording)
    return recording


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_what_was_written_is_read_back(tmp_path):
    scene = two_talkers(faults=Faults(position_std=0.01))
    recording = save(tmp_path / "a", scene)
    folder = SceneFolder(str(tmp_path / "a"))
    assert set(content(folder.path)) == ALWAYS | {"true_array.yaml", "voices.csv"}
    audio, fs = soundfile.read(folder.path / "audio.wav", dtype="int16")
    assert fs == folder.open_recording().fs == 16000
    assert soundfile.info(folder.path / "audio.wav").subtype == "PCM_16"
    torch.testing.assert_close(torch.from_numpy(audio).double().T / 32767, recording.audio, rtol=0, atol=0.51 / 32767)
    torch.testing.assert_close(folder.array.positions, recording.array.positions)
    true = MicrophoneArray.from_yaml(folder.path / "true_array.yaml")
    torch.testing.assert_close(true.positions, recording.true_array.positions, rtol=0, atol=1e-6)
    assert folder.region == scene.room.region
    for k, table in enumerate(folder.truth):
        motion = recording.truth.motion.talker(k)
        torch.testing.assert_close(table.time, recording.truth.time, rtol=0, atol=1e-6)
        torch.testing.assert_close(table.position, motion.position, rtol=0, atol=1e-6)
        velocity = torch.stack([table.columns[f"v{axis}"] for axis in "xyz"], -1)
        torch.testing.assert_close(velocity, motion.velocity, rtol=0, atol=1e-6)
        for name, column in (
            ("heading", motion.mouth),
            ("body", motion.body),
            ("azimuth", recording.truth.azimuth[:, k]),
        ):
            torch.testing.assert_close(table.columns[name], column, rtol=0, atol=1e-6)
        assert torch.equal(table.columns["speech"].bool(), recording.truth.speech[:, k])
    assert len(folder.truth) == 2
    assert folder.scene.num_talkers == 2


def test_scores_of_synthetic_voices_are_kept(tmp_path):
    recording = save(tmp_path / "a", two_talkers())
    with (tmp_path / "a" / "voices.csv").open() as file:
        rows = list(csv.DictReader(file))
    for k, said in enumerate(recording.speech, 1):
        own = [row for row in rows if row["track"] == str(k)]
        assert [float(row["f0"]) for row in own] == pytest.approx(said.score.f0.tolist(), rel=1e-3)
        assert [float(row["f2"]) for row in own] == pytest.approx(said.score.formants[:, 1].tolist(), rel=1e-3)
        assert float(own[1]["time"]) == pytest.approx(0.005)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_a_saved_scene_gives_the_same_files_again(tmp_path, dtype):
    torch.set_default_dtype(dtype)
    array = tmp_path / "mine.yaml"
    array.write_text("name: mine\npositions: [[0.5000004, 0.5, 1.0], [0.7, 0.5123456789, 1.1], [0.61, 0.9, 1.2]]\n")
    faults = Faults(gain_std_db=1.0, position_std=0.01, dead_channels=(2,), clipping_db=3.0)
    noises = (WhiteNoise(), Interferer((3.0, 2.5, 0.5)))
    scene = two_talkers(array=str(array), faults=faults, noises=noises, snr_db=3.3, room=HARD, duration=1.7)
    save(tmp_path / "a", scene, ResponseCache(tmp_path / "cache"))
    array.unlink()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "a").rename(tmp_path / "elsewhere" / "b")
    again = SceneFolder(tmp_path / "elsewhere" / "b").scene
    save(tmp_path / "c", again)
    save(tmp_path / "d", load_scene(tmp_path / "c" / "scene.yaml"))
    assert content(tmp_path / "c") == content(tmp_path / "elsewhere" / "b") == content(tmp_path / "d")


def test_an_array_is_found_beside_the_scene_file(tmp_path):
    scene = load_scene(write_scene(tmp_path))
    assert scene.load_array().name == "pair"
    assert scene.load_array().positions[1].tolist() == [0.7, 0.5, 1.4]


def full(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


BREAKS = [
    (scene_folder.soundfile, "write"),
    (Truth, "save"),
    (scene_folder, "save_scores"),
    (MicrophoneArray, "to_yaml"),
]


@pytest.mark.parametrize("broken", BREAKS, ids=lambda broken: broken[1])
@pytest.mark.parametrize("before", [False, True], ids=["new", "replaced"])
def test_on_a_full_disk_the_folder_stays_as_it_was(tmp_path, monkeypatch, broken, before):
    folder, scene = tmp_path / "sub" / "a", quick()
    if before:
        save(folder, scene)
    old, recording = content(folder) if before else None, scene.simulate()
    monkeypatch.setattr(*broken, full)
    with pytest.raises(InputError, match=r"a: cannot write the scene: No space left on device$"):
        save_scene(folder, scene, recording)
    assert list((tmp_path / "sub").iterdir()) == ([folder] if before else [])
    assert not before or content(folder) == old


def test_an_interruption_leaves_nothing(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    scene = quick()
    recording = scene.simulate()
    monkeypatch.setattr(Truth, "save", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save_scene(tmp_path / "a", scene, recording)
    assert list(tmp_path.iterdir()) == []


def test_a_scene_is_replaced_and_what_else_is_there_kept(tmp_path):
    save(tmp_path / "a", two_talkers(faults=Faults(position_std=0.01)))
    (tmp_path / "a" / "track.csv").write_text("mine")
    scene = quick(seed=8)
    save(tmp_path / "a", scene)
    save(tmp_path / "b", scene)
    assert content(tmp_path / "a") == content(tmp_path / "b") | {"track.csv": b"mine"}


def test_the_working_directory_may_be_the_folder(tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    monkeypatch.chdir(tmp_path / "a")
    save(".", quick())
    assert set(content(tmp_path / "a")) == ALWAYS | {"voices.csv"}
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


@pytest.mark.parametrize(("name", "message"), [("full", "is not a scene"), ("file", "is not a scene"),
                                               ("file/a", "cannot write the scene")])  # fmt: skip
def test_what_is_not_a_scene_is_left_alone(tmp_path, name, message):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("years")
    (tmp_path / "file").write_text("more years")
    scene = quick()
    with pytest.raises(InputError, match=message):
        save_scene(tmp_path / name, scene, scene.simulate())
    assert (tmp_path / "full" / "thesis.txt").read_text() == "years"
    assert (tmp_path / "file").read_text() == "more years"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "full"]


def test_a_folder_of_ones_own_needs_no_truth(tmp_path):
    soundfile.write(tmp_path / "audio.flac", torch.zeros(100, 2).numpy(), 8000)
    (tmp_path / "array.yaml").write_text("positions: [[0, 0, 0], [0, 0.1, 0]]")
    folder = SceneFolder(tmp_path)
    assert folder.open_recording().file_rate == 8000
    assert folder.truth is None
    assert folder.region is None
    with pytest.raises(InputError, match=r"scene.yaml: cannot read scene file"):
        _ = folder.scene


def test_a_measured_room_is_heard_in_a_scene(tmp_path):
    from test_measured_rooms import PLACES
    from test_measured_rooms import folder as responses

    from probtrack.simulation.trajectories import GivenPaths, Standing

    (tmp_path / "r").mkdir()
    room = MeasuredRoom(responses(tmp_path / "r"))
    scene = quick(room=room, array=str(tmp_path / "r" / "array.yaml"), snr_db=40.0,
                  trajectories=GivenPaths((Standing(tuple(PLACES[0].tolist())),)))  # fmt: skip
    save(tmp_path / "a", scene)
    save(tmp_path / "b", SceneFolder(tmp_path / "a").scene)
    assert content(tmp_path / "a") == content(tmp_path / "b")


def test_files_are_found_from_the_scene_files_folder(tmp_path, monkeypatch):
    """Also those within parts; and the saved scene names them so that it works from anywhere."""
    (tmp_path / "here" / "speech").mkdir(parents=True)
    sound = torch.randn(16000, generator=torch.Generator().manual_seed(1)).numpy() * 0.1
    soundfile.write(tmp_path / "here" / "speech" / "someone.wav", sound, 8000)
    path = pathlib.Path(write_scene(tmp_path / "here"))
    path.write_text(
        path.read_text().replace(
            "{class_path: SyntheticVoices}", "{class_path: RecordedVoices, init_args: {folder: speech}}"
        )
    )
    scene = load_scene(path)
    assert scene.voices.folder == str(tmp_path / "here" / "speech")
    save(tmp_path / "out", scene)
    monkeypatch.chdir(tmp_path / "out")
    assert SceneFolder(tmp_path / "out").scene.voices == scene.voices


def test_parts_are_known_by_their_names():
    """In a process that has imported nothing but what a scene file needs."""
    program = (
        "from probtrack.simulation.description import _CHOSEN\n"
        "print(*(kind.__name__ for family in _CHOSEN for kind in type.__subclasses__(family)))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    trajectories = {"SocialForceWalk", "ModelWalk", "GivenPaths", "SmoothPaths", "Through", "Arc", "Waiting", "InTurn"}
    sounds = {"RecordedVoices", "SyntheticVoices", "GivenTurns", "TurnTaking"}
    noises = {"WhiteNoise", "DiffuseNoise", "RecordedNoise", "Interferer"}
    assert set(done.stdout.split()) >= {*trajectories, *sounds, *noises, "MeasuredRoom", "ShoeboxRoom"}
