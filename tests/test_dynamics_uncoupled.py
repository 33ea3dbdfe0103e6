"""Coordinate-uncoupled motion: against the printed matrices, its limits, and the interface of `Dynamics`."""

import copy

import pytest
import torch
from oracles import lehmann_matrices
from properties import assert_gradients, assert_moments, assert_shapes
from torch.distributions import Independent, Normal

from probtrack.dynamics import (
    CoordinateUncoupled,
    Dynamics,
    Kinematics,
    Langevin,
    RandomWalkVelocity,
    TimeCorrelatedVelocity,
    lehmann2007,
)
from probtrack.errors import InputError, ShapeError

NAMES = ["CU-LAN", "CU-LAN-ORIG", "CU-RWVE", "CU-TCVE"]
CORRELATED = [TimeCorrelatedVelocity, Langevin]

PRINTED = {  # name -> oracle with the values of Table 1 at T = 32 ms
    "CU-RWVE": lambda: lehmann_matrices.random_walk_velocity(0.032, sigma=0.05),
    "CU-TCVE": lambda: lehmann_matrices.time_correlated_velocity(0.032, beta=0.3, sigma=0.7),
    "CU-LAN": lambda: lehmann_matrices.langevin(0.032, beta=0.2, sigma=0.7),
    "CU-LAN-ORIG": lambda: lehmann_matrices.langevin(0.032, beta=10, sigma=0.8),
}


def assert_matrices(model, dt, expected):
    for made, printed in zip(model.matrices(dt), expected, strict=True):
        torch.testing.assert_close(made, torch.as_tensor(printed))


@pytest.mark.parametrize("name", NAMES)
def test_table_1_gives_the_printed_matrices(name):
    assert_matrices(lehmann2007(name), 0.032, PRINTED[name]())


@pytest.mark.parametrize("dt", [0.004, 0.5])
def test_printed_matrices_at_other_steps(dt):
    velocity = TimeCorrelatedVelocity(rate=1.7, speed=0.6)
    assert_matrices(
        CoordinateUncoupled(velocity), dt, lehmann_matrices.time_correlated_velocity(dt, beta=1.7, sigma=0.6)
    )
    langevin = Langevin(rate=1.7, speed=0.6)
    assert_matrices(CoordinateUncoupled(langevin), dt, lehmann_matrices.langevin(dt, beta=1.7, sigma=0.6))
    walk = RandomWalkVelocity(diffusion=0.3)
    assert_matrices(CoordinateUncoupled(walk), dt, lehmann_matrices.random_walk_velocity(dt, sigma=0.3 * dt**0.5))


def test_step_of_table_1_matters_to_the_random_walk_only():
    assert_matrices(lehmann2007("CU-RWVE", dt=0.02), 0.02, lehmann_matrices.random_walk_velocity(0.02, 0.05))
    assert_matrices(lehmann2007("CU-LAN", dt=0.02), 0.032, PRINTED["CU-LAN"]())


def test_velocity_diffuses_alike_at_every_frame_rate():
    _, slow = RandomWalkVelocity(diffusion=0.3)(0.4)
    _, fast = RandomWalkVelocity(diffusion=0.3)(0.1)
    torch.testing.assert_close(4 * fast[1].square(), slow[1].square())


@pytest.mark.parametrize("axis_model", CORRELATED)
def test_speed_is_the_stationary_speed(axis_model):
    matrix, gain = axis_model(rate=3.0, speed=1.5)(0.07)
    torch.testing.assert_close(matrix[1, 1] ** 2 * 1.5**2 + gain[1] ** 2, torch.tensor(1.5**2))


def test_velocity_of_two_half_steps_is_that_of_one_step():
    half, whole = (TimeCorrelatedVelocity(rate=3.0, speed=1.5)(dt)[0] for dt in (0.05, 0.1))
    torch.testing.assert_close(half @ half, whole)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("axes", [2, 3])
def test_law_is_the_matrices_applied(name, axes):
    model, state = lehmann2007(name, axes), torch.randn(5, 2 * axes)
    law, (F, G) = model(state, 0.4), model.matrices(0.4)
    assert_shapes(law, (5,), (2 * axes,))
    torch.testing.assert_close(law.mean, torch.stack([F @ x for x in state]))
    torch.testing.assert_close(law.covariance_matrix[3], G @ G.T)


