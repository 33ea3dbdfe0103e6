"""Motion along a path: against the printed maps, around a standing talker, and the laws of a room."""

import math

import numpy as np
import pytest
import torch
from oracles import lehmann_matrices
from properties import (
    assert_each_talker_has_its_own_dt,
    assert_gradients,
    assert_step_leaves_its_inputs_alone,
    assert_survives_saving,
)

from probtrack.dynamics import (
    Curvilinear,
    DrivenAcceleration,
    DrivenVelocity,
    Dynamics,
    Kinematics,
    NormalAcceleration,
    RandomWalk,
    TimeCorrelated,
    TurnAngle,
    WhiteNoise,
    euler,
    lehmann2007,
)
from probtrack.errors import InputError, ShapeError, SingularLawError
from probtrack.geometry import wrap_angle

T = 0.25
MODELS = {
    "RWTU": lambda **k: Curvilinear(RandomWalk(0.3), TurnAngle(RandomWalk(0.9)), **k),
    "TCTU": lambda **k: Curvilinear(TimeCorrelated(0.8, 0.7), TurnAngle(TimeCorrelated(1.9, 1.2)), **k),
    "RAAC": lambda **k: Curvilinear(RandomWalk(0.3), NormalAcceleration(WhiteNoise(0.6)), **k),
    "RWAC": lambda **k: Curvilinear(RandomWalk(0.3), NormalAcceleration(RandomWalk(1.1)), **k),
    "TCAC": lambda **k: Curvilinear(TimeCorrelated(0.8, 0.7), NormalAcceleration(TimeCorrelated(1.4, 0.9)), **k),
}
PRINTED = {  # the same models at a step of T, where sigma per step is the rate per second times sqrt(T), or over it
    "RWTU": lambda *a: lehmann_matrices.walk_turn_angle(*a, T, sigma_v=0.3 * T**0.5, sigma_phi=0.9 * T**0.5),
    "TCTU": lambda *a: lehmann_matrices.correlated_turn_angle(*a, T, 0.7, 0.8, 1.2, 1.9),
    "RAAC": lambda *a: lehmann_matrices.random_acceleration(*a, T, sigma_v=0.3 * T**0.5, sigma_a=0.6 / T**0.5),
    "RWAC": lambda *a: lehmann_matrices.walk_acceleration(*a, T, sigma_v=0.3 * T**0.5, sigma_a=1.1 * T**0.5),
    "TCAC": lambda *a: lehmann_matrices.correlated_acceleration(*a, T, 0.7, 0.8, 0.9, 1.4),
}
STATES = {  # x, y, v, phi, a
    "forward": (1.3, -0.7, 1.1, 0.4, 0.8),
    "backward": (-2.0, 0.5, -0.9, 2.2, -0.6),
    "behind": (0.2, 3.1, 1.6, -3.1, 0.5),
    "fast": (0.4, 0.9, 6.0, 1.5, -2.0),
}
ACCELERATED = ["RAAC", "RWAC", "TCAC"]
every_model = pytest.mark.parametrize("make", MODELS.values(), ids=MODELS)
accelerated = pytest.mark.parametrize("make", [MODELS[name] for name in ACCELERATED], ids=ACCELERATED)


def sharp(name):
    """The model with next to no guard, as printed."""
    model = MODELS[name]()
    model.turning.min_speed = 1e-9
    return model


def inputs(model, *batch):
    return torch.randn(*batch, model.state_dim), torch.randn(*batch, model.noise_dim)


def heading_of(state):
    return torch.stack([state[..., 3].cos(), state[..., 3].sin()], -1)


@pytest.mark.parametrize("u", [(0.0, 0.0), (0.7, -0.4), (-0.9, 1.6)])
@pytest.mark.parametrize("state", STATES.values(), ids=STATES)
@pytest.mark.parametrize("name", MODELS)
def test_steps_are_the_printed_maps(name, state, u):
    model = sharp(name)
    moved = model.transition(T)(torch.tensor(state[: model.state_dim]), torch.tensor(u))
    printed = torch.as_tensor(PRINTED[name](np.array(state[: model.state_dim]), np.array(u)))
    others = [i for i in range(model.state_dim) if i != 3]
    torch.testing.assert_close(moved[others], printed[others])
    torch.testing.assert_close(heading_of(moved), heading_of(printed))


