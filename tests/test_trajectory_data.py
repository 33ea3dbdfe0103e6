"""Trajectories: read with checks, laid side by side with gaps and time steps of their own, drawn and walked."""

import math
from types import SimpleNamespace

import pytest
import torch

from probtrack.dynamics import lehmann2007
from probtrack.errors import InputError
from probtrack.simulation.trajectories import SocialForceWalk
from probtrack.training import (
    SampledTrajectories,
    Trajectory,
    TrajectoryDataModule,
    TrajectoryDataset,
    WalkedTrajectories,
    check_trajectory,
    collate_trajectories,
    read_trajectories,
)


def path(time, x, name="path"):
    """One along x; None is a gap."""
    x = torch.tensor([math.nan if one is None else one for one in x])
    return Trajectory(name, name, torch.tensor(time), torch.stack([x, -2 * x], -1))


def batch(*trajectories, longest_step=None):
    data = TrajectoryDataset(trajectories, longest_step)
    return collate_trajectories([data[n] for n in range(len(data))])


def file(folder, text, name="walk.csv"):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text)
    return folder / name


def test_rows_become_frames_after_the_first_position():
    made = batch(path([0.0, 0.1, 0.4], [1.0, 2.0, 4.0]))
    assert made.first.tolist() == [[1.0, -2.0]]
    assert made.position[:, 0].tolist() == [[2.0, -4.0], [4.0, -8.0]]
    torch.testing.assert_close(made.dt[:, 0], torch.tensor([0.1, 0.3]))
    assert made.observed.all()
    assert made.inside.all()


