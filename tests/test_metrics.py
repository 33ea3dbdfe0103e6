"""Figures of S1 eq. 6 to 8 and the score of one file against another, on cases worked out by hand."""

import math
from pathlib import Path

import pytest
import torch

from probtrack.errors import InputError
from probtrack.metrics import azimuth_error, final_error, position_error, root_mean_square, score, track_lost
from probtrack.track_files import TrackTable


def table(name="t.csv", **columns):
    return TrackTable(Path(name), {key: torch.as_tensor(value, dtype=torch.float64) for key, value in columns.items()})


def line(count=21, dt=0.1, **more):
    """Truth that walks 1 m/s in x and 0.5 m/s down in y."""
    time = torch.arange(count) * dt
    return table("truth.csv", time=time, x=time + 0.3, y=2 - time / 2, **more)


def test_position_error_is_the_distance():
    estimate, truth = torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.0, 1.0]]), torch.tensor([3.0, -4.0, 6.0])
    torch.testing.assert_close(position_error(estimate, truth), torch.tensor([7.0, (9 + 16 + 25) ** 0.5]))


def test_root_mean_square_is_over_frames_for_each_run():
    error = torch.tensor([[1.0, 3.0], [2.0, 0.0], [2.0, 0.0]])
    torch.testing.assert_close(root_mean_square(error), torch.tensor([3.0, 3.0]).sqrt())


@pytest.mark.parametrize(
    ("dt", "frames"),
    [(0.1, 5), (0.032, 16), (0.016, 32), (0.25, 2), (0.5, 1), (0.7, 1), (1 / 30, 15), (0.05, 10), (0.5 / 49, 49)],
)
def test_final_error_is_the_mean_of_the_last_half_second(dt, frames):
    error = torch.arange(1.0, 101) ** 2
    torch.testing.assert_close(final_error(error, dt), error[100 - frames :].mean())


def test_final_error_of_each_run():
    error = torch.tensor([[9.0, 9.0], [1.0, 4.0], [2.0, 0.0]])
    torch.testing.assert_close(final_error(error, 0.25), torch.tensor([1.5, 2.0]))
    torch.testing.assert_close(final_error(error, 0.25, window=0.75), torch.tensor([4.0, 13 / 3]))


@pytest.mark.parametrize(("last", "lost"), [(0.0, False), (0.24, False), (0.26, True)])
def test_track_is_lost_beyond_a_tenth_of_a_metre_at_the_end(last, lost):
    error = torch.tensor([7.0, 0.02, 0.14, 0.06, 0.04, last])  # 0.26 + last over the last five of 0.1 s
    assert bool(track_lost(error, 0.1)) is lost


def test_an_error_at_the_threshold_is_not_lost():
    assert not track_lost(torch.full((5,), 0.125), 0.1, threshold=0.125)
    assert track_lost(torch.full((5,), 0.125), 0.1, threshold=0.124)


def test_track_loss_percentage_is_the_mean_over_runs():
    error = torch.tensor([0.05, 0.2, 0.02, 3.0, 0.09]).expand(5, 5)
    assert track_lost(error, 0.1).double().mean() == 0.4


def test_track_shorter_than_the_window_has_no_final_error():
    with pytest.raises(InputError, match=r"the last 5 frames \(0\.5 s\), got 4"):
        final_error(torch.ones(4), 0.1)


@pytest.mark.parametrize("bad", [0.0, -0.1, math.nan])
def test_rejects_a_time_that_is_none(bad):
    with pytest.raises(InputError, match="dt must be finite and positive"):
        final_error(torch.ones(9), bad)
    with pytest.raises(InputError, match="window must be finite and positive"):
        final_error(torch.ones(9), 0.1, window=bad)


