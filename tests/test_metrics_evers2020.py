"""Detections, false alarms, latency, breaks and swaps of two talkers, frame by frame by hand."""

import math
from pathlib import Path

import pytest
import torch
from talkers import at

from probtrack.errors import InputError
from probtrack.metrics import (
    DetectionRate,
    FalseAlarmRate,
    FragmentationRate,
    Latency,
    OptimalSubPatternAssignment,
    SwapRate,
    Talkers,
    associate,
    fragments,
    latencies,
    swaps,
)
from probtrack.track_files import TrackTable

NAN = math.nan


def line(*tracks):
    """Tracks on a line, one list of x each: A at x = 0 and B at x = 4 are the talkers of these tests, _ is NaN."""
    x = torch.tensor(tracks).T
    return at(torch.stack([x, torch.zeros_like(x)], -1))


def talkers(a, b):
    """Talkers A and B where they talk ("x"), are silent (".") or are away (" ")."""
    x = torch.tensor([[0.0, 4.0]] * len(a))
    x[torch.tensor([[p == " ", q == " "] for p, q in zip(a, b, strict=True)])] = NAN
    speech = torch.tensor([[float(p == "x"), float(q == "x")] for p, q in zip(a, b, strict=True)])
    return at(torch.stack([x, torch.zeros_like(x)], -1), speech=speech)


def value(metric, estimate, truth):
    metric.update(estimate, truth)
    return float(metric.compute())


def tracks(text):
    """Which track a talker has: a digit, or "." for none; and active throughout."""
    track = torch.tensor([[-1 if c == "." else int(c)] for c in text])
    return track, torch.ones_like(track, dtype=torch.bool)


def test_pairs_are_made_within_the_gate():
    distance = torch.tensor([[0.4, 0.1, 9.0], [0.3, 0.2, 9.0]])
    both = torch.tensor([True, True])
    assert associate(distance, 0.5, both).tolist() == [1, 0]  # 0.1 + 0.3 rather than 0.4 + 0.2
    assert associate(distance, 0.25, both).tolist() == [-1, 1] or associate(distance, 0.25, both).tolist() == [1, -1]
    assert associate(distance, 0.05, both).tolist() == [-1, -1]


def test_as_many_pairs_as_there_can_be_come_before_short_ones():
    distance = torch.tensor([[0.01, 0.45], [0.49, 9.0]])
    assert associate(distance, 0.5, torch.tensor([True, True])).tolist() == [1, 0]


def test_an_active_talker_comes_before_a_silent_one():
    distance = torch.tensor([[0.01], [0.49]])
    assert associate(distance, 0.5, torch.tensor([False, True])).tolist() == [-1, 0]
    assert associate(distance, 0.5, torch.tensor([True, True])).tolist() == [0, -1]


def test_a_distance_at_the_gate_is_within_it():
    assert associate(torch.tensor([[0.5]]), 0.5, torch.tensor([True])) == 0


def test_detection_rate_is_the_share_of_active_frames_with_a_track():
    truth = talkers("xxx. ", "xxxxx")
    estimate = line([0.1, 0.6, 0.1, 0.1, 0.1], [4.2, NAN, 3.7, 4.0, 9.0])
    assert value(DetectionRate(), estimate, truth) == pytest.approx((2 + 3) / 8)
    assert value(DetectionRate(gate=0.15), estimate, truth) == pytest.approx((2 + 1) / 8)


def test_a_truth_that_does_not_say_who_talks_counts_whoever_is_there():
    truth = talkers("xx. ", "x..x")._replace(speech=None)
    assert value(DetectionRate(), line([0.0, 0.0, 0.0, 0.0]), truth) == pytest.approx(3 / 7)


def test_false_alarms_are_tracks_of_nobody_per_second():
    truth = talkers("xx. ", "    ")
    estimate = line([0.1, 0.1, 0.1, 0.1], [4.0, NAN, 9.0, NAN], [0.2, NAN, NAN, NAN])
    # of 0.4 s: two at first (a second track near A is one), one far away while A is silent, one when A has gone
    assert value(FalseAlarmRate(), estimate, truth) == pytest.approx((2 + 0 + 1 + 1) / 0.4)


def test_false_alarms_are_counted_where_it_is_known_who_is_there():
    truth = talkers("xx    ", "      ")._replace(known=torch.tensor([True] * 3 + [False] * 3))
    estimate = line([0.1] * 6, [9.0] * 6)
    # one in each of the first two frames, two in the third, and of the rest nobody knows
    assert value(FalseAlarmRate(), estimate, truth) == pytest.approx(4 / 0.3)
    of_runs = truth._replace(
        position=truth.position[:, None], speech=truth.speech[:, None],
        known=torch.stack([truth.known, ~truth.known], 1),
    )  # fmt: skip
    parts = FalseAlarmRate().parts(at(estimate.position[:, None].expand(-1, 2, -1, -1)), of_runs)
    torch.testing.assert_close(parts.total, torch.tensor([4.0, 6.0]))
    torch.testing.assert_close(parts.count, torch.tensor([0.3, 0.3]))


def test_a_truth_of_one_second_of_eight_judges_that_second():
    time = torch.arange(80) * 0.1
    truth = Talkers.of_tables(
        [TrackTable(Path("t.csv"), {"time": time[20:30], "x": time[20:30], "y": 0 * time[20:30]})], time
    )
    estimate = at(torch.stack([time, 0.7 + 0 * time], -1)[:, None])
    assert value(FalseAlarmRate(), estimate, truth) == pytest.approx(10.0)
    assert value(OptimalSubPatternAssignment(), estimate, truth) == pytest.approx(0.7)
    torch.testing.assert_close(FalseAlarmRate().parts(estimate, truth).count, torch.tensor(1.0))
    close = estimate._replace(position=estimate.position * torch.tensor([1.0, 0.0]))
    assert value(FalseAlarmRate(), close, truth) == value(OptimalSubPatternAssignment(), close, truth) == 0