@pytest.mark.parametrize("speed", [0.1, -0.1, 0.2, 1.0, -3.0])
def test_guard_differs_from_the_printed_turn_by_less_than_1_percent_above_10_min_speeds(speed):
    turn = NormalAcceleration(WhiteNoise(0.6), min_speed=0.01).turn(T)
    direction, acceleration = turn([torch.zeros(()), torch.zeros(())], torch.tensor(speed), torch.tensor(0.02))
    ratio = direction / (T * acceleration / speed)
    assert 0.99 < ratio < 1


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_turning_is_fastest_at_the_min_speed(factor):
    turn = NormalAcceleration(WhiteNoise(0.6), min_speed=0.04).turn(T)
    direction, acceleration = turn([torch.zeros(()), torch.zeros(())], torch.tensor(0.04 * factor), torch.tensor(0.02))
    torch.testing.assert_close(direction, T * acceleration / 0.04 * factor / (1 + factor**2))


@accelerated
def test_a_step_is_continuous_through_standing(make):
    model = make()
    with torch.no_grad():
        drift = model.transition(T)(torch.zeros(5), torch.zeros(2))[2]
        noise = torch.tensor([-drift, 0.3])
    speeds = torch.linspace(-1e-3, 1e-3, 2001)
    state = torch.stack([torch.tensor([1.3, -0.7, v, 0.4, 0.8]) for v in speeds])
    moved = model.transition(T)(state, noise.expand(2001, 2)).detach()
    jumps = moved.diff(dim=0).abs().amax(0)  # of 1e-6 m/s; the steepest is that of phi, T a / v_0^2 = 2000 rad s/m
    assert (jumps[:3] < 1.1e-6).all()
    assert jumps[3] < 2e-6 * 2000
    assert moved.isfinite().all()


@accelerated
def test_who_stands_does_not_turn(make):
    model = make()
    state = torch.tensor([1.3, -0.7, 0.0, 0.4, 0.8])
    moved = model.transition(T)(state, torch.tensor([0.0, 0.3]))
    torch.testing.assert_close(moved[[0, 1, 2, 3]], state[[0, 1, 2, 3]])


@every_model
@pytest.mark.parametrize("speed", [0.0, 1e-6, -0.02, 1.3])
def test_gradients_are_finite_differences(make, speed):
    model = make(axes=3)
    state, noise = inputs(model, 2)
    state[:, 3], state[:, 4], noise[:, 0] = speed, 0.3 * state[:, 4], 0.0
    noise[:, 1] *= 0.02  # at v_0 the direction is steep, and finite differences must not cross its wrap
    dt = torch.tensor([0.2, 0.5])
    assert_gradients(model, lambda m, state, noise, dt: m.transition(dt)(state, noise), state, noise, dt)


@every_model
@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_standing_talker_has_values_and_gradients(make, axes, dtype):
    model = make(axes=axes).to(dtype)
    velocity = torch.zeros(7, axes, dtype=dtype, requires_grad=True)
    state = model.from_kinematics(Kinematics(torch.randn(7, axes, dtype=dtype), velocity))
    noise = torch.randn(7, model.noise_dim, dtype=dtype, requires_grad=True)
    moved = model.transition(T)(state, 0 * noise)
    (moved.sum() + model.kinematics(moved).heading.sum()).backward()
    assert moved.isfinite().all()
    assert all(x.grad.isfinite().all() for x in (velocity, noise, *model.parameters()))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "model",
    [
        Curvilinear(RandomWalk(0.0), TurnAngle(RandomWalk(0.0))),
        Curvilinear(TimeCorrelated(0.0, 0.7), TurnAngle(TimeCorrelated(1.9, 0.0))),
        Curvilinear(RandomWalk(0.0), NormalAcceleration(WhiteNoise(0.0))),
        Curvilinear(TimeCorrelated(0.8, 0.0), NormalAcceleration(TimeCorrelated(0.0, 0.0))),
    ],
    ids=["RWTU", "TCTU", "RAAC", "TCAC"],
)
def test_no_noise_leaves_nothing_to_chance(model, dtype):
    model = model.to(dtype)
    model.zero_grad()
    state = torch.randn(7, model.state_dim, dtype=dtype, requires_grad=True)
    one, other = (model.transition(T)(state, torch.randn(7, 2, dtype=dtype)) for _ in range(2))
    (one.sum() + other.sum()).backward()
    torch.testing.assert_close(one, other, rtol=0, atol=0)
    assert all(x.grad.isfinite().all() for x in (state, *model.parameters()))