@pytest.mark.parametrize(
    ("estimate", "truth", "error"),
    [
        (3.1, -3.1, 2 * math.pi - 6.2),
        (-3.1, 3.1, 2 * math.pi - 6.2),
        (0.2, 0.5, 0.3),
        (math.pi, 0, math.pi),
        (7, 0.5, 6.5 - 2 * math.pi),
        (math.nan, 0.5, math.nan),
        (0.5, math.nan, math.nan),
    ],
)
def test_azimuth_error_goes_the_short_way_round(estimate, truth, error):
    torch.testing.assert_close(
        azimuth_error(torch.tensor(float(estimate)), torch.tensor(float(truth))), torch.tensor(error), equal_nan=True
    )


def test_score_of_a_shifted_track():
    truth = line()
    figures = score(truth, table(time=truth.time, x=truth.get("x") + 0.03, y=truth.get("y") - 0.04))
    assert (figures.frames, figures.missing, figures.lost) == (21, 0, False)
    assert figures.rmse == pytest.approx(0.05)
    assert figures.final_error == pytest.approx(0.05)
    assert figures.azimuth_rmse is figures.azimuth_median is figures.azimuth_max is None


def test_score_weighs_squares_and_looks_at_the_end():
    truth, off = line(), torch.zeros(21)
    off[3], off[-3] = 2.1, 0.6
    figures = score(truth, table(time=truth.time, x=truth.get("x"), y=truth.get("y") + off))
    assert figures.rmse == pytest.approx(((2.1**2 + 0.6**2) / 21) ** 0.5)
    assert figures.final_error == pytest.approx(0.6 / 5)
    assert figures.lost is True
    assert figures.as_dict()["lost"] is True


def test_truth_is_interpolated_between_its_rows():
    truth, time = line(), torch.tensor([0.0, 0.04, 0.33, 1.27, 1.999, 2.0])
    figures = score(truth, table(time=time, x=time + 0.3, y=2 - time / 2))
    assert (figures.frames, figures.missing) == (6, 0)
    assert figures.rmse < 1e-12


def test_frames_outside_the_truth_do_not_count():
    truth, time = line(), torch.arange(-5, 31) * 0.1
    figures = score(truth, table(time=time, x=time + 0.3 + 10 * ((time < -1e-9) | (time > 2 + 1e-9)), y=2 - time / 2))
    assert figures.frames == 21
    assert figures.rmse < 1e-12


def test_times_that_differ_by_their_rounding_still_meet():
    truth = line()
    figures = score(truth, table(time=truth.time - 1e-6, x=truth.get("x"), y=truth.get("y")))
    assert figures.frames == 21
    assert figures.rmse < 2e-6


def test_truth_is_not_interpolated_over_more_than_a_second():
    truth = table("truth.csv", time=[0.0, 0.5, 2.0, 3.0], x=[0.0, 0.5, 2.0, 3.0], y=[1.0, 1.0, 1.0, 1.0])
    time = torch.tensor([0.2, 0.5, 0.9, 1.9, 2.0, 2.6])
    figures = score(truth, table(time=time, x=time + torch.tensor([0, 0, 9.0, 9.0, 0, 0]), y=torch.ones(6)))
    assert figures.frames == 4  # 0.2, 0.5, 2.0 and 2.6 s: a row at the very time counts, whatever lies beside it
    assert figures.rmse < 1e-12


def test_rows_of_the_truth_that_are_empty_leave_their_neighbours():
    truth = line(5)
    truth.columns["x"][2] = math.nan
    figures = score(truth, table(time=truth.time, x=truth.time + 0.3, y=2 - truth.time / 2))
    assert (figures.frames, figures.missing) == (4, 0)


def test_missing_estimates_are_counted_and_enter_no_error():
    truth = line()
    x = truth.get("x").clone()
    x[[2, 7, 8]] = math.nan
    figures = score(truth, table(time=truth.time, x=x, y=truth.get("y")))
    assert (figures.frames, figures.missing) == (21, 3)
    assert figures.rmse < 1e-12


