"""Talkers of files and of tracks: one type for what is true and what is said."""

import math
from pathlib import Path

import pytest
import torch
from talkers import at, off

from probtrack.errors import InputError
from probtrack.metrics import MeanSpread, RootMeanSquareError, Talkers
from probtrack.track_files import TrackTable

NAN = math.nan


def table(**columns):
    return TrackTable(
        Path("t.csv"), {key: torch.as_tensor(value, dtype=torch.float64) for key, value in columns.items()}
    )


TIME = torch.tensor([0.0, 0.25, 1.0, 1.5])


def test_tables_become_talkers_at_the_times_asked_for():
    one = table(time=[0.0, 1.0], x=[0.0, 4.0], y=[1.0, 1.0])
    other = table(time=[0.25, 0.75, 1.5], x=[7.0, 8.0, 8.0], y=[0.0, 2.0, 2.0])
    talkers = Talkers.of_tables([one, other], TIME)
    assert (talkers.num_frames, talkers.num_talkers, talkers.batch) == (4, 2, ())
    torch.testing.assert_close(talkers.position[1], torch.tensor([[1.0, 1.0], [7.0, 0.0]]))
    torch.testing.assert_close(talkers.position[2], torch.tensor([[4.0, 1.0], [8.0, 2.0]]))
    assert talkers.position.isnan().any(-1).tolist() == [[False, True], [False, False], [False, False], [True, False]]


def test_angles_are_interpolated_the_short_way_round():
    talkers = Talkers.of_tables([table(time=[0.0, 1.0], azimuth=[3.1, -3.1], heading=[-0.2, 0.2])], torch.tensor([0.5]))
    torch.testing.assert_close(talkers.azimuth.abs(), torch.tensor([[math.pi]]))
    torch.testing.assert_close(talkers.heading, torch.tensor([[0.0]]))


def test_what_not_all_tables_have_is_left_out():
    full = table(time=[0.0, 1.0], x=[0.0, 4.0], y=[1.0, 1.0], z=[1.5, 1.5], azimuth=[0.1, 0.1], speech=[1.0, 0.0])
    flat = table(time=[0.0, 1.0], x=[0.0, 4.0], y=[1.0, 1.0], speech=[0.0, 0.0])
    talkers = Talkers.of_tables([full, flat], TIME[:3])
    assert talkers.position.shape == (3, 2, 2)
    assert talkers.azimuth is talkers.heading is talkers.covariance is None
    torch.testing.assert_close(talkers.speech, torch.tensor([[1.0, 0.0], [0.75, 0.0], [0.0, 0.0]]))
    assert Talkers.of_tables([full, table(time=[0.0], azimuth=[0.3])], TIME).position is None
    assert Talkers.of_tables([full], TIME).position.shape == (4, 1, 3)


def test_spreads_of_axes_become_a_diagonal_covariance():
    said = table(time=[0.0, 1.0], x=[0.0, 4.0], y=[1.0, 1.0], std_x=[0.2, 0.2], std_y=[0.5, 0.3])
    covariance = Talkers.of_tables([said], TIME[:3]).covariance
    torch.testing.assert_close(covariance[2, 0], torch.diag(torch.tensor([0.04, 0.09])))


def test_frames_between_two_times_take_the_first_and_leave_the_last():
    talkers = at([[[0.0, 1.0]]] * 5, azimuth=[[0.0], [1.0], [2.0], [3.0], [4.0]], dt=0.5).between(0.5, 1.5)
    assert talkers.time.tolist() == [0.5, 1.0]
    assert talkers.azimuth.flatten().tolist() == [1, 2]
    assert (talkers.position.shape, talkers.heading) == ((2, 1, 2), None)


def test_axes_of_the_batch_are_told_from_those_of_each_column():
    covariance, azimuth = torch.zeros(4, 5, 3, 2, 2, dtype=torch.float32), torch.zeros(4, 5, 3)
    for columns in ({"covariance": covariance}, {"azimuth": azimuth}, {"covariance": covariance, "azimuth": azimuth}):
        talkers = Talkers(TIME, **columns)
        assert (talkers.batch, talkers.num_talkers) == ((5,), 3)
    wide = Talkers(TIME, covariance=covariance, azimuth=azimuth).as_double(3)
    assert (wide.covariance.shape, wide.azimuth.shape) == ((4, 1, 1, 5, 3, 2, 2), (4, 1, 1, 5, 3))
    assert wide.covariance.dtype == torch.float64


def test_times_alone_are_no_talkers():
    talkers = Talkers(TIME)
    assert (talkers.num_talkers, talkers.batch, talkers.num_frames) == (0, (), 4)
    assert talkers.dt == 0.5  # the lower of the two in the middle
    assert math.isnan(Talkers(TIME[:1]).dt)


def test_a_frame_is_known_where_a_table_covers_it_even_without_a_position():
    one = table(time=[0.0, 0.5, 0.75, 3.0], x=[0.0, NAN, 4.0, 4.0], y=[1.0, NAN, 1.0, 1.0])
    other = table(time=[2.5, 4.0, 4.5], x=[0.0, 1.0, 1.0], y=[0.0, 0.0, 0.0])
    time = torch.tensor([-0.1, 0.0, 0.25, 0.5, 1.5, 2.4, 2.5, 3.0, 3.5, 4.25, 4.6])
    # outside both, within rows, in gaps longer than 1 s, at rows, and within the other
    known = [False, True, True, True, False, False, True, True, False, True, False]
    talkers = Talkers.of_tables([one, other], time)
    assert talkers.known.tolist() == known
    assert talkers.position[3].isnan().all()
    assert talkers.between(2.5, 4.0).known.tolist() == [True, True, False]


def test_what_is_known_gets_axes_of_a_batch_like_other_columns():
    known = torch.tensor([True, False, True, True])
    talkers = Talkers(TIME, azimuth=torch.zeros(4, 5, 3), known=known).as_double(2)
    assert (talkers.known.shape, talkers.known.dtype, talkers.azimuth.shape) == ((4, 1, 1), torch.bool, (4, 1, 5, 3))
    assert (Talkers(TIME, known=known).batch, Talkers(TIME, known=known).num_talkers) == ((), 0)
    assert Talkers(TIME).as_double(2).known is None


@pytest.mark.parametrize("late", [-0.016, 3e-6, 0.1, NAN])
def test_an_estimate_at_other_times_than_the_truth_is_refused(late):
    truth, estimate = off([0.1] * 8)
    moved = estimate._replace(time=estimate.time + torch.tensor([0.0] * 5 + [late] * 3))
    with pytest.raises(InputError, match=r"must be at the times of the truth, got \S+ s for 0\.5 s at frame 5"):
        RootMeanSquareError().parts(moved, truth)
    assert MeanSpread().needs == ()
    spread = torch.eye(2).expand(8, 1, 2, 2)
    assert MeanSpread().parts(moved._replace(covariance=spread), truth).count == 8  # needs no truth


def test_times_of_files_and_of_single_precision_are_the_same():
    estimate, truth = off([0.1] * 800)
    rounded = ((truth.time * 7 / 3 * 1e6).round() / 1e6, (truth.time * 7 / 3).float())
    for time in rounded:
        parts = RootMeanSquareError().parts(estimate._replace(time=time), truth._replace(time=truth.time * 7 / 3))
        torch.testing.assert_close(parts.total, torch.tensor(0.1))
