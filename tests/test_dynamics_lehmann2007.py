"""Table 1 of Lehmann and Johansson (2007): names, values, and the steps they give."""

import math
import typing

import numpy as np
import pytest
import torch
from oracles import lehmann_matrices

from probtrack.dynamics import CoordinateUncoupled, Curvilinear, Lehmann2007Model, lehmann2007
from probtrack.errors import InputError, SingularLawError
from probtrack.geometry import wrap_angle

UNCOUPLED = {  # at a step of T
    "CU-RWVE": lambda T: lehmann_matrices.random_walk_velocity(T, sigma=0.05),
    "CU-TCVE": lambda T: lehmann_matrices.time_correlated_velocity(T, beta=0.3, sigma=0.7),
    "CU-TCAC": lambda T: lehmann_matrices.time_correlated_acceleration(T, beta=30, sigma=2),
    "CU-LAN": lambda T: lehmann_matrices.langevin(T, beta=0.2, sigma=0.7),
    "CU-LAN-ORIG": lambda T: lehmann_matrices.langevin(T, beta=10, sigma=0.8),
}
CURVILINEAR = {
    "CL-RWVE-RWTU": lambda *a: lehmann_matrices.walk_turn_angle(*a, sigma_v=0.7, sigma_phi=2),
    "CL-TCVE-TCTU": lambda *a: lehmann_matrices.correlated_turn_angle(
        *a, sigma_v=0.9, beta_v=0.2, sigma_phi=3, beta_phi=2
    ),
    "CL-RWVE-RAAC": lambda *a: lehmann_matrices.random_acceleration(*a, sigma_v=0.07, sigma_a=1.5),
    "CL-RWVE-RWAC": lambda *a: lehmann_matrices.walk_acceleration(*a, sigma_v=0.3, sigma_a=2),
    "CL-TCVE-TCAC": lambda *a: lehmann_matrices.correlated_acceleration(
        *a, sigma_v=3, beta_v=0.15, sigma_a=3, beta_a=1
    ),
}
PER_STEP = ["CU-RWVE", "CL-RWVE-RWTU", "CL-RWVE-RAAC", "CL-RWVE-RWAC"]
LARGE_SPEED = 5.0
GUARD = 2e-6  # the guard takes (0.02 / 5)^2 of a turn of at most 0.06 rad


def walker(name):
    """State (x, y, v, phi[, a]) of a fast talker."""
    return torch.tensor([1.3, -0.7, LARGE_SPEED, 2.9, 0.8])[: lehmann2007(name).state_dim]


def test_names_are_those_of_the_table():
    assert typing.get_args(Lehmann2007Model) == (*UNCOUPLED, *CURVILINEAR)


@pytest.mark.parametrize("T", [0.032, 0.02])
@pytest.mark.parametrize("name", UNCOUPLED)
def test_uncoupled_models_are_the_printed_matrices(name, T):
    for made, printed in zip(lehmann2007(name, dt=T).matrices(T), UNCOUPLED[name](T), strict=True):
        torch.testing.assert_close(made, torch.as_tensor(printed))


@pytest.mark.parametrize("name", UNCOUPLED)
def test_a_third_axis_moves_like_the_others(name):
    model, plane = lehmann2007(name, 3), lehmann2007(name)
    state, noise = torch.randn(7, model.state_dim), torch.randn(7, model.noise_dim)
    moved = model.transition(0.032)(state, noise).unflatten(-1, (-1, 3))
    state, noise = state.unflatten(-1, (-1, 3)), noise.unflatten(-1, (-1, 3))
    for pair in ([0, 1], [2, 0]):
        flat = plane.transition(0.032)(state[..., pair].flatten(1), noise[..., pair].flatten(1))
        torch.testing.assert_close(moved[..., pair].flatten(1), flat)


@pytest.mark.parametrize("T", [0.032, 0.02])
@pytest.mark.parametrize("name", CURVILINEAR)
@pytest.mark.parametrize("u", [(0.0, 0.0), (1.0, 0.5), (-2.0, -1.5), (0.4, 2.5)])
def test_curvilinear_models_are_the_printed_maps(name, T, u):
    moved = lehmann2007(name, dt=T).transition(T)(walker(name), torch.tensor(u)).detach().numpy()
    printed = CURVILINEAR[name](walker(name).numpy(), np.array(u), T)
    turn = (moved[3] - printed[3] + math.pi) % (2 * math.pi) - math.pi
    assert abs(turn) < GUARD
    np.testing.assert_allclose(np.delete(moved, 3), np.delete(printed, 3), rtol=GUARD)


