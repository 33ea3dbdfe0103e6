"""Arrays against the sentences that describe them, regions, angles, and what a wrong file is told."""

import math

import numpy as np
import pytest
import torch

from probtrack.errors import InputError, ShapeError
from probtrack.geometry import MicrophoneArray, Region, azimuth, shipped_arrays, wrap_angle

POSITIONS = [[0.31, -0.2, 1.1], [0.9, 0.44, 1.3], [-0.7, 0.15, 1.25], [0.05, 0.6, 0.95], [1.4, -0.35, 1.05]]


def shipped(name):
    return MicrophoneArray.from_yaml(shipped_arrays()[name])


def test_lehmann_array_is_that_of_figure_3():
    x = shipped("lehmann2007").positions
    assert x.shape == (8, 3)
    assert (x[:, 2] == 1.51).all()
    room = Region.from_yaml(shipped_arrays()["lehmann2007"])
    assert (room.low, room.high) == ((0.0, 0.0, 0.0), (3.5, 3.1, 2.2))
    pairs = x[:, :2].reshape(4, 2, 2)
    torch.testing.assert_close((pairs[:, 0] - pairs[:, 1]).norm(dim=-1), torch.full((4,), 0.8))
    sides = pairs.mean(1) - torch.tensor([1.75, 1.55])  # the middles of the sides, from the middle of the room
    torch.testing.assert_close(sides, 1.26 * torch.tensor([[0.0, -1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]]))
    along = (pairs[:, 1] - pairs[:, 0]) * sides
    torch.testing.assert_close(along.sum(-1), torch.zeros(4))  # each pair lies along its side


def test_av16_3_array_is_the_circle_of_its_corpus():
    angle = math.pi * (-1 + torch.arange(8.0) / 4)
    circle = torch.stack([0.1 * angle.cos(), 0.4 + 0.1 * angle.sin(), 0 * angle], -1)
    torch.testing.assert_close(shipped("av16.3-array1").positions, circle, rtol=0, atol=1e-6)  # a micrometre


def test_every_shipped_region_is_around_its_array():
    assert set(shipped_arrays()) == {"lehmann2007", "fallon2006", "klaassen2005", "av16.3-array1"}
    for path in shipped_arrays().values():
        region = Region.from_yaml(path)
        assert region.contains(MicrophoneArray.from_yaml(path).positions).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_yaml_round_trip_keeps_positions_and_short_decimals(tmp_path, dtype):
    torch.set_default_dtype(dtype)
    array = MicrophoneArray(POSITIONS, "five: \u00e9")
    array.to_yaml(tmp_path / "a.yaml", Region.around(array, 0.25))
    again = MicrophoneArray.from_yaml(tmp_path / "a.yaml")
    assert torch.equal(again.positions, array.positions)
    assert again.positions.dtype == dtype
    assert again.name == array.name
    assert Region.from_yaml(tmp_path / "a.yaml") == Region((-0.95, -0.6, 0.7), (1.65, 0.85, 1.55))
    numbers = (tmp_path / "a.yaml").read_text().replace("[", " ").replace("]", " ").replace(",", " ").split()
    assert max(len(x) for x in numbers if x[-1].isdigit()) <= 5


def test_array_without_region_has_none_and_takes_the_name_of_its_file(tmp_path):
    (tmp_path / "desk.yaml").write_text("positions: [[0.1, 0.0], [0.0, 0.3]]")
    assert Region.from_yaml(tmp_path / "desk.yaml") is None
    assert MicrophoneArray.from_yaml(tmp_path / "desk.yaml").name == "desk"


def test_pairs_are_all_pairs_first_before_second():
    array = MicrophoneArray(POSITIONS[:4])
    assert array.pairs.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]
    x = np.array(POSITIONS)
    distances = [np.linalg.norm(x[i] - x[j]) for i, j in array.pairs.tolist()]
    torch.testing.assert_close(array.pair_distances, torch.tensor(distances))
    assert array.diameter == pytest.approx(max(distances))


