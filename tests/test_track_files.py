"""Track files: what is written comes back, and every bad file is named with its fault."""

import json
import math

import pytest
import torch

from probtrack.errors import InputError
from probtrack.track_files import COLUMNS, SUFFIXES, TrackWriter, check_track_output, read_track, read_tracks, rows_of
from probtrack.tracks import Track

each_kind = pytest.mark.parametrize("suffix", SUFFIXES)


@pytest.fixture(autouse=True)
def _pyarrow(request):
    if ".parquet" in request.node.name:
        pytest.importorskip("pyarrow")


def track(frames=7, axes=2, batch=(), **known):
    shape = (frames, *batch)
    base = Track(
        time=0.016 + 0.032 * torch.arange(frames),
        position=torch.randn(*shape, axes),
        std=torch.rand(*shape, axes),
        heading=torch.randn(shape),
        ess=75 * torch.rand(shape),
        log_evidence=torch.randn(shape),
        lost=torch.rand(shape) > 0.5,
    )
    return base._replace(**known)


def write(path, *blocks):
    with TrackWriter.open(path) as writer:
        for rows in blocks:
            writer.write(rows)
    return path


def file(tmp_path, text, name="bad.csv"):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def message(path):
    with pytest.raises(InputError) as caught:
        read_track(path)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(path))
    return str(caught.value)[len(str(path)) :]


@each_kind
@pytest.mark.parametrize("axes", [2, 3])
def test_what_is_written_comes_back(tmp_path, suffix, axes):
    full = track(axes=axes, azimuth=torch.randn(7), std_azimuth=torch.rand(7), speech=torch.rand(7))
    table = read_track(write(tmp_path / f"t{suffix}", rows_of(full, name=3)))
    axis = "xyz"[:axes]
    names = ["time", "track", *axis, *(f"std_{a}" for a in axis)]
    assert list(table.columns) == [*names, "azimuth", "std_azimuth", "heading", "speech", "ess", "lost"]
    micro = {"rtol": 0, "atol": 0.5001e-6}
    torch.testing.assert_close(table.time, full.time, **micro)
    torch.testing.assert_close(table.position, full.position, **micro)
    torch.testing.assert_close(torch.stack([table.get(f"std_{a}") for a in axis], -1), full.std, **micro)
    for name in ("azimuth", "std_azimuth", "heading", "speech", "ess"):
        torch.testing.assert_close(table.get(name), getattr(full, name), **micro)
    assert torch.equal(table.get("lost"), full.lost.double())
    assert torch.equal(table.get("track"), torch.full((7,), 3.0))


def test_columns_stand_in_the_order_of_the_design(tmp_path):
    path = write(tmp_path / "t.csv", rows_of(track(speech=torch.rand(7))))
    assert path.read_text().splitlines()[0] == "time,track,x,y,std_x,std_y,heading,speech,ess,lost"
    assert COLUMNS[:8] == ("time", "track", "x", "y", "z", "std_x", "std_y", "std_z")


@each_kind
def test_modes_follow_the_other_columns_by_number(tmp_path, suffix):
    mode = torch.rand(7, 11)
    table = read_track(write(tmp_path / f"t{suffix}", rows_of(track(mode=mode))))
    assert list(table.columns)[-12:] == ["lost", *(f"mode_{s}" for s in range(11))]
    torch.testing.assert_close(table.get("mode_10"), mode[:, 10], rtol=0, atol=0.5001e-6)


@each_kind
def test_unknown_columns_are_left_out(tmp_path, suffix):
    table = read_track(write(tmp_path / f"t{suffix}", rows_of(track())))
    for name in ("azimuth", "std_azimuth", "speech", "z", "std_z"):
        assert table.get(name) is None
    assert table.position.shape == (7, 2)


@each_kind
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_not_known_is_empty_and_comes_back_as_nan(tmp_path, suffix, value):
    azimuth = torch.randn(7)
    azimuth[[0, 4]] = value
    table = read_track(write(tmp_path / f"t{suffix}", rows_of(track(azimuth=azimuth))))
    assert table.get("azimuth").isnan().tolist() == [True, False, False, False, True, False, False]