@pytest.mark.parametrize("name", CURVILINEAR)
def test_height_joins_the_printed_maps(name):
    flat, deep = lehmann2007(name), lehmann2007(name, 3)
    state, noise = torch.randn(7, flat.state_dim), torch.randn(7, 2)
    lifted = torch.cat([state[:, :2], torch.randn(7, 1), state[:, 2:], torch.randn(7, 1)], -1)
    moved = deep.transition(0.032)(lifted, torch.cat([noise, torch.randn(7, deep.noise_dim - 2)], -1))
    walk = torch.cat([moved[:, :2], moved[:, 3:-1]], -1)
    torch.testing.assert_close(walk, flat.transition(0.032)(state, noise))


@pytest.mark.parametrize("name", [*UNCOUPLED, *CURVILINEAR])
def test_step_of_the_table_matters_to_what_is_per_step_only(name):
    model, other = lehmann2007(name), lehmann2007(name, dt=0.02)
    same = [torch.equal(p, q) for p, q in zip(model.parameters(), other.parameters(), strict=True)]
    assert same == [name not in PER_STEP] * len(same)


@pytest.mark.parametrize("name", [*UNCOUPLED, *CURVILINEAR])
@pytest.mark.parametrize("axes", [2, 3])
def test_models_walk_in_the_plane_and_in_space(name, axes):
    model = lehmann2007(name, axes)
    assert isinstance(model, CoordinateUncoupled if name in UNCOUPLED else Curvilinear)
    assert model.axes == axes
    moved = model(torch.randn(7, model.state_dim), 0.032).sample((3,))
    assert moved.shape == (3, 7, model.state_dim)
    assert model.kinematics(moved).position.shape == (3, 7, axes)


@pytest.mark.parametrize("name", UNCOUPLED)
def test_printed_steps_have_no_density_and_exact_ones_have(name):
    law = lehmann2007(name, printed=False)
    state = torch.randn(7, law.state_dim)
    assert law(state, 0.032).log_prob(state).shape == (7,)
    with pytest.raises(SingularLawError):
        lehmann2007(name)(state, 0.032).log_prob(state)


@pytest.mark.parametrize("name", UNCOUPLED)
def test_exact_models_keep_the_values_of_the_table(name):
    printed, exact = lehmann2007(name), lehmann2007(name, printed=False)
    assert [p.item() for p in printed.parameters()] == [p.item() for p in exact.parameters()]
    F, G = exact.matrices(0.032)
    printed_F, printed_G = printed.matrices(0.032)
    torch.testing.assert_close((G @ G.T)[-1, -1], (printed_G @ printed_G.T)[-1, -1])
    torch.testing.assert_close(F[-1], printed_F[-1])


@pytest.mark.parametrize("name", ["CL-RWVE-RWTU", "CL-RWVE-RAAC", "CL-RWVE-RWAC", "CL-TCVE-TCAC"])
def test_directions_stay_on_the_circle(name):
    model = lehmann2007(name)
    state = 2 * torch.randn(400, model.state_dim)
    for _ in range(20):
        state = model(state, 0.032).sample()
    torch.testing.assert_close(wrap_angle(state[:, 3]), state[:, 3])
    assert state[:, 3].abs().max() > 3


def test_an_unknown_name_lists_the_known_ones():
    known = ", ".join([*UNCOUPLED, *CURVILINEAR])
    with pytest.raises(InputError, match=f"name must be one of {known}, got 'CU-RVWE'"):
        lehmann2007("CU-RVWE")


@pytest.mark.parametrize("name", ["CU-RWVE", "CU-LAN", "CL-RWVE-RAAC"])
@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf")])
def test_a_step_that_is_none_is_named(name, bad):
    with pytest.raises(InputError, match=f"dt must be finite and positive, got {bad}"):
        lehmann2007(name, dt=bad)


@pytest.mark.parametrize("name", CURVILINEAR)
def test_curvilinear_models_have_the_printed_step_only(name):
    with pytest.raises(InputError, match=f"printed must be True for {name}"):
        lehmann2007(name, printed=False)


@pytest.mark.parametrize("name", CURVILINEAR)
@pytest.mark.parametrize("bad", [1, 4, 2.5])
def test_a_walk_has_two_or_three_axes(name, bad):
    with pytest.raises(InputError, match=f"axes must be 2 or 3, got {bad}"):
        lehmann2007(name, bad)


def test_repr_shows_physical_values():
    assert "RandomWalk(diffusion=0.28)" in repr(lehmann2007("CU-RWVE"))
    assert "TimeCorrelated(rate=0.3/s, std=0.7)" in repr(lehmann2007("CU-TCVE"))
    assert "min_speed=0.02 m/s" in repr(lehmann2007("CL-RWVE-RAAC"))
