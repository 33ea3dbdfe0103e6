"""probtrack track: what it writes, and one clear line for everything that can be wrong with its input."""

import inspect
import os
import re
import signal
import subprocess
import sys
import time

import pytest
import soundfile
import torch
import yaml
from scenes import write_recording

from probtrack.cli import track
from probtrack.cli.main import COMMANDS, main
from probtrack.geometry import MicrophoneArray, Region, azimuth
from probtrack.track_files import read_track
from probtrack.trackers import lehmann2007


def run(scene, *flags, audio="audio.wav", output="track.csv"):
    return main(["track", str(scene / audio), "--array", str(scene / "array.yaml"), "-o", str(scene / output), *flags])


def fails(capsys, code, *words):
    """The command ended with 2 and said all of `words` in one line on standard error."""
    said = capsys.readouterr()
    assert code == 2
    assert said.out == ""
    lines = said.err.splitlines()
    assert len(lines) == 1, said.err
    assert lines[0].startswith("probtrack track: error: ")
    for word in words:
        assert word in lines[0]


def changed(scene, change):
    """Write audio.wav anew with `change` applied to its samples (C, n)."""
    samples, fs = soundfile.read(scene / "audio.wav", dtype="float32", always_2d=True)
    write_recording(scene / "audio.wav", change(torch.from_numpy(samples.T.copy())), fs)


def test_finds_the_source(scene, capsys):
    assert run(scene, "--num-particles", "400") == 0
    assert capsys.readouterr() == ("", "")
    table = read_track(scene / "track.csv")
    torch.testing.assert_close(table.position[-1], torch.tensor([2.4, 1.1]), atol=0.1, rtol=0)
    assert list(table.columns) == [
        "time", "track", "x", "y", "std_x", "std_y", "azimuth", "std_azimuth", "heading", "speech", "ess", "lost",
    ]  # fmt: skip