def test_latency_is_from_the_onset_of_each_period_to_its_first_detection():
    truth = talkers("xxx..xxxx", ".xxxx....")
    estimate = line([9.0, 0.0, 0.0, 0.0, 0.0, 9.0, NAN, 9.0, 0.0], [4.0, 9.0, 9.0, 4.0, 9.0, 9.0, 9.0, 9.0, 9.0])
    assert value(Latency(), estimate, truth) == pytest.approx((0.1 + 0.3 + 0.2) / 3)


def test_a_period_without_detection_has_no_latency():
    truth, estimate = talkers("xx.xx", "     "), line([9.0, 9.0, 9.0, 9.0, 0.0])
    assert Latency().parts(estimate, truth)[1] == 1
    assert value(Latency(), estimate, truth) == pytest.approx(0.1)
    track = torch.tensor([[-1], [0], [0], [0], [-1]])
    active = torch.tensor([[True], [False], [True], [True], [True]])
    torch.testing.assert_close(
        latencies(track, active, torch.arange(5.0)), torch.tensor([[NAN], [NAN], [0], [NAN], [NAN]]), equal_nan=True
    )


@pytest.mark.parametrize(
    ("text", "breaks", "changes"),
    [
        ("0000000", 0, 0),
        ("..00000", 0, 0),  # the wait for the first is latency
        ("00..000", 1, 0),
        ("00..0.0", 2, 0),
        ("0001111", 1, 1),
        ("00..111", 1, 1),  # one break, though it is a miss and another track
        ("0010111", 3, 3),
        ("000....", 0, 0),  # an end is no break
        (".......", 0, 0),
    ],
)
def test_breaks_and_swaps_of_one_talker(text, breaks, changes):
    assert (fragments(*tracks(text)).sum(), swaps(*tracks(text)).sum()) == (breaks, changes)


def test_a_silence_is_no_break_but_does_not_hide_a_swap():
    track, _ = tracks("00.1122")
    active = torch.tensor([[True], [True], [False], [True], [True], [False], [True]])
    assert fragments(track, active).sum() == 0
    assert swaps(track, active).squeeze(-1).tolist() == [False, False, False, True, False, False, True]


def test_an_exchange_of_two_talkers_is_a_swap_of_each():
    truth = talkers("xxxx", "xxxx")
    exchange = line([0.0, 0.0, 4.0, 4.0], [4.0, 4.0, 0.0, 0.0])
    assert value(SwapRate(), exchange, truth) == pytest.approx(2 / 0.8)
    assert value(FragmentationRate(), exchange, truth) == pytest.approx(2 / 0.8)
    assert value(DetectionRate(), exchange, truth) == 1


def test_crossing_tracks_that_go_with_their_talkers_do_not_swap():
    truth = line([0.0, 1.0, 2.0, 3.0, 4.0], [4.0, 3.0, 2.0, 1.0, 0.0])
    truth.position[:, 1, 1] = 0.2
    estimate = line([4.1, 3.1, 2.1, 1.1, 0.1], [0.1, 1.1, 2.1, 3.1, 4.1])
    estimate.position[:, 0, 1] = 0.2
    assert value(SwapRate(), estimate, truth) == 0


def test_rates_are_per_second_of_activity():
    truth = talkers("x..xx.", "      ")
    assert value(SwapRate(), line([0.0, 9, 9, 9, 9, 9], [9.0, 9, 9, 0, 0, 9]), truth) == pytest.approx(1 / 0.3)
    assert value(FragmentationRate(), line([0.0, 9, 9, 0, 9, 9], [9.0, 9, 9, 9, 0, 9]), truth) == pytest.approx(1 / 0.3)


def test_directions_have_a_gate_of_thirty_degrees():
    truth = at(azimuth=[[3.1], [3.1], [3.1]])
    estimate = at(azimuth=[[-3.1], [2.6], [2.5]])
    metric = DetectionRate(by="azimuth")
    assert (metric.name, metric.needs) == ("detection_rate_azimuth", ("azimuth",))
    assert value(metric, estimate, truth) == pytest.approx(2 / 3)


@pytest.mark.parametrize("metric", [DetectionRate, FalseAlarmRate, Latency, FragmentationRate, SwapRate])
def test_runs_of_a_batch_are_those_alone(metric):
    generator = torch.Generator().manual_seed(3)
    truth = talkers("xxx..xx xxx", "..xxxxxxx  ")
    truth = truth._replace(position=truth.position[:, None], speech=truth.speech[:, None])
    position = 0.5 * torch.randn(11, 5, 3, 2, generator=generator)
    position[..., 0] += 4 * (torch.rand(11, 5, 3, generator=generator) < 0.5)
    whole = metric().parts(at(position), truth)
    each = [metric().parts(at(position[:, [run]]), truth) for run in range(5)]
    torch.testing.assert_close(whole.total, torch.cat([one.total for one in each]))
    torch.testing.assert_close(whole.count, torch.cat([one.count for one in each]))


def test_rejects_a_gate_that_is_none_and_a_single_frame():
    with pytest.raises(InputError, match="limit must be finite and positive"):
        DetectionRate(gate=-1.0)
    with pytest.raises(InputError, match="metric latency needs two frames or more, got 1"):
        Latency().parts(line([0.0]), talkers("x", "x"))