def test_centre_and_size_of_an_array():
    array = MicrophoneArray([[1.0, 0.0], [2.0, 0.3], [0.0, 3.0]])
    torch.testing.assert_close(array.centre, torch.tensor([1.0, 1.1]))
    assert (array.num_microphones, array.axes) == (3, 2)


def test_delays_are_distance_over_speed():
    array, points = MicrophoneArray(POSITIONS), torch.randn(2, 4, 3)
    delays = array.delays(points, speed_of_sound=340.0)
    assert delays.shape == (2, 4, 5)
    exact = np.linalg.norm(points[1, 2].numpy() - np.array(POSITIONS), axis=1) / 340.0
    torch.testing.assert_close(delays[1, 2], torch.tensor(exact))
    assert float(MicrophoneArray([[0.0, 0.0], [0.0, 1.0]]).delays(torch.tensor([3.43, 0.0]))[0]) == pytest.approx(0.01)


def test_selected_microphones_keep_their_order():
    array = MicrophoneArray(POSITIONS, "five")
    assert array.select([3, 0]).positions.tolist() == [POSITIONS[3], POSITIONS[0]]
    assert array.select([3, 0]).name == "five"


def test_an_array_does_not_change_with_the_tensor_it_was_made_of():
    positions = torch.tensor(POSITIONS)
    array = MicrophoneArray(positions)
    positions += 1
    assert array.positions.tolist() == POSITIONS


def test_many_close_microphones_far_from_the_origin_are_distinct():
    torch.set_default_dtype(torch.float32)
    line = torch.arange(64.0)[:, None] * torch.tensor([0.02, 0.001]) + torch.tensor([50.0, 40.0])
    array = MicrophoneArray(line)
    assert array.diameter == pytest.approx(63 * math.hypot(0.02, 0.001), rel=1e-4)


def test_azimuth_is_counter_clockwise_from_x():
    origin = torch.tensor([1.0, 2.0])
    offsets = torch.tensor([[2.0, 0.0], [0.0, 3.0], [-1.0, 0.0], [0.0, -0.5], [1.0, 1.0]])
    expected = torch.tensor([0.0, 0.5, 1.0, -0.5, 0.25]) * math.pi
    torch.testing.assert_close(azimuth(origin + offsets, origin), expected)


def test_azimuth_ignores_height():
    position, origin = torch.randn(4, 3), torch.randn(3)
    torch.testing.assert_close(azimuth(position, origin), azimuth(position[:, :2], origin[:2]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_wrapped_angles_are_in_range_and_the_same_direction(dtype):
    angle = torch.linspace(-20, 20, 997).to(dtype)
    wrapped = wrap_angle(angle)
    assert ((wrapped >= -math.pi) & (wrapped < math.pi)).all()
    turns = (angle - wrapped) / (2 * math.pi)
    tolerance = 20 * torch.finfo(dtype).eps
    torch.testing.assert_close(turns, turns.round(), rtol=0, atol=tolerance)


@pytest.mark.parametrize("angle", [math.pi, -math.pi, 3 * math.pi])
def test_half_a_turn_wraps_to_its_lower_end(angle):
    wrapped = wrap_angle(torch.tensor([angle]))
    assert wrapped < math.pi
    torch.testing.assert_close(wrapped, torch.tensor([-math.pi]))


def test_just_below_half_a_turn_is_a_direction_in_range():
    angle = torch.tensor([math.nextafter(-math.pi, -4), math.nextafter(math.pi, 4), math.nextafter(math.pi, 0)])
    wrapped = wrap_angle(angle)
    assert ((wrapped >= -math.pi) & (wrapped < math.pi)).all()
    torch.testing.assert_close(torch.stack([wrapped.cos(), wrapped.sin()]), torch.stack([angle.cos(), angle.sin()]))


REGION = {"low": (-0.5, 1.0, 0.2), "high": (2.5, 1.8, 2.4)}


def test_region_contains_its_inside_and_border():
    region = Region(**REGION)
    points = [[0.0, 1.5, 1.0], [-0.5, 1.0, 0.2], [2.5, 1.8, 2.4], [-0.6, 1.5, 1.0], [0.0, 1.5, 2.5], [0.0, 0.9, 1.0]]
    assert region.contains(torch.tensor(points)).tolist() == [True, True, True, False, False, False]
    assert region.contains(torch.zeros(2, 4, 3)).shape == (2, 4)


def test_region_measures():
    region = Region(**REGION)
    assert region.volume == pytest.approx(3.0 * 0.8 * 2.2)
    assert region.plane() == Region((-0.5, 1.0), (2.5, 1.8))
    assert region.plane().volume == pytest.approx(2.4)
    assert (region.axes, region.plane().axes) == (3, 2)


def test_unit_cube_maps_onto_the_region():
    corners = Region(**REGION).from_unit(torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.5, 0.25, 0.75]]))
    torch.testing.assert_close(corners, torch.tensor([REGION["low"], REGION["high"], (1.0, 1.2, 1.85)]))