@pytest.mark.parametrize("name", ["RWTU", "RAAC", "RWAC", "TCAC"])
def test_directions_stay_on_the_circle(name):
    model = MODELS[name]()
    state = torch.randn(200, model.state_dim)
    state[:, 3] = math.pi - 1e-3
    moved = model(state, T).sample()
    torch.testing.assert_close(wrap_angle(moved[:, 3]), moved[:, 3])
    assert (moved[:, 3] < 0).sum() > 20
    assert (moved[:, 3] > 0).sum() > 20


@pytest.mark.parametrize("name", ["RWTU", "RAAC", "RWAC", "TCAC"])
def test_a_turn_more_of_the_direction_is_none(name):
    model = MODELS[name]()
    state, noise = inputs(model, 7)
    turn = torch.zeros(model.state_dim)
    turn[3] = 2 * math.pi
    once, twice = model.transition(T)(state, noise), model.transition(T)(state + turn, noise)
    torch.testing.assert_close(twice[:, [0, 1, 2]], once[:, [0, 1, 2]])
    torch.testing.assert_close(heading_of(twice), heading_of(once))


def test_a_correlated_direction_is_not_wrapped():
    model = MODELS["TCTU"]()
    moved = model.transition(1e-6)(torch.tensor([0.0, 0.0, 1.0, 7.0]), torch.zeros(2))
    torch.testing.assert_close(moved[3], torch.tensor(7.0), rtol=2e-6, atol=0)


def rotated(state, angle):
    """State (..., D) of the same walk in a room turned by `angle`."""
    c, s = math.cos(angle), math.sin(angle)
    x, y, v, phi, *rest = state.unbind(-1)
    return torch.stack([c * x - s * y, s * x + c * y, v, wrap_angle(phi + angle), *rest], -1)


@pytest.mark.parametrize("name", ["RWTU", "RAAC", "RWAC", "TCAC"])
def test_rotating_the_room_rotates_the_walk(name):
    model = MODELS[name]()
    state, noise = inputs(model, 7)
    step = model.transition(T)
    torch.testing.assert_close(step(rotated(state, 1.9), noise), rotated(step(state, noise), 1.9))


def test_a_correlated_direction_prefers_the_x_axis():
    step, noise = MODELS["TCTU"]().transition(T), torch.zeros(2)
    state = torch.tensor([1.3, -0.7, 1.1, 0.0])
    along, across = step(state, noise), step(rotated(state, 1.9), noise)
    assert along[3] == 0
    torch.testing.assert_close(across[3], torch.tensor(1.9 * math.exp(-1.9 * T)))
    assert (across - rotated(along, 1.9)).abs().max() > 0.1


def stops(model, state, dt, seconds, n):
    """States (n, D) after that many seconds of steps of `dt`."""
    step, state = model.transition(dt), torch.tensor(state).expand(n, -1)
    with torch.no_grad():
        for _ in range(round(seconds / dt)):
            state = step(state, torch.randn(n, model.noise_dim))
    return state


@pytest.mark.parametrize(
    ("name", "v", "phi"),
    [
        ("RWTU", (1.1, 0.3 * T**0.5), (0.7, 0.9 * T**0.5)),
        (
            "TCTU",
            (1.1 * math.exp(-0.8 * T), 0.7 * (1 - math.exp(-1.6 * T)) ** 0.5),
            (0.7 * math.exp(-1.9 * T), 1.2 * (1 - math.exp(-3.8 * T)) ** 0.5),
        ),
    ],
)
def test_position_has_the_moments_of_its_step(name, v, phi):
    mean, covariance = lehmann_matrices.turned_position(0.4, -0.2, T, *v, *phi)
    position = stops(MODELS[name](), [0.4, -0.2, 1.1, 0.7], T, T, 40_000)[:, :2].numpy()
    products = np.einsum("ni,nj->nij", position - mean, position - mean)
    for draws, expected in [(position, mean), (products, covariance)]:
        assert (abs(draws.mean(0) - expected) < 5 * draws.std(0) / 200).all()


