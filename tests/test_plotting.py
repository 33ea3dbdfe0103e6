"""Pictures: one is written for every kind of file and of track, and bad places are said before."""

import math
from pathlib import Path

import pytest
import torch

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray, Region
from probtrack.plotting import check_picture, plot_tracks
from probtrack.track_files import TrackTable

matplotlib = pytest.importorskip("matplotlib")

MAGIC = {".png": b"\x89PNG", ".pdf": b"%PDF", ".svg": b"<?xml"}


def table(name="walk", frames=40, **columns):
    time = torch.arange(frames) * 0.1
    angle = 2.6 + 0.35 * time  # passes pi
    known = {
        "time": time,
        "x": 1.7 + angle.cos(),
        "y": 1.4 + 0.8 * angle.sin(),
        "std_x": 0.05 + 0.01 * time,
        "std_y": torch.full((frames,), 0.08),
        "azimuth": torch.atan2(angle.sin(), angle.cos()),
        "std_azimuth": torch.full((frames,), 0.1),
        "speech": (time % 2 < 1).double(),
    }
    return TrackTable(Path(f"{name}.csv"), {k: v for k, v in (known | columns).items() if v is not None})


ARRAY = [[1.35, 0.29, 1.5], [2.15, 0.29, 1.5], [3.01, 1.15, 1.5]]
REGION = Region((0.0, 0.0), (3.5, 3.1))
ONLY_AZIMUTH = dict.fromkeys(["x", "y", "std_x", "std_y", "speech"])
ONLY_POSITION = dict.fromkeys(["azimuth", "std_azimuth", "speech", "std_x", "std_y"])


@pytest.mark.parametrize("suffix", MAGIC)
def test_picture_is_of_its_kind(tmp_path, suffix):
    path = tmp_path / f"picture{suffix}"
    plot_tracks([table()], path, truth=table("truth"), array=MicrophoneArray(ARRAY), region=REGION)
    assert path.read_bytes().startswith(MAGIC[suffix])
    assert path.stat().st_size > 10_000


@pytest.mark.parametrize("columns", [{}, ONLY_AZIMUTH, ONLY_POSITION, {"azimuth": torch.full((40,), math.nan)}])
@pytest.mark.parametrize("with_truth", [True, False])
def test_tracks_of_any_columns_can_be_drawn(tmp_path, columns, with_truth):
    path, truth = tmp_path / "picture.svg", table("truth", **columns) if with_truth else None
    plot_tracks([table(**columns)], path, truth=truth)
    assert path.stat().st_size > 10_000


def test_more_tracks_than_colours_can_be_drawn(tmp_path):
    plot_tracks([table(f"run {i}") for i in range(7)], tmp_path / "picture.svg")
    assert {f"run {i}" for i in range(7)} <= set(words(tmp_path / "picture.svg"))


@pytest.mark.parametrize("given", [{"array": True}, {"region": True}])
def test_room_may_be_known_or_not(tmp_path, given):
    made = {"array": MicrophoneArray(ARRAY), "region": Region((0.0, 0.0, 0.0), (3.5, 3.1, 2.2))}
    plot_tracks([table(**ONLY_AZIMUTH)], tmp_path / "picture.svg", **{name: made[name] for name in given})
    assert (tmp_path / "picture.svg").stat().st_size > 10_000


def test_one_row_and_rows_without_a_number_can_be_drawn(tmp_path):
    lone = table(frames=1)
    empty = table("empty", x=torch.full((40,), math.nan), y=torch.full((40,), math.nan))
    plot_tracks([lone, empty], tmp_path / "picture.png", truth=lone)
    assert (tmp_path / "picture.png").stat().st_size > 10_000


def words(path):
    """Texts of an SVG, which matplotlib notes beside the outlines it draws them with."""
    return [line.strip()[4:-3].strip() for line in path.read_text().splitlines() if line.strip().startswith("<!--")]


def test_picture_names_what_it_shows(tmp_path):
    path = tmp_path / "picture.svg"
    plot_tracks([table("first"), table("other")], path, truth=table("t"), array=MicrophoneArray(ARRAY), region=REGION)
    said = words(path)
    for word in ("x [m]", "y [m]", "azimuth [°]", "P(speech)", "time [s]", "first", "other", "truth", "microphones"):
        assert word in said


def test_tracks_of_azimuth_alone_are_named_too(tmp_path):
    plot_tracks([table("first", **ONLY_AZIMUTH)], tmp_path / "picture.svg", truth=table("t", **ONLY_AZIMUTH))
    assert {"first", "truth"} <= set(words(tmp_path / "picture.svg"))


def test_nothing_global_is_changed(tmp_path):
    before = dict(matplotlib.rcParams)
    plot_tracks([table()], tmp_path / "picture.png")
    assert dict(matplotlib.rcParams) == before


@pytest.mark.parametrize("name", ["picture.gif", "picture", "picture.png.txt"])
def test_unknown_suffix_is_named(tmp_path, name):
    for act in (check_picture, lambda path: plot_tracks([table()], path)):
        with pytest.raises(InputError, match=r"a picture ends in \.png, \.pdf, \.svg, got"):
            act(tmp_path / name)


def test_place_that_cannot_be_written_is_named(tmp_path):
    for act in (check_picture, lambda path: plot_tracks([table()], path)):
        with pytest.raises(InputError, match="cannot write there: No such file or directory"):
            act(tmp_path / "nowhere" / "picture.png")


def test_checking_leaves_a_picture_as_it_was(tmp_path):
    (tmp_path / "old.png").write_bytes(b"old")
    check_picture(tmp_path / "old.png")
    check_picture(tmp_path / "new.png")
    assert (tmp_path / "old.png").read_bytes() == b"old"
    assert not (tmp_path / "new.png").exists()