def test_gaps_are_frames_without_a_measurement():
    made = batch(path([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [None, 1.0, None, 2.0, 3.0, None, None]))
    assert made.observed[:, 0].tolist() == [False, True, True]  # what is before and after says nothing
    assert made.position[0, 0].tolist() == [0.0, 0.0]
    assert made.time_step() == pytest.approx(0.1)


def test_a_position_of_which_an_axis_is_missing_is_a_gap():
    half = path([0.0, 0.1, 0.2], [1.0, 2.0, 3.0])
    half.position[1, 1] = torch.nan
    assert batch(half).observed[:, 0].tolist() == [False, True]


def test_shorter_trajectories_are_padded():
    made = batch(path([0.0, 0.5], [1.0, 2.0]), path([0.0, 0.2, 0.4, 0.6], [0.0, 1.0, 2.0, 3.0]))
    assert made.inside.T.tolist() == [[True, False, False], [True, True, True]]
    assert made.observed.T.tolist() == [[True, False, False], [True, True, True]]
    assert (made.dt > 0).all()
    assert made.position.isfinite().all()
    assert made.numbers == (0, 1)


def test_times_that_files_round_are_one_time_step():
    time = [round(n / 30, 6) for n in range(40) if n not in (7, 8, 20)]
    made = batch(path(time, [0.01 * n for n in range(len(time))]))
    steps = made.dt[:, 0].unique()
    assert len(steps) == 3  # one frame, two, and three
    torch.testing.assert_close(steps, steps[0] * torch.tensor([1.0, 2.0, 3.0]), rtol=1e-12, atol=0)
    torch.testing.assert_close(steps[0], torch.tensor(1 / 30), rtol=1e-6, atol=0)


def test_times_that_really_differ_are_kept():
    time = torch.rand(30).cumsum(0)
    made = batch(path(time.tolist(), [0.01 * n for n in range(30)]))
    torch.testing.assert_close(made.dt[:, 0], time.diff(), rtol=0, atol=1e-5)
    assert isinstance(made.time_step(), torch.Tensor)


def test_long_steps_are_taken_in_equal_parts():
    made = batch(path([0.0, 0.1, 0.45, 0.55, 0.75], [0.0, 1.0, 2.0, 3.0, 4.0]), longest_step=0.1)
    torch.testing.assert_close(made.dt[:, 0], torch.tensor([0.1, *[0.35 / 4] * 4, 0.1, 0.1, 0.1]))
    assert made.observed[:, 0].tolist() == [True, False, False, False, True, True, False, True]
    assert made.position[4, 0, 0] == 2.0


def test_batches_have_the_default_precision():
    torch.set_default_dtype(torch.float32)
    one = Trajectory("a", "a", torch.arange(3, dtype=torch.float64), torch.zeros(3, 2, dtype=torch.float64))
    made = batch(one)
    assert made.position.dtype == made.dt.dtype == made.first.dtype == torch.float32


FAULTY = {
    "one point": ([0.0], [1.0], r"^path: must have at least 2 measured positions, got 1$"),
    "gaps only": ([0.0, 1.0, 2.0], [1.0, None, None], r"^path: must have at least 2 measured positions, got 1$"),
    "back": ([0.0, 0.2, 0.1], [1.0, 1.0, 1.0], r"^path, row 3: times must increase, got 0.1 s after 0.2 s$"),
    "twice": ([0.0, 0.2, 0.2], [1.0, 1.0, 1.0], r"^path, row 3: times must increase, got 0.2 s after 0.2 s$"),
    "no time": ([0.0, math.nan, 0.2], [1.0, 1.0, 1.0], r"^path, row 2: times must increase"),
    "infinite": ([0.0, 0.1, 0.2], [1.0, math.inf, 1.0], r"^path, row 2: a position must be finite, or empty"),
}


@pytest.mark.parametrize(("time", "x", "fault"), FAULTY.values(), ids=FAULTY)
def test_faulty_trajectories_are_named_with_their_row(time, x, fault):
    with pytest.raises(InputError, match=fault):
        TrajectoryDataset([path(time, x)])


def test_a_jump_is_named_with_its_row_and_the_limit():
    jump = path([0.0, 0.1, 0.2, 0.3], [0.0, 0.1, None, 1.1])
    speed = math.sqrt(5) / 0.2
    with pytest.raises(InputError, match=r"^path, row 4: a jump, 11.2 m/s from 0.1 s to 0.3 s is above max_speed = 11"):
        check_trajectory(jump, 11.0)
    check_trajectory(jump, speed + 1e-6)


def test_tables_are_read_with_empty_cells_and_nan_as_gaps(tmp_path):
    (one,) = read_trajectories(file(tmp_path, "time,x,y,z\n0,1,2,3\n0.1,,2,3\n0.2,nan,nan,3\n0.5,1.5,2,3\n"))
    assert one.position.isfinite().all(-1).tolist() == [True, False, False, True]
    assert one.position.shape == (4, 2)
    assert one.time.tolist() == [0.0, 0.1, 0.2, 0.5]


def test_height_is_read_where_three_axes_are_wanted(tmp_path):
    (one,) = read_trajectories(str(file(tmp_path, "time,x,y,z\n0,1,2,3\n1,1,2,4\n")), axes=3)
    assert one.position.tolist() == [[1, 2, 3], [1, 2, 4]]


def test_every_track_of_a_file_is_a_trajectory_of_one_group(tmp_path):
    table = file(tmp_path, "time,track,x,y\n0,1,0,0\n0,2,5,5\n1,1,1,0\n1,2,5,6\n")
    one, two = read_trajectories([table])
    assert (one.name, two.name) == (f"{table}, track 1", f"{table}, track 2")
    assert one.group == two.group == str(table)
    assert two.position.tolist() == [[5, 5], [5, 6]]


TWO_ROWS = "time,x,y\n0,1,2\n1,1,2\n"


def names(folder):
    return [one.name.removeprefix(f"{folder}/") for one in read_trajectories(folder)]


def test_folders_stand_for_their_tables(tmp_path):
    for name in ("b.csv", "a.csv"):
        file(tmp_path / "tables", TWO_ROWS, name)
    file(tmp_path / "tables", "", "notes.txt")
    assert names(tmp_path / "tables") == ["a.csv", "b.csv"]


def test_folders_of_scenes_stand_for_their_truth(tmp_path):
    for name in ("0", "1"):
        file(tmp_path / "scenes" / name, TWO_ROWS, "truth.csv")
        file(tmp_path / "scenes" / name, "time,f0\n", "scores.csv")
    assert names(tmp_path / "scenes" / "1") == ["truth.csv"]
    assert names(tmp_path / "scenes") == ["0/truth.csv", "1/truth.csv"]


def test_scenes_of_a_data_set_count_once(tmp_path):
    rows = [f"{scene}_{snr},{scene},0,1,{snr},1,8.0" for scene in (0, 1) for snr in (5, 20)]
    header = "folder,scene,template,seed,snr_db,num_talkers,duration"
    file(tmp_path / "set", "\n".join([header, *rows]), "manifest.csv")
    for row in rows:
        file(tmp_path / "set" / row.split(",")[0], TWO_ROWS, "truth.csv")
    assert names(tmp_path / "set") == ["0_5/truth.csv", "1_5/truth.csv"]


BAD = {
    "no place": ("time,azimuth\n0,1\n1,1\n", {}, r"walk.csv: a trajectory needs columns x and y, got time, azimuth"),
    "no height": (TWO_ROWS, {"axes": 3}, r"walk.csv: a trajectory needs columns x, y and z, got time, x, y"),
    "no time": ("x,y\n0,1\n", {}, r"walk.csv: a track file needs a column 'time'"),
    "unsorted": ("time,x,y\n0,1,2\n2,1,2\n1,1,2\n", {}, r"walk.csv: times .* got 1 s after 2 s in row 3"),
    "jump": ("time,x,y\n0,1,2\n1,1,2\n2,20,2\n", {}, r"walk.csv, row 3: a jump, 19 m/s from 1 s to 2 s .* 12.5 m/s"),
    "infinite": ("time,x,y\n0,1,2\n1,inf,2\n", {}, r"walk.csv, row 2: a position must be finite"),
    "axes": (TWO_ROWS, {"axes": 4}, r"axes must be 2 or 3, got 4"),
    "limit": (TWO_ROWS, {"max_speed": 0.0}, r"max_speed must be finite and positive"),
}


@pytest.mark.parametrize(("text", "settings", "fault"), BAD.values(), ids=BAD)
def test_faulty_tables_are_named(tmp_path, text, settings, fault):
    with pytest.raises(InputError, match=fault) as caught:
        read_trajectories(file(tmp_path, text), **settings)
    assert "\n" not in str(caught.value)


def test_an_empty_folder_and_no_file_are_named(tmp_path):
    with pytest.raises(InputError, match="holds no table of trajectories"):
        read_trajectories(tmp_path)
    with pytest.raises(InputError, match="no file was given"):
        read_trajectories([])


def test_sampled_trajectories_are_walks_of_the_model_seen_with_error():
    model = lehmann2007("CU-LAN", 3)
    source = SampledTrajectories(model, count=4000, frames=2, dt=0.5, error=0.3, speed=1.5, seed=4)
    y = torch.stack([one.position for one in source.trajectories()])
    F, G = (x.detach() for x in model.matrices(0.5))
    covariance = torch.diag(torch.tensor([0.0] * 3 + [1.5**2] * 3))
    for t in range(3):
        expected = covariance[0, 0] + 0.3**2
        z = (y[:, t, 1].square().mean() / expected - 1) / (2 / 4000) ** 0.5
        assert abs(z) < 5
        covariance = F @ covariance @ F.mT + G @ G.mT
    again = torch.stack([one.position for one in source.trajectories()])
    assert torch.equal(y, again)
    assert source.trajectories()[0].time.tolist() == [0.0, 0.5, 1.0]


def test_walked_trajectories_are_those_of_the_simulator():
    walk, settings = SocialForceWalk(), {"count": 3, "duration": 2.0, "rate": 10.0}
    exact = WalkedTrajectories(walk, error=0.0, axes=3, **settings).trajectories()
    noisy = WalkedTrajectories(walk, error=0.05, **settings).trajectories()
    assert [one.position.shape for one in exact] == [(20, 3)] * 3
    error = torch.stack([a.position - b.position[:, :2] for a, b in zip(noisy, exact, strict=True)])
    assert 0.6 < error.std() / 0.05 < 1.4
    assert (exact[0].position[0] - exact[1].position[0]).norm() > 0.01
    for one in noisy:
        check_trajectory(one)


def test_a_run_that_goes_on_begins_with_the_order_of_its_epoch():
    data = TrajectoryDataModule(SampledTrajectories(lehmann2007("CU-LAN"), count=7, frames=5), batch_size=2)
    first, later = data.train_dataloader().sampler, data.train_dataloader().sampler
    later.set_epoch(3)
    orders = list(first), list(later)
    assert orders[0] != orders[1]
    progress = SimpleNamespace(current=SimpleNamespace(processed=3))
    data.trainer = SimpleNamespace(fit_loop=SimpleNamespace(epoch_progress=progress))
    assert list(data.train_dataloader().sampler) == orders[1]