@every_model
def test_a_walk_is_alike_at_two_frame_rates(make):
    model, start = make(), torch.tensor([0.0, 0.0, 2.0, 0.3])
    state = [*start.tolist(), 0.0][: model.state_dim]
    fine, coarse = (stops(model, state, dt, 0.6, 8000)[:, :4] - start for dt in (0.005, 0.01))
    for a, b in [(fine, coarse), (fine.square(), coarse.square())]:
        error = 5 * (a.var(0) / 8000 + b.var(0) / 8000).sqrt()
        bias = 0.03 * a.abs().mean(0)  # of the first order in the step, a hundredth of the process's own second
        assert ((a.mean(0) - b.mean(0)).abs() < error + bias).all()


@every_model
@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize("batch", [(), (7,), (3, 7)])
def test_transition_draws_from_the_law(make, axes, batch):
    model = make(axes=axes)
    state, noise = inputs(model, *batch)
    law, moved = model(state, T), model.transition(T)(state, noise)
    assert law.batch_shape == batch
    assert law.sample((4,)).shape == (4, *batch, model.state_dim)
    torch.testing.assert_close(law.at_noise(noise), moved)
    torch.testing.assert_close(Dynamics.transition(model, T)(state, noise), moved)


@every_model
@pytest.mark.parametrize("axes", [2, 3])
def test_each_talker_may_have_its_own_dt(make, axes):
    model, dt = make(axes=axes), torch.tensor([0.01, 0.1, 1.0])
    state, noise = inputs(model, 5, 3)
    assert_each_talker_has_its_own_dt(model, state, noise, dt)
    torch.testing.assert_close(model(state, dt).at_noise(noise), model.transition(dt)(state, noise))


@every_model
@pytest.mark.parametrize("axes", [2, 3])
def test_one_state_may_take_steps_of_several_lengths(make, axes):
    model, dt = make(axes=axes), torch.tensor([0.1, 1.0, 0.3])
    state, noise = torch.randn(model.state_dim), torch.randn(3, model.noise_dim)
    law = model(state, dt)
    assert law.batch_shape == (3,)
    torch.testing.assert_close(law.at_noise(noise)[1], model.transition(1.0)(state, noise[1]))


@every_model
@pytest.mark.parametrize("axes", [2, 3])
def test_noise_may_have_more_draws_than_states(make, axes):
    model = make(axes=axes)
    state, noise = torch.randn(7, model.state_dim), torch.randn(5, 7, model.noise_dim)
    step = model.transition(T)
    torch.testing.assert_close(step(state, noise)[3], step(state, noise[3]))


@every_model
@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize("batch", [(7,), (3, 7)])
def test_variables_come_first_in_memory(make, axes, batch):
    model = make(axes=axes)
    assert model.transition(T)(*inputs(model, *batch)).movedim(-1, 0).is_contiguous()


@every_model
@pytest.mark.parametrize("axes", [2, 3])
def test_transition_leaves_its_inputs_alone(make, axes):
    model = make(axes=axes)
    assert_step_leaves_its_inputs_alone(model.transition(T), *inputs(model, 7))


@every_model
def test_permuting_particles_permutes_what_becomes_of_them(make):
    model, order = make(axes=3), torch.randperm(7)
    state, noise = inputs(model, 7)
    step = model.transition(T)
    torch.testing.assert_close(step(state[order], noise[order]), step(state, noise)[order])


HEIGHTS = {
    "driven velocity": lambda: DrivenVelocity(TimeCorrelated(0.9, 0.2)),
    "one noise": lambda: DrivenVelocity(RandomWalk(0.2), euler),
    "driven acceleration": lambda: DrivenAcceleration(TimeCorrelated(0.9, 0.2)),
}


@every_model
@pytest.mark.parametrize("height", HEIGHTS.values(), ids=HEIGHTS)
def test_height_goes_its_own_way(make, height):
    flat, deep, (matrix, gain) = make(), make(axes=3, height=height()), height()(T)
    state, noise = inputs(deep, 7)
    moved, first = deep.transition(T)(state, noise), flat.state_dim + 1
    walk = flat.transition(T)(torch.cat([state[:, :2], state[:, 3:first]], -1), noise[:, :2])
    torch.testing.assert_close(torch.cat([moved[:, :2], moved[:, 3:first]], -1), walk)
    vertical = torch.cat([state[:, 2:3], state[:, first:]], -1) @ matrix.mT + noise[:, 2:] @ gain.mT
    torch.testing.assert_close(torch.cat([moved[:, 2:3], moved[:, first:]], -1), vertical)