def test_empty_cells_are_empty_in_the_text(tmp_path):
    rows = rows_of(track(2, azimuth=torch.full((2,), math.nan)))
    header, first, _ = write(tmp_path / "t.csv", rows).read_text().splitlines()
    cells = dict(zip(header.split(","), first.split(","), strict=True))
    assert cells["azimuth"] == ""
    assert (cells["track"], cells["lost"]) in {("1", "0"), ("1", "1")}
    assert json.loads(write(tmp_path / "t.jsonl", rows).read_text().splitlines()[0])["azimuth"] is None


@each_kind
def test_a_column_may_be_empty_in_the_first_block_and_known_later(tmp_path, suffix):
    azimuth = torch.full((7,), math.nan)
    azimuth[5] = 0.25
    rows = rows_of(track(azimuth=azimuth))
    table = read_track(write(tmp_path / f"t{suffix}", rows[:4], [], rows[4:]))
    assert table.get("azimuth")[5] == 0.25
    assert len(table.time) == 7


@each_kind
def test_blocks_make_the_file_of_the_whole(tmp_path, suffix):
    rows = rows_of(track(9))
    whole = read_track(write(tmp_path / f"whole{suffix}", rows))
    pieces = read_track(write(tmp_path / f"pieces{suffix}", [], rows[:1], rows[1:2], [], rows[2:]))
    for name, column in whole.columns.items():
        assert torch.equal(column, pieces.columns[name])


@pytest.mark.parametrize("suffix", [".csv", ".jsonl"])
def test_text_is_valid_after_every_block(tmp_path, suffix):
    path, rows = tmp_path / f"t{suffix}", rows_of(track(9))
    with TrackWriter.open(path) as writer:
        for count in range(1, 10):
            writer.write(rows[count - 1 : count])
            assert len(read_track(path).time) == count


@each_kind
def test_an_error_in_the_middle_leaves_a_valid_file(tmp_path, suffix):
    path = tmp_path / f"t{suffix}"

    def interrupted():
        with TrackWriter.open(path) as writer:
            writer.write(rows_of(track(4)))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert len(read_track(path).time) == 4


def test_parquet_without_rows_is_a_parquet_file(tmp_path):
    assert message(write(tmp_path / "t.parquet")) == ": the track file has no rows"


@pytest.mark.parametrize("suffix", [".csv", ".jsonl", ".parquet"])
def test_times_of_long_recordings_keep_their_microseconds(tmp_path, suffix):
    time = torch.tensor([98765.432109, 98765.432110, 98765.432111])
    assert torch.equal(read_track(write(tmp_path / f"t{suffix}", rows_of(track(3, time=time)))).time, time)


def test_dash_is_standard_output(tmp_path, capfd):
    rows = rows_of(track())
    check_track_output("-")
    write("-", rows[:3], rows[3:])
    assert capfd.readouterr().out == write(tmp_path / "t.csv", rows).read_text()
    print("still open")  # noqa: T201
    assert capfd.readouterr().out == "still open\n"


def test_suffix_may_be_in_capitals(tmp_path):
    assert len(read_track(write(tmp_path / "T.CSV", rows_of(track()))).time) == 7


def test_a_batch_of_runs_is_no_file():
    with pytest.raises(InputError, match=r"holds one run, got a batch \(2, 3\)"):
        rows_of(track(batch=(2, 3)))


def test_tracks_that_carry_gradients_can_be_written():
    position = torch.randn(7, 2, requires_grad=True)
    assert rows_of(track(position=position))[2]["y"] == position[2, 1].item()


