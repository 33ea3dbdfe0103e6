"""Presets: what each is said to do, on clouds of particles and in the track."""

import math
from typing import NamedTuple

import pytest
import torch

from probtrack.dynamics import Kinematics
from probtrack.errors import InputError
from probtrack.switching import PRESETS, SwitchingDynamics, moving_and_stopped, odas, speech_and_silence, teleconference

DT = 0.032
every_preset = pytest.mark.parametrize("make", PRESETS.values(), ids=PRESETS)


class Heard(NamedTuple):
    speech: torch.Tensor


def walked(model, speech, *, size=4000, velocity=(0.4, -0.3)):
    """Kinematics and modes of a cloud, all at one place with one velocity, after each frame."""
    axes = model.axes
    speed = torch.tensor([*velocity, 0.1][:axes]).expand(size, axes)
    state, known = model.from_kinematics(Kinematics(torch.zeros(size, axes), speed)), []
    with torch.no_grad():
        for _, move in zip(speech, model.moves(Heard(speech), DT), strict=False):
            state, _ = move(state, torch.randn(size, model.noise_dim))
            known.append((model.kinematics(state), model.mode(state).mean(0)))
    return known


def spread(kinematics):
    return kinematics.position.std(0)


@every_preset
@pytest.mark.parametrize("axes", [2, 3])
def test_every_preset_moves_a_cloud_and_learns(make, axes):
    model = make(axes)
    assert isinstance(model, SwitchingDynamics)
    assert model.axes == axes
    (last, mode) = walked(model, torch.rand(20), size=50)[-1]
    assert last.position.shape == (50, axes)
    assert last.position.isfinite().all()
    torch.testing.assert_close(mode.sum(), torch.ones(()))
    assert all(p.requires_grad for p in model.parameters())


@every_preset
def test_gradients_of_presets_are_finite(make):
    model = make(2)
    state = model.from_kinematics(Kinematics(torch.zeros(300, 2), torch.zeros(300, 2)))
    total = 0.0
    for _, move in zip(range(3), model.moves(Heard(torch.tensor([0.9, 0.2, 0.5])), DT), strict=False):
        state, log_weight = move(state, torch.randn(300, model.noise_dim))
        total = total + (log_weight * state[:, 0]).sum() + state[:, :2].square().sum()
    total.backward()
    assert all(p.grad.isfinite().all() for p in model.parameters())


# speech and silence


@pytest.mark.parametrize("make", [speech_and_silence, teleconference])
@pytest.mark.parametrize(("alpha", "speaking"), [(1.0, 0.99), (0.0, 0.01), (0.3, 0.3 * 0.99 + 0.7 * 0.01)])
def test_the_mode_follows_the_probability_of_speech_in_each_frame(make, alpha, speaking):
    for _, mode in walked(make(), torch.full((4,), alpha))[1:]:
        assert abs(mode[0] - speaking) < 5 * math.sqrt(speaking * (1 - speaking) / 4000)


def test_a_silent_talker_goes_straight_on():
    """A second of silence: 5 % of frames move as in speech, and the rest by 0.02 m/s per sqrt(s)."""
    silent, speaking = (walked(speech_and_silence(), torch.full((31,), a))[-1][0] for a in (0.0, 1.0))
    goes_on = 31 * DT * torch.tensor([0.4, -0.3])
    # in speech the velocity decays at 0.2 /s; 5 % of that is 1 % after a second
    torch.testing.assert_close(silent.position.mean(0), goes_on, rtol=0.01, atol=5 * spread(silent).max().item() / 60)
    assert (spread(silent) < 0.4 * spread(speaking)).all()


def test_in_silence_velocity_is_all_but_constant():
    silent = speech_and_silence().models[1]
    velocity = torch.tensor([0.0, 0.0, 0.4, -0.3])
    law = silent(velocity, 1.0)
    torch.testing.assert_close(law.mean[2:], velocity[2:])
    torch.testing.assert_close(law.variance[2:].sqrt(), torch.full((2,), 0.02))


# teleconference


def test_in_silence_a_talker_at_a_table_is_still():
    """A velocity of 2 cm/s that is forgotten at 10 /s: 1.2 cm after two seconds."""
    law = teleconference().models[1](torch.zeros(4), 2.0)
    t = 2.0 - 2 * (1 - math.exp(-20)) / 10 + (1 - math.exp(-40)) / 20  # less what the start at rest takes off
    torch.testing.assert_close(law.variance[:2].sqrt(), torch.full((2,), 0.02 * math.sqrt(2 * t / 10)))


def test_a_silent_cloud_at_a_table_spreads_by_the_frames_taken_for_speech_alone():
    silent = walked(teleconference(), torch.zeros(62), velocity=(0, 0))[-1][0]
    push = 0.8 * math.sqrt(1 - math.exp(-20 * DT))  # m/s in each of 1 % of frames, forgotten at 10 /s
    wanted = math.sqrt(0.0122**2 + 62 * 0.01 * (push * (DT + 0.1)) ** 2)
    # the last pushes have not run out, and a frame after another forgets a part: 5 %; few are pushed: 10 %
    torch.testing.assert_close(spread(silent), torch.full((2,), wanted), rtol=0.15, atol=0)
    speaking = walked(teleconference(), torch.ones(62), velocity=(0, 0))[-1][0]
    assert (spread(speaking) > 3 * spread(silent)).all()