def test_height_is_slow_unless_told():
    model = MODELS["RWTU"](axes=3)
    rise = stops(model, [0.0, 0.0, 1.6, 1.0, 0.3, 0.0], T, 40.0, 4000)[:, 5]
    error = 0.05 * (2 * 4000) ** -0.5
    assert abs(rise.std() - 0.05) < 5 * error
    torch.testing.assert_close(model.height(1.0)[0][1, 1], torch.tensor(math.exp(-1.0)))


@every_model
def test_negative_speed_walks_backwards(make):
    model = make()
    state = torch.tensor([0.0, 0.0, -0.8, 0.6, 0.0])[: model.state_dim]
    kinematics, moved = model.kinematics(state), model.transition(1e-6)(state, torch.zeros(2)) / 1e-6
    backwards = -0.8 * torch.tensor([math.cos(0.6), math.sin(0.6)])
    torch.testing.assert_close(kinematics.velocity, backwards)
    torch.testing.assert_close(moved[:2], backwards, rtol=1e-5, atol=0)
    torch.testing.assert_close(kinematics.heading, torch.tensor(0.6 - math.pi))


@every_model
@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize("height", [None, HEIGHTS["driven acceleration"]()])
def test_kinematics_and_back(make, axes, height):
    model = make(axes=axes, height=height if axes == 3 else None).double()
    kinematics = Kinematics(torch.randn(3, 7, axes), torch.randn(3, 7, axes))
    state = model.from_kinematics(kinematics)
    assert state.shape == (3, 7, model.state_dim)
    assert (state[..., axes] > 0).all()
    torch.testing.assert_close(model.kinematics(state)[:2], kinematics[:2])
    torch.testing.assert_close(model.from_kinematics(model.kinematics(state)), state)


@every_model
@pytest.mark.parametrize("axes", [2, 3])
def test_who_stands_has_no_speed_and_faces_along_x(make, axes):
    position = torch.randn(7, axes)
    state = make(axes=axes).from_kinematics(Kinematics(position, torch.zeros(7, axes)))
    torch.testing.assert_close(state[:, :axes], position)
    torch.testing.assert_close(state[:, axes:], torch.zeros_like(state[:, axes:]), rtol=0, atol=1e-18)


@every_model
@pytest.mark.parametrize("axes", [2, 3])
def test_position_is_the_walk_of_the_new_velocity(make, axes):
    model = make(axes=axes)
    state, noise = inputs(model, 7)
    moved = model.transition(T)(state, noise)
    way = T * model.kinematics(moved).velocity
    torch.testing.assert_close((moved - state)[:, :2], way[:, :2])  # eq. 24


@every_model
def test_there_is_no_density(make):
    model = make(axes=3)
    law = model(torch.randn(7, model.state_dim), T)
    assert law.has_rsample
    with pytest.raises(SingularLawError, match=f"no density: 4 noise numbers drive {model.state_dim} variables"):
        law.log_prob(law.sample())


@every_model
@pytest.mark.parametrize("axes", [2, 3])
def test_float32_is_close_to_float64(make, axes):
    double, single = make(axes=axes), make(axes=axes).float()
    state, noise = inputs(double, 9)
    moved = single.transition(0.032)(state.float(), noise.float())
    assert moved.dtype == torch.float32
    assert single(state.float(), 0.032).sample().dtype == torch.float32
    torch.testing.assert_close(moved.double(), double.transition(0.032)(state, noise), rtol=1e-5, atol=1e-5)


@every_model
def test_parameters_survive_saving(make):
    model = make(axes=3)
    state, noise = inputs(model, 7)
    assert_survives_saving(model, lambda model: model.transition(T)(state, noise))


@every_model
def test_parameters_are_reached_through_samples(make):
    model = make()
    torch.manual_seed(1)
    model(torch.randn(5, model.state_dim), T).rsample((3,)).square().sum().backward()
    assert all(torch.isfinite(p.grad) and p.grad != 0 for p in model.parameters())