@pytest.mark.parametrize(
    "text",
    [
        "\ufefftime,x,y\n0.1,1,2\n0.2,3,4\n",  # a spreadsheet's mark
        "time, x , y\r\n0.1, 1, 2\r\n\r\n0.2,3,4\r\n",
        "y,comment,time,x\n2,hello,0.1,1\n4,,0.2,3\n",
        "track,time,x,y\n1,0.1,1,2\n,0.2,3,4\n",
        "track,time,x,y\n,0.1,1,2\n,0.2,3,4\n",
    ],
)
def test_files_of_other_programs_are_read(tmp_path, text):
    table = read_track(file(tmp_path, text))
    assert table.time.tolist() == [0.1, 0.2]
    assert table.position.tolist() == [[1, 2], [3, 4]]


def test_json_lines_may_have_blank_lines_and_rows_without_a_value(tmp_path):
    text = '{"time": 0.1, "x": 1, "y": 2}\n\n{"time": 0.2, "y": 4, "azimuth": 0.5}\n'
    table = read_track(file(tmp_path, text, "t.jsonl"))
    assert table.get("x").isnan().tolist() == [False, True]
    assert table.get("azimuth")[1] == 0.5


def test_azimuth_alone_is_a_track(tmp_path):
    table = read_track(file(tmp_path, "time,azimuth\n0,1\n1,2\n"))
    assert table.position is None
    assert table.get("azimuth").tolist() == [1, 2]


BAD = {
    "empty": ("", ": a track file needs a column 'time', got no columns"),
    "no time": ("t,x,y\n0,1,2\n", ": a track file needs a column 'time', got x, y"),
    "no place": ("time,x\n0,1\n", ": a track file needs columns x and y, or azimuth"),
    "no rows": ("time,x,y\n", ": the track file has no rows"),
    "ragged": ("time,x,y\n0,1,2\n1,2\n", ":3: 2 cells under 3 column names"),
    "text": ("time,x,y\n0,1,2\n1,left,3\n", ":3: column x holds something that is not a number"),
    "time lost": ("time,x,y\n0,1,2\n,2,3\n", ": every row needs a time"),
    "infinite": ("time,x,y\n0,1,2\ninf,2,3\n", ": every row needs a time"),
    "equal": ("time,x,y\n0,1,2\n0,2,3\n", ": times must increase from row to row, got 0 s after 0 s in row 2"),
    "back": ("time,x,y\n1,1,2\n0,2,3\n", ": times must increase from row to row, got 0 s after 1 s in row 2"),
    "two": ("time,track,x,y\n0,1,1,2\n1,2,1,2\n", ": holds tracks 1, 2, expected one"),
    "twice": ("time,x,y,x\n0,1,2,3\n", ": has the column x more than once"),
}


@pytest.mark.parametrize(("text", "fault"), BAD.values(), ids=BAD)
def test_bad_csv_is_named_with_its_fault(tmp_path, text, fault):
    assert message(file(tmp_path, text)) == fault


BAD_JSON = {
    "broken": ('{"time": 0, "x": 1, "y": 2}\n{"time": 1, \n', ":2: expected a JSON object a line"),
    "list": ("[1, 2]\n", ":1: expected a JSON object a line"),
    "deep": ("[" * 100_000, ":1: expected a JSON object a line"),
    "text": ('{"time": 0, "x": "left", "y": 2}\n', ":1: column x holds something that is not a number"),
    "nested": ('{"time": 0, "x": [1], "y": 2}\n', ":1: column x holds something that is not a number"),
    "huge": ('{"time": 0, "x": 1' + "0" * 400 + ', "y": 2}\n', ":1: column x holds something that is not a number"),
    "no time": ('{"x": 1, "y": 2}\n', ": a track file needs a column 'time', got x, y"),
}


@pytest.mark.parametrize(("text", "fault"), BAD_JSON.values(), ids=BAD_JSON)
def test_bad_json_lines_are_named_with_their_fault(tmp_path, text, fault):
    assert message(file(tmp_path, text, "bad.jsonl")) == fault