def test_same_seed_same_file_and_another_seed_another(scene):
    for name, seed in (("a.csv", "1"), ("b.csv", "1"), ("c.csv", "2")):
        assert run(scene, "--seed", seed, output=name) == 0
    a, b, c = ((scene / f"{name}.csv").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_command_and_library_agree(scene):
    assert run(scene, "--model", "CU-RWVE", "--resample", "residual", "--start", "2.0,1.5") == 0
    path = scene / "array.yaml"
    tracker = lehmann2007(MicrophoneArray.from_yaml(path), Region.from_yaml(path), "CU-RWVE", resample="residual")
    samples, _ = soundfile.read(scene / "audio.wav", dtype="float32", always_2d=True)
    with torch.no_grad():
        expected = tracker(torch.from_numpy(samples.T.copy()), 0, torch.tensor([2.0, 1.5]))
    table = read_track(scene / "track.csv")
    torch.testing.assert_close(table.position, expected.position.double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(table.time, expected.time)


def test_every_parameter_of_the_tracker_has_a_flag():
    flags = {action.dest for action in track.parser()._actions}
    assert set(inspect.signature(lehmann2007).parameters) - {"array", "region"} <= flags


def test_defaults_of_flags_are_those_of_the_tracker():
    defaults = track.parser().get_defaults()
    parameters = list(inspect.signature(lehmann2007).parameters.items())[2:]
    assert {name: defaults[name] for name, _ in parameters} == {name: p.default for name, p in parameters}


def test_config_file_sets_and_flags_override(scene):
    (scene / "c.yaml").write_text("num_particles: 30\nmodel: CU-TCVE\nthree_d: false\n")
    assert run(scene, "--config", str(scene / "c.yaml")) == 0
    assert read_track(scene / "track.csv").get("ess").max() <= 30.001
    assert run(scene, "--config", str(scene / "c.yaml"), "--num-particles", "90") == 0
    assert read_track(scene / "track.csv").get("ess").max() > 31


def test_printed_config_is_read_back(scene, capsys):
    with pytest.raises(SystemExit) as stop:
        run(scene, "--num-particles", "33", "--start", "-1,0.5", "--print-config")
    assert stop.value.code == 0
    printed = yaml.safe_load(capsys.readouterr().out)
    assert printed["num_particles"] == 33
    assert printed["start"] == "-1,0.5"


def test_3d_tracks_height_too(scene):
    assert run(scene, "--3d", "--num-particles", "50") == 0
    table = read_track(scene / "track.csv")
    assert table.position.shape[1] == 3
    assert "std_z" in table.columns


def test_another_height_moves_the_answer(scene):
    assert run(scene, "--height", "2.1", output="high.csv") == 0
    assert run(scene) == 0
    assert not torch.equal(read_track(scene / "high.csv").position, read_track(scene / "track.csv").position)


def test_writes_to_standard_output(scene, capfd):
    assert main(["track", str(scene / "audio.wav"), "--array", str(scene / "array.yaml"), "-o", "-"]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert lines[0].startswith("time,track,x,y,")
    assert len(lines) == 1 + (24_000 - 512) // 256 + 1


def test_channels_are_picked_and_ordered(scene):
    changed(scene, lambda x: torch.cat([torch.randn(2, x.shape[1], dtype=x.dtype), x.flip(0)]))
    assert run(scene, "--channels", "7,6,5,4,3", "--num-particles", "400") == 0
    torch.testing.assert_close(read_track(scene / "track.csv").position[-1], torch.tensor([2.4, 1.1]), atol=0.1, rtol=0)


def test_another_sampling_rate_gives_nearly_the_same_track(scene):
    assert run(scene, "--num-particles", "400") == 0
    expected = read_track(scene / "track.csv").position[-1]
    samples, _ = soundfile.read(scene / "audio.wav", dtype="float32", always_2d=True)
    up = torch.fft.irfft(torch.fft.rfft(torch.from_numpy(samples.T.copy())), 72_000) * 3
    write_recording(scene / "audio.wav", up, 48_000)
    assert run(scene, "--num-particles", "400") == 0
    torch.testing.assert_close(read_track(scene / "track.csv").position[-1], expected, atol=0.05, rtol=0)


def test_missing_recording(scene, capsys):
    fails(capsys, run(scene, audio="none.wav"), "none.wav", "No such file")


def test_not_audio(scene, capsys):
    (scene / "text.wav").write_text("this is no sound")
    fails(capsys, run(scene, audio="text.wav"), "text.wav", "not a sound file")


def test_a_folder_is_not_a_recording(scene, capsys):
    fails(capsys, run(scene, audio="."), "Is a directory")


def test_no_samples(scene, capsys):
    write_recording(scene / "audio.wav", torch.zeros(5, 0))
    fails(capsys, run(scene), "empty")


def test_shorter_than_a_frame(scene, capsys):
    changed(scene, lambda x: x[:, :500])
    fails(capsys, run(scene), "shorter than a frame", "31.2 ms of 32.0 ms")


@pytest.mark.parametrize(("channels", "said"), [(4, "4 channels"), (6, "6 channels")])
def test_other_number_of_channels_than_microphones(scene, capsys, channels, said):
    changed(scene, lambda x: torch.cat([x, x])[:channels])
    fails(capsys, run(scene), said, "five has 5 microphones", "--channels")


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_samples_that_are_not_finite(scene, capsys, value):
    changed(scene, lambda x: x.index_put((torch.tensor([2]), torch.tensor([16_000])), x.new_tensor(value)))
    fails(capsys, run(scene), "channel 3", "1.000 s")


def test_dead_channel_is_named_and_left_out(scene, capsys):
    changed(scene, lambda x: x.index_fill(0, torch.tensor([1]), 0.25))
    assert run(scene, "--num-particles", "400", "--start", "2.2,1.3") == 0
    assert "warning: channel 2 is constant or all zero: tracking with the other 4" in capsys.readouterr().err
    table = read_track(scene / "track.csv")
    torch.testing.assert_close(table.position[-1], torch.tensor([2.4, 1.1]), atol=0.05, rtol=0)
    array = MicrophoneArray.from_yaml(scene / "array.yaml")  # all of it: the centre does not move with the dead
    of_all, of_live = (azimuth(table.position[-1], a.centre[:2]) for a in (array, array.select([0, 2, 3, 4])))
    assert abs(table.columns["azimuth"][-1] - of_all) < 0.01 < abs(of_live - of_all) / 2


def test_too_few_live_channels(scene, capsys):
    changed(scene, lambda x: x.index_fill(0, torch.tensor([0, 2, 4]), 0.0))
    fails(capsys, run(scene), "channel 1, 3, 5", "2 live microphones")


def test_silence_throughout_spreads_and_is_never_nan(scene, capsys):
    changed(scene, torch.zeros_like)
    assert run(scene, "--start", "1.2,1.3") == 0
    assert "every channel is constant" in capsys.readouterr().err
    table = read_track(scene / "track.csv")
    assert table.columns["std_x"].isfinite().all()
    assert table.columns["std_x"][-1] > 2 * table.columns["std_x"][0]
    assert (table.columns["speech"] == 0).all()


def test_clipping_is_told_with_its_share(scene, capsys):
    changed(scene, lambda x: torch.cat([(8 * x[:2]).clamp(-1, 1), x[2:]]))
    assert run(scene) == 0
    said = capsys.readouterr().err
    assert re.search(r"warning: clipped, .*: channel 1 \([\d.]+%\), 2 \([\d.]+%\)$", said.strip())


def test_a_start_beside_a_microphone(scene, capsys):
    fails(capsys, run(scene, "--start", "1.4,0.5"), "start [1.4, 0.5]", "keep_out")
    assert run(scene, "--start", "1.4,0.5", "--keep-out", "0") == 0


def test_too_many_particles_for_the_memory(scene, capsys):
    fails(capsys, run(scene, "--num-particles", str(10**15)), "not enough memory")


def test_an_exponent_that_leaves_nothing_of_any_power_is_never_nan(scene):
    assert run(scene, "--exponent", "80") == 0
    assert all(column.isfinite().all() for column in read_track(scene / "track.csv").columns.values())


@pytest.mark.parametrize(
    ("positions", "words"),
    [
        ([[0.0, 1.0], [2.0]], ["array.yaml", "positions"]),
        ([[0.0, 1.0, 1.0]], ["shape (M, 2) or (M, 3)", "(1, 3)"]),
        ([[0, 0, 0], [1, 0, 0], [0, 0, 0]], ["microphones 1 and 3", "same position"]),
        ([[0, 0, 0], [800, 0, 0], [0, 400, 0]], ["800 m", "millimetres"]),
        ([[0, 0, 0], [46, 0, 0], [0, 46, 0]], ["the nearest are 46 m apart", "millimetres"]),
    ],
)
def test_array_file_that_cannot_be(scene, capsys, positions, words):
    (scene / "array.yaml").write_text(yaml.safe_dump({"positions": positions}))
    fails(capsys, run(scene), *words)


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--region", "0,0,1.5:3,3,2"], ["misses the plane", "1.3 m"]),
        (["--region", "0,0:0,3"], ["low must be below high on axis x"]),
        (["--region", "0,0"], ["--region must be LOW:HIGH"]),
        (["--start", "9,1"], ["start [9.0, 1.0] is not inside the region", "x 0 to 3.6 m"]),
        (["--start", "-9,1"], ["start [-9.0, 1.0] is not inside"]),
        (["--start", "here"], ["--start must be x,y"]),
        (["--num-particles", "0"], ["num_particles", "at least 1"]),
        (["--num-particles", "many"], ["--num-particles: expected int, got many"]),
        (["--threshold", "1.5"], ["threshold must be in [0, 1]"]),
        (["--exponent", "-2"], ["exponent must be finite and positive"]),
        (["--hop", "513"], ["hop must be at most frame_length"]),
        (["--band-low", "9000"], ["band must satisfy"]),
        (["--speed-of-sound", "0"], ["speed_of_sound"]),
        (["--vad-slope", "0"], ["vad_slope must be finite and positive"]),
        (["--height", "5"], ["misses the plane"]),
        (["--model", "CU-NONE"], ["--model: expected one of", "CU-LAN"]),
        (["--fs", "0"], ["fs"]),
        (["--seed", "9" * 20], ["seeds must be integers of at most 64 bits"]),
        (["--channels", "0"], ["--channels"]),
        (["--channels", "1,2,3,4,9"], ["no channel 9"]),
        (["--no-such-flag"], ["no-such-flag"]),
        (["--config", "none.yaml"], ["none.yaml"]),
    ],
)
def test_impossible_flags(scene, capsys, flags, words):
    fails(capsys, run(scene, *flags), *words)


@pytest.mark.parametrize(
    ("output", "words"), [("no/such/track.csv", ["cannot write"]), ("track.txt", [".csv, .jsonl, .parquet"])]
)
def test_output_is_checked_before_the_work(scene, capsys, output, words):
    fails(capsys, run(scene, audio="none.wav", output=output), *words)


def test_a_failed_run_leaves_an_older_track_alone(scene, capsys):
    (scene / "track.csv").write_text("older")
    fails(capsys, run(scene, audio="none.wav"))
    assert (scene / "track.csv").read_text() == "older"


def test_array_and_output_are_needed(scene, capsys):
    fails(capsys, main(["track", str(scene / "audio.wav"), "-o", str(scene / "t.csv")]), "--array is needed")
    fails(capsys, main(["track", str(scene / "audio.wav"), "--array", str(scene / "array.yaml")]), "-o is needed")


def test_interruption_leaves_the_frames_so_far(scene):
    changed(scene, lambda x: x.repeat(1, 200))
    command = [sys.executable, "-c", "import sys; from probtrack.cli.main import main; sys.exit(main(sys.argv[1:]))"]
    arguments = ["track", "audio.wav", "--array", "array.yaml", "-o", "track.csv", "--num-particles", "2000"]
    process = subprocess.Popen(
        [*command, *arguments],
        cwd=scene,
        stderr=subprocess.PIPE,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # ignored where tests run in the background
    )
    output = scene / "track.csv"
    while process.poll() is None and not (output.exists() and output.stat().st_size > 5000):
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate()
    assert process.returncode == 130
    assert said.decode().splitlines() == ["probtrack track: interrupted: track.csv holds the frames so far"]
    table = read_track(output)
    assert 30 < len(table.time) < 18_000


def test_help_does_not_wait_for_torch():
    code = "import sys; from probtrack.cli.main import main; main(['--help']); sys.exit('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert all(command in done.stdout for command in COMMANDS)


def test_unknown_command(capsys):
    assert main(["trace"]) == 2
    assert capsys.readouterr().err == (
        "probtrack: error: no command 'trace': "
        "expected one of simulate, track, fit, evaluate, study, score, plot (see probtrack --help)\n"
    )