@pytest.mark.parametrize("bad", [0, 1, 4, 2.0, True])
def test_rejects_a_number_of_axes_that_is_none(bad):
    with pytest.raises(InputError, match=f"axes must be 2 or 3, got {bad}"):
        MODELS["RWTU"](axes=bad)


def test_rejects_a_height_in_the_plane():
    with pytest.raises(InputError, match="height needs axes=3, got axes=2"):
        MODELS["RWTU"](height=DrivenVelocity(RandomWalk(0.1)))


class Flat(torch.nn.Module):
    def forward(self, _dt):
        return torch.zeros(1, 1), torch.zeros(1, 1)


def test_rejects_a_height_that_is_no_axis_model():
    with pytest.raises(ShapeError, match=r"with K at least 2, got \(1, 1\) and \(1, 1\)"):
        MODELS["RWTU"](axes=3, height=Flat())


@pytest.mark.parametrize("bad", [0.0, -0.1, float("nan"), float("inf")])
def test_rejects_a_min_speed_that_is_none(bad):
    with pytest.raises(InputError, match=f"min_speed must be finite and positive, got {bad}"):
        NormalAcceleration(WhiteNoise(0.6), min_speed=bad)


@every_model
@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf")])
def test_a_time_that_is_none_is_named(make, bad):
    with pytest.raises(InputError, match=f"dt must be finite and positive, got {bad}"):
        make().transition(bad)


@every_model
def test_rejects_a_wrong_state(make):
    model = make(axes=3)
    D, wrong = model.state_dim, torch.zeros(7, model.state_dim - 1)
    with pytest.raises(ShapeError, match=rf"state must have shape \(\.\.\., {D}\), got \(7, {D - 1}\)"):
        model(wrong, T)
    with pytest.raises(ShapeError, match=rf"state must have shape \(\.\.\., {D}\), got \(7, {D - 1}\)"):
        model.kinematics(wrong)
    with pytest.raises(ShapeError, match=r"velocity must have shape \(\.\.\., 3\), got \(2,\)"):
        model.from_kinematics(Kinematics(torch.zeros(3), torch.zeros(2)))
    with pytest.raises(ShapeError, match=r"position must have shape \(\.\.\., 3\), got \(2,\)"):
        model.from_kinematics(Kinematics(torch.zeros(2), torch.zeros(3)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("speed", [0.0, 1e-40, 1e-30, 1e-20, 1e-12, 9e-7, 2e-6])
def test_a_talker_who_has_all_but_stopped_has_finite_gradients(speed, dtype):
    velocity = torch.tensor([speed, -speed], dtype=dtype, requires_grad=True)
    model = lehmann2007("CL-RWVE-RAAC").to(dtype)
    state = model.from_kinematics(Kinematics(torch.zeros(2, dtype=dtype), velocity))
    (gradient,) = torch.autograd.grad(state.sum(), velocity)
    assert (gradient.abs() <= 1.1e6).all()
    if velocity[0] != 0:
        torch.testing.assert_close(state[3], torch.tensor(-math.pi / 4, dtype=dtype))


def test_a_talker_who_stands_faces_where_it_looks():
    standing = Kinematics(
        torch.zeros(3, 2), torch.tensor([[0.0, -0.0], [-0.0, 0.0], [0.0, 1.0]]), torch.full((3,), 2.0)
    )
    phi = lehmann2007("CL-RWVE-RWTU").from_kinematics(standing)[:, 3]
    torch.testing.assert_close(phi, torch.tensor([2.0, 2.0, math.pi / 2]))
    assert (lehmann2007("CL-RWVE-RWTU").from_kinematics(standing._replace(modelled_heading=None))[:2, 3] == 0).all()


def test_rejects_parts_of_another_kind():
    with pytest.raises(InputError, match=r"turning a Turning such as TurnAngle.*got RandomWalk and RandomWalk"):
        Curvilinear(RandomWalk(0.3), RandomWalk(0.2))
    with pytest.raises(InputError, match=r"speed must be a ScalarProcess.*got float and TurnAngle"):
        Curvilinear(1.0, TurnAngle(RandomWalk(0.2)))
    with pytest.raises(InputError, match="min_speed must be at least 1e-6 m/s, got 1e-30"):
        NormalAcceleration(RandomWalk(0.2), min_speed=1e-30)