@pytest.mark.parametrize(("suffix", "kind"), [(".csv", "CSV"), (".jsonl", "JSON lines"), (".parquet", "Parquet")])
@pytest.mark.parametrize("content", [bytes(range(128, 256)), b"\x89PNG\r\n\x1a\n\xff\x00\x00" * 9])
def test_binary_of_another_kind_is_no_track(tmp_path, suffix, kind, content):
    assert f"not a {kind} file" in message(file(tmp_path, content, f"bad{suffix}"))


@pytest.mark.parametrize("keep", [0, 3, 60, 400, -1, -9])
def test_damaged_parquet_is_named(tmp_path, keep):
    pytest.importorskip("pyarrow")
    whole = write(tmp_path / "t.parquet", rows_of(track())).read_bytes()
    assert "not a Parquet file" in message(file(tmp_path, whole[:keep], "bad.parquet"))


@each_kind
def test_missing_file_is_named(tmp_path, suffix):
    assert "No such file or directory" in message(tmp_path / f"nothing{suffix}")


@pytest.mark.parametrize("suffix", [".csv", ".jsonl"])
def test_folder_is_no_track(tmp_path, suffix):
    (tmp_path / f"t{suffix}").mkdir()
    assert "cannot read the track file: Is a directory" in message(tmp_path / f"t{suffix}")


@pytest.mark.parametrize("act", [read_track, check_track_output, TrackWriter.open])
@pytest.mark.parametrize("name", ["t.txt", "t", "t.csv.gz"])
def test_unknown_suffix_is_named(tmp_path, act, name):
    with pytest.raises(InputError, match=r"a track file ends in \.csv, \.jsonl, \.parquet, got"):
        act(tmp_path / name)


@pytest.mark.parametrize("act", [check_track_output, TrackWriter.open])
@each_kind
def test_place_that_cannot_be_written_is_named(tmp_path, act, suffix):
    with pytest.raises(InputError, match="cannot write there: No such file or directory"):
        act(tmp_path / "nowhere" / f"t{suffix}")


def test_checking_leaves_files_as_they_were(tmp_path):
    old = file(tmp_path, "time,x,y\n0,1,2\n", "old.csv")
    check_track_output(old)
    check_track_output(tmp_path / "new.csv")
    assert old.read_text() == "time,x,y\n0,1,2\n"
    assert not (tmp_path / "new.csv").exists()


@each_kind
def test_opening_empties_what_was_there(tmp_path, suffix):
    path = write(tmp_path / f"t{suffix}", rows_of(track(30)))
    assert len(read_track(write(path, rows_of(track(2)))).time) == 2


def test_all_tracks_of_a_file_are_read_in_the_order_of_their_numbers(tmp_path):
    rows = "time,track,x,y\n0,10,1,2\n0,2,3,4\n1,10,5,6\n1,2,7,8\n2,2,9,0\n"
    second, tenth = read_tracks(file(tmp_path, rows))
    assert second.time.tolist() == [0, 1, 2]
    assert second.position.tolist() == [[3, 4], [7, 8], [9, 0]]
    assert tenth.position.tolist() == [[1, 2], [5, 6]]


@pytest.mark.parametrize("header", ["time,x,y\n0,1,2\n1,3,4\n", "time,track,x,y\n0,7,1,2\n1,,3,4\n"])
def test_one_track_needs_no_number(tmp_path, header):
    path = file(tmp_path, header)
    (only,) = read_tracks(path)
    assert torch.equal(only.position, read_track(path).position)


def test_several_tracks_need_numbers_and_times_in_order(tmp_path):
    with pytest.raises(InputError, match=r"bad.csv: holds several tracks: every row needs a track number"):
        read_tracks(file(tmp_path, "time,track,x,y\n0,1,1,2\n0,2,3,4\n1,,5,6\n"))
    with pytest.raises(InputError, match=r"bad.csv: times must increase"):
        read_tracks(file(tmp_path, "time,track,x,y\n0,1,1,2\n1,2,3,4\n0,2,5,6\n"))
    with pytest.raises(InputError, match=r"bad.csv: the track file has no rows"):
        read_tracks(file(tmp_path, "time,track,x,y\n"))
