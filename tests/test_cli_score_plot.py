"""probtrack score and probtrack plot: figures and pictures of track files, and what they refuse."""

import json
import math

import pytest
import torch

from probtrack.cli import flags
from probtrack.cli.main import main
from probtrack.errors import InputError
from probtrack.track_files import read_track


def write(path, rows, header="time,track,x,y,azimuth"):
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return str(path)


@pytest.fixture
def files(tmp_path):
    """A truth that stands still, a track 0.3 m off and one that is off at the start only."""
    times = [round(0.1 * k, 3) for k in range(20)]
    truth = write(tmp_path / "truth.csv", [(t, 1, 1.0, 2.0, 3.1) for t in times])
    off = write(tmp_path / "off.csv", [(t, 1, 1.0, 2.3, -3.1) for t in times])
    late = write(tmp_path / "late.csv", [(t, 1, 1.0, 2.0 + 0.4 * (t < 0.95), 3.1) for t in times])
    return truth, off, late


def test_json_has_hand_made_figures(files, capsys):
    truth, off, late = files
    assert main(["score", truth, off, late, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    first, second = said["tracks"]
    assert first["frames"] == second["frames"] == 20
    assert first["rmse"] == pytest.approx(0.3)
    assert second["rmse"] == pytest.approx(0.4 * math.sqrt(10 / 20))
    assert (first["lost"], second["lost"]) == (True, False)
    assert first["azimuth_median"] == pytest.approx(2 * math.pi - 6.2)
    assert said["total"]["runs"] == 2
    assert said["total"]["track_loss_percentage"] == 50.0
    assert said["total"]["mean_rmse"] == pytest.approx((0.3 + 0.4 * math.sqrt(0.5)) / 2)


def test_table_has_a_row_a_track_and_a_total(files, capsys):
    truth, off, late = files
    assert main(["score", truth, off, late]) == 0
    said = capsys.readouterr().out
    row = next(line for line in said.splitlines() if "off.csv" in line)
    assert all(cell in row for cell in ("20", "0.300", "yes", "4.8"))
    assert "track loss 50.0 %" in said


def test_one_track_needs_no_total(files, capsys):
    assert main(["score", files[0], files[2]]) == 0
    assert "runs" not in capsys.readouterr().out


def one_line(capsys, code, *words):
    said = capsys.readouterr().err
    assert code == 2
    assert len(said.splitlines()) == 1
    assert all(word in said for word in words), said


def test_score_says_what_is_wrong(files, tmp_path, capsys):
    truth = files[0]
    apart = write(tmp_path / "apart.csv", [(50.0, 1, 0, 0, 0), (50.1, 1, 0, 0, 0)])
    angles = write(tmp_path / "angles.csv", [(0.0, 1, 0.3), (0.1, 1, 0.3)], "time,track,heading")
    two = write(tmp_path / "two.csv", [(0.0, 1, 0, 0, 0), (0.1, 2, 0, 0, 0)])
    text = write(tmp_path / "text.csv", [(0.0, 1, 0, 0, 0), (0.1, 1, "left", 0, 0)])
    one_line(capsys, main(["score", truth, str(tmp_path / "none.csv")]), "none.csv", "No such file")
    one_line(capsys, main(["score", truth, apart]), "apart.csv", "no frame has an estimate at a time that the truth")
    one_line(capsys, main(["score", truth, angles]), "angles.csv", "x and y, or azimuth")
    one_line(capsys, main(["score", truth, two]), "two.csv", "tracks 1, 2")
    one_line(capsys, main(["score", truth, text]), "text.csv:3", "column x")
    one_line(capsys, main(["score", truth]), "track")


def test_plots_tracks_with_their_truth(files, tmp_path, scene):
    pytest.importorskip("matplotlib")
    truth, *tracks = files
    picture = tmp_path / "p.png"
    assert main(["plot", *tracks, "--truth", truth, "--array", str(scene / "array.yaml"), "-o", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert picture.stat().st_size > 20_000


def test_plots_a_recording_after_tracking_it(scene):
    pytest.importorskip("matplotlib")
    picture = scene / "p.svg"
    code = main(["plot", str(scene / "audio.wav"), "--array", str(scene / "array.yaml"), "-o", str(picture)])
    assert code == 0
    assert "<svg" in picture.read_text()


def test_plot_says_what_is_wrong(files, scene, capsys):
    off = files[1]
    audio, picture = str(scene / "audio.wav"), str(scene / "p.png")
    one_line(capsys, main(["plot", off]), "-o is needed")
    one_line(capsys, main(["plot", off, "-o", str(scene / "p.bmp")]), ".png, .pdf, .svg")
    one_line(capsys, main(["plot", off, "-o", str(scene / "no/p.png")]), "cannot write")
    one_line(capsys, main(["plot", off, audio, "-o", picture]), "either one recording or track files")
    one_line(capsys, main(["plot", audio, "-o", picture]), "--array is needed")
    one_line(capsys, main(["plot", str(scene / "none.csv"), "-o", picture]), "none.csv")
    one_line(capsys, main(["plot", off, "--truth", str(scene / "no.csv"), "-o", picture]), "no.csv")


def test_channels_are_counted_from_one_with_ranges():
    assert flags.channel_numbers("3,1,5-8") == (2, 0, 4, 5, 6, 7)


@pytest.mark.parametrize("value", ["0", "1-", "a", "", "1,1", "1-3,2", "-2", "3-1"])
def test_channels_that_cannot_be(value):
    with pytest.raises(InputError, match="--channels"):
        flags.channel_numbers(value)


def test_region_of_two_corners():
    where = flags.region("-1,0.5,0:2,3,2.5")
    assert (where.low, where.high) == ((-1.0, 0.5, 0.0), (2.0, 3.0, 2.5))


@pytest.mark.parametrize("value", ["1", "1,2,3,4", "a,b", "nan,1", "inf,1"])
def test_points_that_cannot_be(value):
    with pytest.raises(InputError, match="--start"):
        flags.point(value, "--start")


def test_negative_coordinates_after_a_flag_are_no_flag(scene):
    output = str(scene / "t.csv")
    arguments = ["track", str(scene / "audio.wav"), "--array", str(scene / "array.yaml"), "-o", output]
    assert main([*arguments, "--region", "-1,-1,0:4,4,2", "--start", "-.5,-.5"]) == 0
    first = read_track(output).position[0]
    torch.testing.assert_close(first, torch.tensor([-0.5, -0.5]), atol=0.15, rtol=0)