@pytest.mark.parametrize("axes", [2, 3])
def test_mean_over_the_grid_is_the_mean_over_the_region(axes):
    region = Region(REGION["low"][:axes], REGION["high"][:axes])
    grid = region.grid(4000)
    assert 0.8 * 4000 < len(grid) < 1.25 * 4000
    assert region.contains(grid).all()
    low, high = torch.tensor(region.low), torch.tensor(region.high)
    torch.testing.assert_close(grid.mean(0), (low + high) / 2)
    second = (high**3 - low**3) / (3 * (high - low))  # mean of x^2; the midpoint rule lacks cell^2 / 12
    cell = max(torch.unique(grid[:, a]).diff().max() for a in range(axes))
    torch.testing.assert_close((grid**2).mean(0), second, rtol=0, atol=float(cell**2 / 12) + 1e-12)


def test_grid_cells_are_nearly_cubes():
    ticks = [torch.unique(x) for x in Region((0.0, 0.0), (8.0, 2.0)).grid(400).unbind(-1)]
    assert [len(x) for x in ticks] == [40, 10]
    assert len(Region((0.0, 0.0), (100.0, 0.01)).grid(5)) >= 5  # a thin region keeps one cell across


def test_region_around_reaches_the_margin():
    region = Region.around(MicrophoneArray(POSITIONS), 0.5)
    assert region.low == pytest.approx((-1.2, -0.85, 0.45))
    assert region.high == pytest.approx((1.9, 1.1, 1.8))


BAD_POSITIONS = {
    "one microphone": ([[0.0, 1.0]], r"positions must have shape \(M, 2\) or \(M, 3\) with M >= 2, got \(1, 2\)"),
    "four axes": ([[0.0] * 4, [1.0] * 4], r"positions must have shape .*, got \(2, 4\)"),
    "flat": ([0.0, 1.0], r"positions must have shape .*, got \(2,\)"),
    "ragged": ([[0.0, 1.0], [1.0, 0.0, 2.0]], r"positions must be a list of \[x, y\] or \[x, y, z\] numbers"),
    "strings": ([["a", "b"], ["c", "d"]], "positions must be a list"),
    "nothing": (None, "positions must be a list"),
    "huge": ([[10**400, 0.0], [1.0, 1.0]], "positions must be a list"),
    "nan": ([[0.0, 1.0], [math.nan, 0.0]], "positions must be finite"),
    "inf": ([[0.0, 1.0], [math.inf, 0.0]], "positions must be finite"),
    "duplicates": ([[0.0, 1.0], [2.0, 0.0], [2.0, 0.0]], "microphones 2 and 3 have the same position"),
    "millimetres": ([[0.0, 1500.0], [400.0, 0.0]], "1500 m is beyond 100 m: positions are in metres .were they milli"),
    "millimetres of a small array": (
        [[32.0, 0.0], [0.0, 32.0], [-32.0, 0.0], [0.0, -32.0]],
        "within 10 m, the nearest are 45.2548 m apart: positions are in metres .were they milli",
    ),
}


def test_takes_arrays_in_a_hall():
    hall = MicrophoneArray([[0.0, 0.0], [9.5, 0.0], [40.0, 0.0]])
    torch.testing.assert_close(hall.positions, torch.tensor([[0.0, 0.0], [9.5, 0.0], [40.0, 0.0]]), check_dtype=False)