def test_samples_have_the_moments_of_the_law():
    model = CoordinateUncoupled(Langevin(rate=2.0, speed=0.7))
    law = model(torch.tensor([1.0, -2.0, 0.3, 0.8]), 0.4)
    F, G = (torch.as_tensor(x) for x in lehmann_matrices.langevin(0.4, beta=2.0, sigma=0.7))
    assert_moments(law, F @ torch.tensor([1.0, -2.0, 0.3, 0.8]), G @ G.T)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("batch", [(), (7,), (3, 7), (2, 3, 7)])
def test_transition_draws_from_the_law(name, batch):
    model, state, noise = lehmann2007(name, 3), torch.randn(*batch, 6), torch.randn(*batch, 3)
    torch.testing.assert_close(model.transition(0.4)(state, noise), model(state, 0.4).at_noise(noise))
    torch.testing.assert_close(model.transition(0.4)(state, noise), Dynamics.transition(model, 0.4)(state, noise))


def test_transition_leaves_its_inputs_alone():
    model, state, noise = lehmann2007("CU-LAN"), torch.randn(7, 4), torch.randn(7, 2)
    kept = state.clone(), noise.clone()
    step = model.transition(0.4)
    torch.testing.assert_close(step(state, noise), step(*kept), rtol=0, atol=0)
    assert torch.equal(state, kept[0])
    assert torch.equal(noise, kept[1])


def test_noise_may_have_more_draws_than_states():
    model, state, noise = lehmann2007("CU-LAN"), torch.randn(7, 4), torch.randn(5, 7, 2)
    many = model.transition(0.4)(state, noise)
    torch.testing.assert_close(many[3], model.transition(0.4)(state, noise[3]))


@pytest.mark.parametrize("name", NAMES)
def test_each_talker_may_have_its_own_dt(name):
    model, state, noise, dt = lehmann2007(name), torch.randn(3, 4), torch.randn(3, 2), torch.tensor([0.01, 0.1, 1.0])
    law, moved = model(state, dt), model.transition(dt)(state, noise)
    for i in range(3):
        one = model(state[i], float(dt[i]))
        torch.testing.assert_close(law.mean[i], one.mean)
        torch.testing.assert_close(law.gain[i], one.gain)
        torch.testing.assert_close(moved[i], one.at_noise(noise[i]))


@pytest.mark.parametrize("name", NAMES)
def test_dt_as_number_and_as_tensor_agree(name):
    model = lehmann2007(name)
    for number, tensor in zip(model.matrices(0.032), model.matrices(torch.tensor(0.032)), strict=True):
        torch.testing.assert_close(number, tensor, rtol=0, atol=0)
    assert model.matrices(torch.full((3, 1), 0.032))[0].shape == (3, 1, 4, 4)


def test_each_recording_may_have_its_own_dt():
    model, state, noise, dt = (
        lehmann2007("CU-TCVE"),
        torch.randn(3, 7, 4),
        torch.randn(3, 7, 2),
        torch.tensor([0.1, 0.2, 0.3]),
    )
    moved = model.transition(dt[:, None])(state, noise)
    torch.testing.assert_close(moved[2], model.transition(0.3)(state[2], noise[2]))


@pytest.mark.parametrize("name", NAMES)
def test_permuting_particles_permutes_what_becomes_of_them(name):
    step, state, noise, order = (
        lehmann2007(name).transition(0.1),
        torch.randn(6, 4),
        torch.randn(6, 2),
        torch.randperm(6),
    )
    torch.testing.assert_close(step(state[order], noise[order]), step(state, noise)[order])


@pytest.mark.parametrize("name", NAMES)
def test_rotating_the_room_rotates_the_motion(name):
    step, state, noise = lehmann2007(name).transition(0.1), torch.randn(6, 4), torch.randn(6, 2)
    turn = torch.tensor([[0.6, -0.8], [0.8, 0.6]])
    turned = step(state @ torch.block_diag(turn, turn).T, noise @ turn.T)
    torch.testing.assert_close(turned, step(state, noise) @ torch.block_diag(turn, turn).T)


@pytest.mark.parametrize("axis_model", CORRELATED)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("rate", [1e-30, 1e-12, 1e-6])
def test_slow_forgetting_is_constant_velocity(axis_model, rate, dtype):
    model = axis_model(rate=rate, speed=2.0).to(dtype)
    matrix, gain = model(0.5)
    torch.testing.assert_close(matrix, torch.tensor([[1.0, 0.5], [0.0, 1.0]], dtype=dtype), rtol=1e-6, atol=0)
    sigma = 2 * (2 * 0.5 * rate) ** 0.5
    torch.testing.assert_close(gain, torch.tensor([0.5 * sigma, sigma], dtype=dtype), rtol=1e-4, atol=0)