def test_missing_positions_count_though_azimuths_are_there():
    truth = line(azimuth=torch.zeros(21))
    x = truth.get("x").clone()
    x[[2, 7, 8]] = math.nan
    figures = score(truth, table(time=truth.time, x=x, y=truth.get("y"), azimuth=torch.full((21,), 0.1)))
    assert (figures.frames, figures.missing) == (21, 3)
    assert figures.azimuth_rmse == pytest.approx(0.1)


def test_an_empty_azimuth_column_does_not_hide_the_positions():
    truth = line(azimuth=torch.full((21,), math.nan))
    figures = score(truth, table(time=truth.time, x=truth.get("x"), y=truth.get("y"), azimuth=torch.zeros(21)))
    assert figures.rmse < 1e-12
    assert figures.azimuth_rmse is None


def test_height_counts_where_both_have_it():
    high, flat = line(z=torch.full((21,), 1.5)), line()
    estimate = table(time=flat.time, x=flat.get("x"), y=flat.get("y"), z=torch.full((21,), 1.2))
    assert score(high, estimate).rmse == pytest.approx(0.3)
    assert score(flat, estimate).rmse < 1e-12
    assert score(estimate, flat).rmse < 1e-12


def test_azimuth_files_have_azimuth_figures_alone():
    truth = table("truth.csv", time=[0.0, 0.1, 0.2, 0.3], azimuth=[3.0, 3.1, -3.1, -3.0])
    figures = score(truth, table(time=[0.0, 0.1, 0.2, 0.3], azimuth=[3.1, 3.1, 3.1, -2.6]))
    error = [0.1, 0.0, 2 * math.pi - 6.2, 0.4]
    assert (figures.frames, figures.rmse, figures.lost) == (4, None, None)
    assert figures.azimuth_rmse == pytest.approx((sum(e**2 for e in error) / 4) ** 0.5)
    assert figures.azimuth_median == pytest.approx((0.1 + error[2]) / 2)
    assert figures.azimuth_max == pytest.approx(0.4)


def test_azimuth_is_interpolated_the_short_way_round():
    truth = table("truth.csv", time=[0.0, 1.0], azimuth=[math.pi - 0.1, -math.pi + 0.3])
    assert score(truth, table(time=[0.5], azimuth=[-math.pi + 0.1])).azimuth_max < 1e-9


@pytest.mark.parametrize(("dt", "frames"), [(0.1, 5), (1 / 30, 15), (0.016, 32), (1 / 7, 4)])
def test_half_a_second_is_counted_in_frames_whose_times_were_rounded(dt, frames):
    truth = line(60, dt)
    time = (truth.time * 1e6).round() / 1e6
    off = torch.zeros(60)
    off[-frames:] = 0.7
    off[-frames - 1] = 100.0
    figures = score(
        table(time=time, x=truth.get("x"), y=truth.get("y")), table(time=time, x=truth.get("x") + off, y=truth.get("y"))
    )
    assert figures.final_error == pytest.approx(0.7)


@pytest.mark.parametrize(("count", "known"), [(4, False), (5, True)])
def test_final_error_needs_half_a_second(count, known):
    truth = line(count)
    assert (score(truth, truth).final_error is not None) is known


def test_one_row_can_be_scored():
    figures = score(table(time=[1.0], x=[1.0], y=[2.0]), table(time=[1.0], x=[1.0], y=[2.5]))
    assert (figures.frames, figures.rmse, figures.final_error) == (1, 0.5, None)


def test_files_of_different_times_are_an_error():
    truth = line()
    with pytest.raises(
        InputError, match=r"t\.csv: no frame has an estimate at a time that the truth truth\.csv covers"
    ):
        score(truth, table(time=truth.time + 50, x=truth.get("x"), y=truth.get("y")))


def test_files_of_different_things_are_an_error():
    truth = line()
    with pytest.raises(InputError, match=r"truth\.csv and t\.csv share neither positions \(x, y\) nor azimuths"):
        score(truth, table(time=truth.time, azimuth=truth.time))
