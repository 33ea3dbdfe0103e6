"""Turns: what long draws measure, on a count that shares no code with the law."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from probtrack.errors import InputError
from probtrack.simulation.voices import GivenTurns, TurnTaking


def draw(turns, num_talkers, duration, seed=0):
    return turns.draw(num_talkers, duration, torch.Generator().manual_seed(seed))


def pauses_of(utterances):
    times = np.array(utterances)
    return times[1:, 0] - times[:-1, 1]


def changes_of(schedule):
    """Silence [s] at each change of talker, below 0 where the two overlap."""
    said = sorted((start, end, talker) for talker, utterances in enumerate(schedule) for start, end in utterances)
    return np.array([b[0] - a[1] for a, b in pairwise(said) if a[2] != b[2]])


def test_one_talker_is_active_and_pauses_as_people_do():
    times = draw(TurnTaking(), 1, 20_000.0)[0]
    pauses = pauses_of(times)
    assert 0.65 < sum(end - start for start, end in times) / 20_000 < 0.70
    assert 0.8 < np.median(pauses) < 1.0
    assert 1.5 < np.quantile(pauses, 0.9) < 2.0
    assert 0.29 < pauses.min() < 0.31
    assert 4.0 < pauses.max() < 5.1


@pytest.mark.parametrize(("share", "median", "p90"), [(0.4, 0.5, 0.7), (0.9, 0.3, 1.5)])
def test_settings_are_what_is_measured(share, median, p90):
    times = draw(TurnTaking(active_share=share, pause_median=median, pause_p90=p90), 1, 20_000.0)[0]
    pauses = pauses_of(times)
    assert sum(end - start for start, end in times) / 20_000 == pytest.approx(share, abs=0.015)
    assert np.median(pauses) == pytest.approx(median, rel=0.06)
    assert np.quantile(pauses, 0.9) == pytest.approx(p90, rel=0.1)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("duration", [0.1, 3.0, 8.0])
def test_short_scenes_begin_soon_and_hold_speech(duration, seed):
    times = draw(TurnTaking(), 1, duration, seed)[0]
    assert 0 < times[0][0] < 0.401
    assert sum(end - start for start, end in times) > 0.15 * duration
    assert times[-1][1] <= duration


def test_several_talkers_leave_short_gaps_and_do_not_overlap():
    gaps = changes_of(draw(TurnTaking(), 3, 10_000.0))
    assert gaps.min() > 0
    assert np.median(gaps) == pytest.approx(0.2, rel=0.05)


def test_overlap_is_the_share_of_changes():
    changes = changes_of(draw(TurnTaking(overlap=0.3), 3, 10_000.0))
    assert (changes < 0).mean() == pytest.approx(0.3, abs=0.04)
    assert np.median(changes[changes > 0]) == pytest.approx(0.2, rel=0.07)
    assert 0.2 < np.median(-changes[changes < 0]) < 0.5


def test_never_more_than_two_speak_at_once_and_no_one_with_himself():
    schedule = draw(TurnTaking(overlap=1.0, utterances_a_turn=1.0), 4, 3000.0)
    assert all(pauses_of(times).min() > 0 for times in schedule)
    edges = sorted((t, step) for times in schedule for start, end in times for t, step in ((start, 1), (end, -1)))
    assert np.cumsum([step for _, step in edges]).max() == 2


def test_turns_have_their_mean_number_of_utterances_and_share_the_time():
    schedule = draw(TurnTaking(utterances_a_turn=3.0), 2, 20_000.0)
    count = sum(map(len, schedule))
    assert count / (len(changes_of(schedule)) + 1) == pytest.approx(3.0, rel=0.06)
    spoken = [sum(end - start for start, end in times) for times in schedule]
    assert spoken[0] == pytest.approx(spoken[1], rel=0.12)


def test_who_has_not_spoken_comes_next():
    schedule = draw(TurnTaking(utterances_a_turn=1.0), 5, 60.0)
    said = sorted((start, talker) for talker, utterances in enumerate(schedule) for start, _ in utterances)
    assert {talker for _, talker in said[:5]} == set(range(5))


def test_same_seed_gives_the_same_turns():
    assert draw(TurnTaking(), 2, 30.0, 3) == draw(TurnTaking(), 2, 30.0, 3)
    assert draw(TurnTaking(), 2, 30.0, 3) != draw(TurnTaking(), 2, 30.0, 4)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"active_share": 1.0}, r"active_share must be in \(0, 1\), got 1.0"),
        ({"active_share": float("nan")}, "active_share must be in"),
        ({"pause_median": 0.0}, "pause_median must be finite and positive, got 0.0"),
        ({"pause_p90": 0.9}, "pause_p90 must be finite and above pause_median, got 0.9"),
        ({"pause_p90": float("nan")}, "pause_p90 must be finite"),
        ({"gap": -0.1}, "gap must be finite and not negative, got -0.1"),
        ({"overlap": 1.5}, r"overlap must be in \[0, 1\], got 1.5"),
        ({"utterances_a_turn": 0.5}, "utterances_a_turn must be finite and at least 1, got 0.5"),
    ],
)
def test_rejects_settings_that_cannot_be(settings, message):
    with pytest.raises(InputError, match=message):
        TurnTaking(**settings)


@pytest.mark.parametrize("turns", [TurnTaking(), GivenTurns(())])
def test_rejects_no_talker_and_no_time(turns):
    with pytest.raises(InputError, match="num_talkers must be an integer of at least 1, got 0"):
        draw(turns, 0, 5.0)
    with pytest.raises(InputError, match=r"duration must be finite and positive, got -1\.0"):
        draw(turns, 1, -1.0)


def test_given_turns_are_sorted_by_talker_and_cut_at_the_end():
    turns = GivenTurns(((1, 0.5, 2.0), (0, 3.0, 9.0), (0, 1.0, 1.5), (1, 6.0, 7.0)))
    assert draw(turns, 3, 5.0) == [[(1.0, 1.5), (3.0, 5.0)], [(0.5, 2.0)], []]


@pytest.mark.parametrize(
    ("utterances", "message"),
    [
        (((0, 2.0, 1.0),), "start and end must be 0 <= start < end, got 2.0 and 1.0"),
        (((0, -1.0, 1.0),), "start and end must be 0 <= start < end, got -1.0 and 1.0"),
        (((0, 0.0, float("nan")),), "start and end must be"),
        (((0, 1.0, 3.0), (1, 0.0, 9.0), (0, 2.0, 4.0)), "talker 0 must not overlap, got one to 3.0 s and from 2.0 s"),
        (((-1, 0.0, 1.0),), "utterances: talker must be an integer of at least 0, got -1"),
    ],
)
def test_rejects_utterances_that_cannot_be(utterances, message):
    with pytest.raises(InputError, match=message):
        GivenTurns(utterances)


def test_rejects_a_talker_that_is_not_there():
    with pytest.raises(InputError, match="talker must be below the number of talkers 2, got 2"):
        draw(GivenTurns(((2, 0.0, 1.0),)), 2, 5.0)
