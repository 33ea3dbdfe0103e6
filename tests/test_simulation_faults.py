"""Faults of an array, measured on what they do."""

import math

import pytest
import torch

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray, Region
from probtrack.simulation.faults import Faults


def generator(seed=11):
    return torch.Generator().manual_seed(seed)


def array():
    return MicrophoneArray(torch.rand(400, 3) * torch.tensor([4.0, 3.0, 2.0]) + torch.tensor([1.0, 0.5, 0.3]))


def test_without_faults_nothing_changes():
    audio, stated = torch.randn(3, 50), array()
    assert torch.equal(Faults().apply(audio, generator()), audio)
    assert Faults().true_array(stated, generator()) is stated


def test_gains_have_their_spread_and_are_constant():
    audio = torch.randn(4000, 3)
    faulty = Faults(gain_std_db=1.7).apply(audio, generator())
    ratio = faulty / audio
    torch.testing.assert_close(ratio, ratio[:, :1].expand(-1, 3))
    level = 20 * torch.log10(ratio[:, 0])
    assert level.mean() == pytest.approx(0.0, abs=5 * 1.7 / math.sqrt(4000))
    assert level.std() == pytest.approx(1.7, abs=5 * 1.7 / math.sqrt(8000))


def test_places_have_their_spread_on_every_axis():
    stated = array()
    error = Faults(position_std=0.02).true_array(stated, generator()).positions - stated.positions
    assert error.std(0).tolist() == pytest.approx([0.02] * 3, abs=5 * 0.02 / math.sqrt(800))
    assert error.mean(0).abs().max() < 5 * 0.02 / math.sqrt(400)
    torch.testing.assert_close(torch.corrcoef(error.T), torch.eye(3), rtol=0, atol=5 / math.sqrt(400))


def test_true_places_stay_in_the_room():
    stated, room = array(), Region((0.9, 0.4, 0.2), (5.1, 3.6, 2.4))
    true = Faults(position_std=0.3).true_array(stated, generator(), room).positions
    free = Faults(position_std=0.3).true_array(stated, generator()).positions
    assert room.contains(true).all()
    inside = room.contains(free)
    assert 0.3 < inside.double().mean() < 0.9
    assert torch.equal(true[inside], free[inside])


def test_dead_channels_give_weak_white_noise():
    audio = torch.randn(5, 40000) * 3.0
    faulty = Faults(dead_channels=(2, 5)).apply(audio, generator())
    assert torch.equal(faulty[[0, 2, 3]], audio[[0, 2, 3]])
    level = 10 * torch.log10(faulty[[1, 4]].square().mean(-1) / audio.square().mean())
    assert level.tolist() == pytest.approx([-60.0, -60.0], abs=0.2)
    assert abs(torch.corrcoef(torch.cat([faulty[[1, 4]], audio[1:2]])) - torch.eye(3)).max() < 5 / 200


def test_clipping_stops_at_its_level_below_the_peak():
    audio = torch.randn(3, 5000)
    faulty = Faults(clipping_db=6.0).apply(audio, generator())
    limit = float(audio.abs().max()) * 10 ** (-6 / 20)
    assert float(faulty.abs().max()) == pytest.approx(limit)
    below = audio.abs() <= limit
    assert torch.equal(faulty[below], audio[below])
    assert torch.equal(faulty[~below].sign(), audio[~below].sign())
    assert (faulty[~below].abs() == faulty.abs().max()).all()


def test_converters_come_after_gains():
    audio = torch.randn(6, 5000)
    loud = Faults(gain_std_db=3.0).apply(audio, generator())
    both = Faults(gain_std_db=3.0, clipping_db=4.0).apply(audio, generator())
    torch.testing.assert_close(both, Faults(clipping_db=4.0).apply(loud, generator()))


def test_one_fault_leaves_the_numbers_of_another():
    audio = torch.randn(6, 2000)
    alone = Faults(gain_std_db=2.0).apply(audio, generator())
    both = Faults(gain_std_db=2.0, position_std=0.1, dead_channels=(3,)).apply(audio, generator())
    live = [0, 1, 3, 4, 5]
    assert torch.equal(alone[live], both[live])
    dead = Faults(dead_channels=(3,)).apply(audio, generator())[2]
    torch.testing.assert_close(both[2] / both[2].std(), dead / dead.std())
    one, other = Faults(position_std=0.1), Faults(position_std=0.1, gain_std_db=2.0)
    stated = array()
    assert torch.equal(one.true_array(stated, generator()).positions, other.true_array(stated, generator()).positions)


def test_the_generator_moves_on_alike_whatever_is_wrong():
    after = []
    for faults in (Faults(), Faults(1.0, 0.1, (1,), 3.0)):
        shared = generator()
        faults.true_array(array(), shared)
        faults.apply(torch.randn(3, 10), shared)
        after.append(shared.get_state())
    assert torch.equal(*after)


def test_gains_and_places_are_independent():
    stated = array()
    gain = Faults(gain_std_db=1.0).apply(torch.ones(400, 1), generator()).log()[:, 0]
    moved = (Faults(position_std=0.1).true_array(stated, generator()).positions - stated.positions).flatten()[:400]
    assert abs(torch.corrcoef(torch.stack([gain, moved]))[0, 1]) < 5 / 20


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"gain_std_db": -1.0}, "gain_std_db must be finite and not negative, got -1.0"),
        ({"position_std": math.nan}, "position_std must be finite and not negative, got nan"),
        ({"clipping_db": -3.0}, "clipping_db must be finite and not negative, got -3.0"),
        ({"dead_channels": (0,)}, "dead_channels must be an integer of at least 1, got 0"),
    ],
)
def test_faults_that_cannot_be_are_said(values, message):
    with pytest.raises(InputError, match=message):
        Faults(**values)


def test_recordings_that_do_not_fit_are_said():
    with pytest.raises(InputError, match="dead_channels must be from 1 to 2, got 3"):
        Faults(dead_channels=(3,)).apply(torch.ones(2, 4), generator())
    with pytest.raises(InputError, match="must leave a microphone alive, got all 2"):
        Faults(dead_channels=(2, 1)).apply(torch.ones(2, 4), generator())
    with pytest.raises(InputError, match="audio must be finite"):
        Faults().apply(torch.full((2, 4), torch.nan), generator())
    with pytest.raises(InputError, match=r"audio must have shape \(M, S\)"):
        Faults().apply(torch.ones(4), generator())


def test_a_small_error_moves_microphones_a_little():
    stated = MicrophoneArray([[0.5, 0.5, 1.0], [1.0, 0.7, 1.2]])
    true = Faults(position_std=1e-5).true_array(stated, torch.Generator().manual_seed(3))
    error = (true.positions - stated.positions).abs()
    assert 0 < error.max() < 1e-4