@pytest.mark.parametrize(("positions", "match"), BAD_POSITIONS.values(), ids=BAD_POSITIONS)
def test_rejects_positions(positions, match):
    with pytest.raises(InputError, match=f"^desk: .*{match}"):
        MicrophoneArray(positions, "desk")


BAD_FILES = {
    "not YAML": (b"positions: [[0, 1], [", "array file is not YAML"),
    "not text": (b"\xff\xfe\x00\x01", "array file is not YAML"),
    "a date that cannot be": (b"recorded: 2020-13-45", "array file is not YAML: month must be in 1..12"),
    "a list": (b"- 1\n- 2", "array file must be a YAML mapping, got list"),
    "empty": (b"", "array file must be a YAML mapping, got NoneType"),
    "without positions": (b"name: a", r"an array file needs 'positions: \[\[x, y, z\], ...\]' in metres"),
    "of words": (b"positions: [[left, right], [up, down]]", "positions must be a list"),
    "ragged": (b"positions: [[0, 1], [2]]", "positions must be a list"),
    "of one number": (b"positions: 5", r"positions must have shape .*, got \(\)"),
}


@pytest.mark.parametrize(("content", "match"), BAD_FILES.values(), ids=BAD_FILES)
def test_rejects_array_file(tmp_path, content, match):
    (tmp_path / "a.yaml").write_bytes(content)
    with pytest.raises(InputError, match=f"a.yaml: .*{match}") as caught:
        MicrophoneArray.from_yaml(tmp_path / "a.yaml")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("name", "match"), [("none.yaml", "No such file"), ("", "Is a directory")])
def test_rejects_array_file_that_cannot_be_read(tmp_path, name, match):
    with pytest.raises(InputError, match=f"cannot read array file: {match}"):
        MicrophoneArray.from_yaml(tmp_path / name)


@pytest.mark.parametrize(
    ("low", "high", "match"),
    [
        ((0.0, 0.0), (1.0, 0.0), "low must be below high on axis y, got 0.0 and 0.0"),
        ((2.0, 0.0), (1.0, 3.0), "low must be below high on axis x"),
        ((0.0, 0.0, 1.0), (1.0, 3.0, math.inf), "low must be below high on axis z"),
        ((0.0, math.nan), (1.0, 3.0), "low must be below high on axis y"),
        ((0.0, 0.0), (1.0, 3.0, 2.0), "low and high need 2 or 3 values each"),
        ((0.0,), (1.0,), "low and high need 2 or 3 values each"),
    ],
)
def test_rejects_region(low, high, match):
    with pytest.raises(InputError, match=f"region: {match}"):
        Region(low, high)


@pytest.mark.parametrize(
    ("region", "match"),
    [
        ("{low: [0, 0]}", "'high'"),
        ("{low: [0, 0], high: [1, wide]}", "could not convert string"),
        ("{low: '00', high: '34'}", "'00' is not a list"),
        ("{low: [0, 0], high: [1, -1]}", "low must be below high on axis y"),
        ("3 m", "string indices"),
    ],
)
def test_rejects_region_in_a_file(tmp_path, region, match):
    (tmp_path / "a.yaml").write_text(f"positions: [[0, 0], [1, 1]]\nregion: {region}")
    with pytest.raises(InputError, match=rf"a.yaml: region must be \{{low: \[x, y, z\], .*{match}"):
        Region.from_yaml(tmp_path / "a.yaml")


def test_rejects_what_does_not_fit_an_array_or_a_region():
    array, region = MicrophoneArray(POSITIONS, "five"), Region(**REGION)
    with pytest.raises(ShapeError, match=r"points must have shape \(\.\.\., 3\), got \(4, 2\)"):
        array.delays(torch.zeros(4, 2))
    with pytest.raises(ShapeError, match=r"points must have shape \(\.\.\., 3\), got \(4, 2\)"):
        region.contains(torch.zeros(4, 2))
    with pytest.raises(InputError, match="five: no microphone 6: there are 5"):
        array.select([0, 5])
    with pytest.raises(InputError, match="num_points must be an integer of at least 1, got 0"):
        region.grid(0)
