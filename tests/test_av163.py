"""The AV16.3 recording of a walking talker: a real room, a compact array, no truth but what can be heard."""

import pytest
import torch

from probtrack.cli.main import main
from probtrack.geometry import wrap_angle
from probtrack.track_files import read_track

FIRST_WORD, LAST_WORD = 5.6, 29.5  # s


@pytest.fixture(scope="module")
def tracks(data_dir, tmp_path_factory):
    """Tracks of three seeds, as the documentation's command makes them."""
    folder = tmp_path_factory.mktemp("av163")
    audio = data_dir / "recordings" / "seq11-1p-0100_array1_8ch.flac"
    command = ["track", str(audio), "--array", "av16.3-array1"]
    for seed in range(3):
        assert main([*command, "--seed", str(seed), "-o", str(folder / f"{seed}.csv")]) == 0
    return [read_track(folder / f"{seed}.csv") for seed in range(3)]


def during(table, begin, end):
    return (table.time >= begin) & (table.time <= end)


@pytest.mark.realdata
def test_cloud_stays_spread_before_the_first_word(tracks):
    for table in tracks:
        before = during(table, 0.0, FIRST_WORD - 0.1)
        # uniform over 7 x 7 m has 2.02 m on each axis
        assert table.columns["std_x"][before].min() > 1.4
        assert table.columns["std_y"][before].min() > 1.4
        assert table.columns["std_azimuth"][before].min() > 1.2


@pytest.mark.realdata
def test_azimuth_runs_smoothly_while_the_talker_speaks(tracks):
    for table in tracks:
        speaking = during(table, FIRST_WORD + 0.5, LAST_WORD)
        jumps = wrap_angle(table.columns["azimuth"][speaking].diff()).abs().rad2deg()
        assert jumps.max() < 15


@pytest.mark.realdata
def test_azimuth_locks_within_half_a_second_and_stays_sharp(tracks):
    for table in tracks:
        spread = table.columns["std_azimuth"][during(table, FIRST_WORD + 0.5, LAST_WORD)].rad2deg()
        assert spread.median() < 12


@pytest.mark.realdata
def test_talker_goes_from_the_right_of_the_array_to_its_back(tracks):
    """What a picture of the steered power shows: -60 degrees at first, through 0 at 25 s, past 100 at the end."""
    for table in tracks:
        azimuth = table.columns["azimuth"].rad2deg()
        assert (azimuth[during(table, 6.1, 9.0)] + 60).abs().max() < 15
        assert azimuth[during(table, 24.9, 25.3)].abs().max() < 35
        assert azimuth[during(table, 28.8, 29.4)].min() > 85


@pytest.mark.realdata
def test_seeds_agree_on_direction_and_admit_the_range_is_unknown(tracks):
    speaking = during(tracks[0], FIRST_WORD + 0.5, LAST_WORD)
    angles = torch.stack([table.columns["azimuth"][speaking] for table in tracks])
    assert wrap_angle(angles - angles[0]).abs().rad2deg().median() < 4
    for table in tracks:
        x, y = (table.columns[f"std_{axis}"][speaking] for axis in "xy")
        assert torch.hypot(x, y).median() > 0.5


@pytest.mark.realdata
def test_speech_is_heard_when_there_is_some(tracks):
    speech = tracks[0].columns["speech"]
    assert speech[during(tracks[0], 0, FIRST_WORD - 0.1)].mean() < 0.01
    assert speech[during(tracks[0], FIRST_WORD, LAST_WORD)].mean() > 0.55