def test_drift_is_smooth_where_its_series_ends():
    rates = torch.tensor([1.998e-3, 1.9999e-3, 2.0001e-3, 2.002e-3, 0.01, 0.1])  # it ends at 2e-3
    drift = torch.stack([TimeCorrelatedVelocity(rate=r, speed=1.0)(0.5)[0][0, 1] for r in rates])
    torch.testing.assert_close(drift, -torch.expm1(-0.5 * rates) / rates, rtol=1e-13, atol=0)


@pytest.mark.parametrize(("axis_model", "drift"), [(TimeCorrelatedVelocity, 1e-8), (Langevin, 0.0)])
def test_fast_forgetting_is_a_new_velocity_each_step(axis_model, drift):
    matrix, gain = axis_model(rate=1e8, speed=2.0)(0.5)
    torch.testing.assert_close(matrix, torch.tensor([[1.0, drift], [0.0, 0.0]]))
    torch.testing.assert_close(gain, torch.tensor([1.0, 2.0]))


@pytest.mark.parametrize("axis_model", CORRELATED)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("log_rate", [-1000.0, -80.0, -20.0, 0.0, 20.0, 80.0])
def test_gradients_are_finite_at_any_rate(axis_model, log_rate, dtype):
    model = axis_model(rate=1.0, speed=2.0).to(dtype)
    torch.nn.init.constant_(model.log_rate, log_rate)
    step = torch.tensor(0.5, dtype=dtype, requires_grad=True)
    matrix, gain = model(step)
    (matrix.sum() + gain.sum()).backward()
    assert all(torch.isfinite(x).all() for x in (matrix, gain, step.grad, model.log_rate.grad, model.log_speed.grad))


@pytest.mark.parametrize("axis_model", CORRELATED)
@pytest.mark.parametrize("rate", [1e-4, 0.2, 10.0])
def test_gradients_of_correlated_motion(axis_model, rate):
    model = CoordinateUncoupled(axis_model(rate=rate, speed=0.7))
    inputs = torch.randn(3, 4), torch.randn(3, 2), torch.tensor(0.4)
    assert_gradients(model, lambda m, state, noise, dt: m.transition(dt)(state, noise), *inputs)
    assert_gradients(model, lambda m, state, noise, dt: m(state, dt).at_noise(noise), *inputs)


def test_gradients_of_the_random_walk():
    model, inputs = lehmann2007("CU-RWVE"), (torch.randn(3, 4), torch.randn(3, 2), torch.rand(3) + 0.1)
    assert_gradients(model, lambda m, state, noise, dt: m.transition(dt)(state, noise), *inputs)


@pytest.mark.parametrize("name", NAMES)
def test_parameters_are_reached_through_a_plain_dt(name):
    model = lehmann2007(name)
    model.transition(0.4)(torch.randn(5, 4), torch.randn(5, 2)).square().sum().backward()
    assert all(torch.isfinite(p.grad) and p.grad != 0 for p in model.parameters())


