"""probtrack simulate: scenes and data sets from files, what they will cost, and what it refuses."""

import re
import subprocess
import sys
import time

import pytest
import torch
from quick_scenes import TEMPLATE, write_data_set, write_scene

from probtrack.cli.main import main
from probtrack.simulation import ResponseCache, SceneFolder, load_scene, read_manifest, save_scene, shipped_scenes

HARD = TEMPLATE.replace("t60: 0.0", "t60: 0.1, spacing: 0.25")


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """No test touches the user's cache, and all run in the precision that users have."""
    monkeypatch.setenv("PROBTRACK_CACHE", str(tmp_path / "cache"))
    torch.set_default_dtype(torch.float32)
    return tmp_path / "cache"


def responses(folder):
    return len(list(folder.rglob("*.npy")))


def one_line(capsys, code, *words):
    said = capsys.readouterr().err
    assert code == 2
    assert len(said.splitlines()) == 1, said
    assert said.startswith("probtrack simulate: error: ")
    assert all(word in said for word in words), said


def test_help_says_what_there_is(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["simulate", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert stopped.value.code == 0
    for word in ("--out", "--workers", "--cache", "--dry-run", "scene or data set file", *shipped_scenes()):
        assert word in said


def test_a_scene_is_what_the_library_makes_of_its_file(tmp_path, capsys):
    config = write_scene(tmp_path)
    assert main(["simulate", config, "-o", str(tmp_path / "a")]) == 0
    said = capsys.readouterr()
    assert re.fullmatch(r".*a: 1.7 s of one talker, in [\d.]+ s\n", said.out)
    assert said.err == ""
    scene = load_scene(config)
    save_scene(tmp_path / "b", scene, scene.simulate())
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()
    assert main(["simulate", str(tmp_path / "a" / "scene.yaml"), "-o", str(tmp_path / "c")]) == 0
    assert (tmp_path / "a" / "audio.wav").read_bytes() == (tmp_path / "c" / "audio.wav").read_bytes()


def test_a_data_set_is_made_and_gone_on_with(tmp_path, capsys):
    config = write_data_set(tmp_path, "count: 2", "snr_db: [5.0, 15.0]")
    command = ["simulate", config, "-o", str(tmp_path / "set"), "--workers", "1"]
    assert main(command) == 0
    assert re.fullmatch(r".*set: 2 scenes at 2 SNR: 2 made in \d+ s\n", capsys.readouterr().out)
    assert [row["folder"] for row in read_manifest(tmp_path / "set")] == ["0_+5dB", "0_+15dB", "1_+5dB", "1_+15dB"]
    assert main(command) == 0
    assert capsys.readouterr().out.endswith("all were there\n")
    (tmp_path / "set" / "1_+5dB").rename(tmp_path / "gone")
    assert main([*command, "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "recordings  2 to make, 2 are there" in said
    assert not (tmp_path / "set" / "1_+5dB").exists()


def test_a_dry_run_makes_nothing(tmp_path, cache, capsys):
    config = write_data_set(tmp_path, "count: 3", "snr_db: [5.0, 15.0]", template=HARD)
    assert main(["simulate", config, "-o", str(tmp_path / "set"), "--workers", "2", "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "recordings  6 to make, 0 are there" in said
    assert "with 2 workers" in said
    assert main(["simulate", write_scene(tmp_path), "-o", str(tmp_path / "a"), "--dry-run"]) == 0
    assert "recordings  1 to make, 0 are there" in capsys.readouterr().out
    assert not (tmp_path / "set").exists()
    assert not (tmp_path / "a").exists()
    assert responses(cache) == 0


@pytest.mark.slow
def test_a_dry_run_counts_responses_and_guesses_the_time(tmp_path, capsys, cache):
    config = write_data_set(tmp_path, "count: 4", template=HARD.replace("lehmann2007_way, init_args: {number: 2}",
                            "SocialForceWalk").replace("1.7", "6.0"))  # fmt: skip
    command = ["simulate", config, "-o", str(tmp_path / "set"), "--workers", "1"]
    assert main([*command, "--dry-run"]) == 0
    said = capsys.readouterr().out
    expected = int(re.search(r"for (\d+) responses", said)[1])
    seconds = float(re.search(r"about (\d+) s with 1 worker\n", said)[1])
    begin = time.perf_counter()
    assert main(command) == 0
    took = time.perf_counter() - begin
    assert expected == pytest.approx(responses(cache), rel=0.1)
    assert took / 8 < seconds + 0.5  # a guess of the right size, also on a busy machine
    assert seconds < 8 * took + 0.5
    capsys.readouterr()
    assert main([*command[:-3], str(tmp_path / "again"), "--workers", "1", "--dry-run"]) == 0
    assert (
        int(re.search(r"for (\d+) responses", capsys.readouterr().out)[1]) <= 0.2 * expected
    )  # a place left at once needs none


def test_a_cache_of_ones_own_is_used(tmp_path, cache):
    config = write_scene(tmp_path, HARD)
    assert main(["simulate", config, "-o", str(tmp_path / "a"), "--cache", str(tmp_path / "mine")]) == 0
    made = responses(tmp_path / "mine")
    assert made > 3
    assert not cache.exists()
    assert main(["simulate", config, "-o", str(tmp_path / "b")]) == 0
    assert responses(cache) == made
    assert (tmp_path / "a" / "audio.wav").read_bytes() == (tmp_path / "b" / "audio.wav").read_bytes()


def test_a_scene_that_ships_is_known_by_its_name(tmp_path, capsys):
    assert main(["simulate", "lehmann2007", "-o", str(tmp_path / "a"), "--dry-run"]) == 0
    assert main(["simulate", "walks", "-o", str(tmp_path / "a"), "--dry-run"]) == 0
    assert "recordings  400 to make" in capsys.readouterr().out


def test_what_is_wrong_is_said_in_one_line(tmp_path, capsys):
    config, out = write_scene(tmp_path), str(tmp_path / "out")
    bad = tmp_path / "bad.yaml"
    (tmp_path / "file").write_text("")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("years")
    ResponseCache(tmp_path / "old")
    (tmp_path / "old" / "FORMAT").write_text("0\n")
    one_line(capsys, main(["simulate"]), "config")
    one_line(capsys, main(["simulate", config]), "out")
    one_line(capsys, main(["simulate", config, "-o", out, "--loud"]), "--loud")
    one_line(capsys, main(["simulate", "nowhere.yaml", "-o", out]), "nowhere.yaml", "No such file")
    one_line(capsys, main(["simulate", config, "-o", out, "--workers", "0"]), "--workers must be at least 1, got 0")
    one_line(capsys, main(["simulate", config, "-o", out, "--workers", "many"]), "--workers", "many")
    one_line(capsys, main(["simulate", config, "-o", out, "--cache", str(tmp_path / "old")]), "format '0'")
    one_line(capsys, main(["simulate", config, "-o", out, "--cache", str(tmp_path / "file")]), "cache of responses")
    for text, word in (
        ("a: [", "not YAML"),
        ("", "YAML mapping"),
        ("duration: 2", "required"),
        ("scenes: 3", "expected tuple, got 3"),
    ):
        bad.write_text(text)
        one_line(capsys, main(["simulate", str(bad), "-o", out]), "bad.yaml", word)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("dry", [[], ["--dry-run"]], ids=["made", "dry"])
def test_output_that_cannot_be_is_said_before_the_work(tmp_path, capsys, monkeypatch, dry):
    config = write_scene(tmp_path)
    (tmp_path / "b").mkdir()
    several = write_data_set(tmp_path / "b", "count: 1")
    (tmp_path / "file").write_text("")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("years")
    monkeypatch.setattr("probtrack.simulation.scenes.Scene.listen", None)
    monkeypatch.setattr("probtrack.simulation.scenes.Scene.motions", None)
    one_line(capsys, main(["simulate", config, "-o", str(tmp_path / "full"), *dry]), "full: is there already")
    one_line(capsys, main(["simulate", config, "-o", str(tmp_path / "file"), *dry]), "file: is there already")
    one_line(capsys, main(["simulate", several, "-o", str(tmp_path / "full"), *dry]), "holds no data set")
    one_line(capsys, main(["simulate", several, "-o", str(tmp_path / "file"), *dry]), "cannot write the data set")


def test_another_data_set_is_refused_dry_or_not(tmp_path, capsys):
    config = write_data_set(tmp_path, "count: 1")
    assert main(["simulate", config, "-o", str(tmp_path / "set"), "--workers", "1"]) == 0
    config = write_data_set(tmp_path, "count: 1", "seed: 4")
    capsys.readouterr()
    for dry in ([], ["--dry-run"]):
        one_line(capsys, main(["simulate", config, "-o", str(tmp_path / "set"), *dry]), "another data set", "seed is 0")


@pytest.mark.slow
def test_the_program_itself_says_it_in_one_line(tmp_path):
    code = "import sys; from probtrack.cli.main import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "simulate", write_scene(tmp_path), "-o", str(tmp_path / "mine.yaml" / "a")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "cannot write the scene" in done.stderr
    assert SceneFolder(tmp_path).truth is None