def test_a_moving_talker_at_a_table_comes_to_rest_in_silence():
    silent = walked(teleconference(), torch.zeros(31))[-1][0]
    # half of 5 % of the variance of CU-LAN-ORIG's 0.8 m/s, and of what is forgotten at 10 /s nothing
    assert silent.velocity.square().mean().sqrt() < 0.8 * math.sqrt(0.05) + 0.02
    assert silent.position.mean(0).norm() < 0.5 / 10 + 5 * spread(silent).max() / 60


# ODAS


def test_shares_of_odas():
    for _, mode in walked(odas(), torch.ones(4)):
        shares = torch.tensor([0.5, 0.3, 0.2])
        assert ((mode - shares).abs() < 5 * (shares * (1 - shares) / 4000).sqrt()).all()


def test_modes_of_odas_are_drawn_anew_in_each_frame():
    table = odas(dt=0.01).chain(0.01).exp()
    torch.testing.assert_close(table, torch.tensor([0.5, 0.3, 0.2]).expand(4, 3))


@pytest.mark.parametrize("distance", [1.0, 2.5])
@pytest.mark.parametrize(("mode", "rate", "speed"), [(0, 2.0, 0.04), (1, 0.05, 0.2), (2, 0.5, 0.2)])
def test_regimes_of_odas(mode, rate, speed, distance):
    """x' = x + T v', v' = a v + b u with a = exp(-rate T) and b = speed sqrt(1 - a^2)."""
    step = odas(distance=distance).models[mode].transition(DT)
    a = math.exp(-rate * DT)
    vx, vy = a * 0.4 + distance * speed * math.sqrt(1 - a * a) * 1.3, a * -0.3
    moved = step(torch.tensor([1.0, 2.0, 0.4, -0.3]), torch.tensor([1.3, 0.0]))
    torch.testing.assert_close(moved, torch.tensor([1 + DT * vx, 2 + DT * vy, vx, vy]))


def test_stationary_of_odas_is_the_slowest():
    law = [model.transition(DT)(torch.zeros(4), torch.ones(2))[2] for model in odas().models]
    assert law[0] < law[2]
    assert law[1] < law[2]


# moving and stopped


def test_talkers_move_and_stand_as_long_as_asked():
    model = moving_and_stopped(moving=0.5, stopped=0.2)
    known = walked(model, torch.ones(400), size=300)
    mode = torch.stack([mode[0] for _, mode in known])
    assert abs(mode.mean() - 0.5 / 0.7) < 0.02  # 300 talkers for 400 frames of up to 20 alike: 5 sqrt(.2 / 6000)
    table = model.chain(DT).exp()
    torch.testing.assert_close(DT / (1 - table[:2].diagonal()), torch.tensor([0.5, 0.2]))


def test_a_stopped_talker_is_braked_by_friction_alone():
    stopped = moving_and_stopped().models[1]
    state, u = torch.tensor([1.0, 2.0, 0.4, -0.3]), 100 * torch.randn(2)
    v = math.exp(-10 * DT) * torch.tensor([0.4, -0.3])
    moved = stopped.transition(DT)(state, u)
    torch.testing.assert_close(moved, torch.cat([torch.tensor([1.0, 2.0]) + DT * v, v]))


def test_a_moving_talker_has_a_speed_of_a_metre_per_second():
    """S3 eq. A.2 to A.5 with beta = 10 /s and v = 1 m/s."""
    step, a = moving_and_stopped().models[0].transition(DT), math.exp(-10 * DT)
    vx = a * 0.4 + math.sqrt(1 - a * a) * 1.3
    moved = step(torch.tensor([1.0, 2.0, 0.4, -0.3]), torch.tensor([1.3, 0.0]))
    torch.testing.assert_close(moved, torch.tensor([1 + DT * vx, 2 - DT * a * 0.3, vx, -0.3 * a]))


def test_silence_says_nothing_to_presets_that_do_not_listen():
    assert [make(2).chain.listens for make in PRESETS.values()] == [True, True, False, False]


@pytest.mark.parametrize("make", [speech_and_silence, teleconference, odas, moving_and_stopped])
def test_chains_are_for_the_time_step_given(make):
    assert make(dt=0.05).chain.dt == 0.05


# mistakes


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
def test_rejects_sizes_that_are_none(value):
    with pytest.raises(InputError, match="distance must be finite and positive"):
        odas(distance=value)
    for times in ({"moving": value}, {"stopped": value}):
        with pytest.raises(InputError, match="times must be finite and positive"):
            moving_and_stopped(**times)
    for make in PRESETS.values():
        with pytest.raises(InputError, match="dt must be finite and positive"):
            make(dt=value)