@pytest.mark.parametrize("name", NAMES)
def test_float32_is_close_to_float64(name):
    double, single = lehmann2007(name), lehmann2007(name).float()
    state, noise = torch.randn(9, 4), torch.randn(9, 2)
    moved = single.transition(0.032)(state.float(), noise.float())
    assert moved.dtype == torch.float32
    torch.testing.assert_close(moved.double(), double.transition(0.032)(state, noise), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_parameters_survive_saving(name):
    model, other = lehmann2007(name), lehmann2007(name)
    torch.nn.init.normal_(next(model.parameters()))
    other.load_state_dict(copy.deepcopy(model.state_dict()))
    torch.testing.assert_close(other.matrices(0.1), model.matrices(0.1))


@pytest.mark.parametrize("axes", [2, 3])
def test_kinematics_and_back(axes):
    model, state = lehmann2007("CU-LAN", axes), torch.randn(5, 2 * axes)
    kinematics = model.kinematics(state)
    torch.testing.assert_close(kinematics.position, state[:, :axes])
    torch.testing.assert_close(kinematics.velocity, state[:, axes:])
    torch.testing.assert_close(model.from_kinematics(kinematics), state)


def test_a_talker_looks_where_it_goes():
    kinematics = lehmann2007("CU-LAN").kinematics(torch.tensor([5.0, 1.0, -3.0, 2.0]))
    torch.testing.assert_close(kinematics.heading, torch.atan2(torch.tensor(2.0), torch.tensor(-3.0)))
    assert Kinematics(*kinematics[:2], torch.tensor(0.3)).heading == 0.3


class Steady(torch.nn.Module):
    """Axis model of a third order, written by a user."""

    order = 3

    def forward(self, dt):
        matrix = torch.tensor([[1.0, dt, dt**2 / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
        return matrix, torch.tensor([0.1, 0.2, 0.5])


def test_acceleration_follows_velocity_in_the_state():
    model = CoordinateUncoupled(Steady())
    state = torch.tensor([1.0, 2.0, 0.3, 0.4, 10.0, -10.0])
    moved = model.transition(0.1)(state, torch.tensor([1.0, 2.0]))
    torch.testing.assert_close(moved, torch.tensor([1.18, 2.19, 1.5, -0.2, 10.5, -9.0]))
    torch.testing.assert_close(model.from_kinematics(model.kinematics(state)), state * torch.tensor([1, 1, 1, 1, 0, 0]))


class Drift(Dynamics):
    """A user's own model: position (2,) [m] with a learnable step size."""

    state_dim = noise_dim = 2

    def __init__(self, scale):
        super().__init__()
        self.log_scale = torch.nn.Parameter(torch.tensor(scale).log())

    def forward(self, state, dt):
        return Independent(Normal(state + 0.5 * dt, self.log_scale.exp() * dt**0.5), 1)

    def kinematics(self, state):
        return Kinematics(state, torch.full_like(state, 0.5))

    def from_kinematics(self, kinematics):
        return kinematics.position


def test_a_users_own_model_is_driven_by_its_law():
    model, state, noise = Drift(0.3), torch.randn(3, 7, 2), torch.randn(3, 7, 2)
    moved = model.transition(0.25)(state, noise)
    torch.testing.assert_close(moved, state + 0.125 + 0.15 * noise)
    moved.sum().backward()
    torch.testing.assert_close(model.log_scale.grad, 0.15 * noise.sum())


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf")])
def test_rejects_values_that_are_not_positive(bad):
    with pytest.raises(InputError, match="rate must be finite and positive"):
        Langevin(rate=bad, speed=1.0)
    with pytest.raises(InputError, match="speed must be finite and positive"):
        TimeCorrelatedVelocity(rate=1.0, speed=bad)
    with pytest.raises(InputError, match="diffusion must be finite and positive"):
        RandomWalkVelocity(diffusion=bad)
    with pytest.raises(InputError, match="dt must be finite and positive"):
        lehmann2007("CU-LAN").transition(bad)
    with pytest.raises(InputError, match="dt must be finite and positive"):
        lehmann2007("CU-RWVE", dt=bad)


def test_rejects_a_wrong_state():
    with pytest.raises(ShapeError, match=r"state must have shape \(\.\.\., 4\), got \(7, 6\)"):
        lehmann2007("CU-LAN")(torch.zeros(7, 6), 0.1)
    with pytest.raises(ShapeError, match=r"state must have shape \(\.\.\., 6\), got \(7, 4\)"):
        lehmann2007("CU-LAN", 3).kinematics(torch.zeros(7, 4))
    with pytest.raises(ShapeError, match=r"velocity must have shape \(\.\.\., 2\), got \(3,\)"):
        lehmann2007("CU-LAN").from_kinematics(Kinematics(torch.zeros(2), torch.zeros(3)))


def test_rejects_a_number_of_axes_that_is_none():
    with pytest.raises(InputError, match="axes must be an integer of at least 1, got 0"):
        CoordinateUncoupled(Langevin(rate=1.0, speed=1.0), axes=0)


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(InputError, match=r"one of CU-LAN, CU-LAN-ORIG, CU-RWVE, .*got 'CU-RVWE'"):
        lehmann2007("CU-RVWE")


def test_repr_shows_physical_values():
    assert "diffusion=0.28 m/s per sqrt(s)" in repr(lehmann2007("CU-RWVE"))
    assert "TimeCorrelatedVelocity(rate=0.3/s, speed=0.7 m/s)" in repr(lehmann2007("CU-TCVE"))
