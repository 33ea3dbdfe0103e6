"""Coordinate-uncoupled motion: against the printed matrices, its laws, and the interface of `Dynamics`."""

import pytest
import torch
from oracles import lehmann_matrices
from properties import (
    assert_density_gradients,
    assert_gradients,
    assert_moments,
    assert_shapes,
    assert_step_leaves_its_inputs_alone,
    assert_survives_saving,
)
from torch.distributions import Independent, MultivariateNormal, Normal

from probtrack.dynamics import (
    CoordinateUncoupled,
    DrivenAcceleration,
    DrivenVelocity,
    Dynamics,
    Kinematics,
    RandomWalk,
    TimeCorrelated,
    WhiteNoise,
    euler,
    exact,
    lehmann2007,
    single_noise,
)
from probtrack.errors import InputError, ShapeError, SingularLawError

MODELS = {
    "CU-RWVE": lambda **kwargs: lehmann2007("CU-RWVE", **kwargs),
    "CU-TCVE": lambda **kwargs: lehmann2007("CU-TCVE", **kwargs),
    "CU-TCAC": lambda **kwargs: lehmann2007("CU-TCAC", **kwargs),
    "CU-LAN": lambda **kwargs: lehmann2007("CU-LAN", **kwargs),
    "exact velocity": lambda axes=2: CoordinateUncoupled(DrivenVelocity(TimeCorrelated(1.7, 0.6)), axes),
    "exact acceleration": lambda axes=2: CoordinateUncoupled(DrivenAcceleration(TimeCorrelated(1.7, 0.6)), axes),
    "exact walk": lambda axes=2: CoordinateUncoupled(DrivenVelocity(RandomWalk(0.3)), axes),
}
EXACT = [name for name in MODELS if name.startswith("exact")]
every_model = pytest.mark.parametrize("make", MODELS.values(), ids=MODELS)
exact_models = pytest.mark.parametrize("name", EXACT)


def inputs(model, *batch):
    return torch.randn(*batch, model.state_dim), torch.randn(*batch, model.noise_dim)


def assert_matrices(axis_model, dt, expected):
    for made, printed in zip(CoordinateUncoupled(axis_model).matrices(dt), expected, strict=True):
        torch.testing.assert_close(made, torch.as_tensor(printed))


@pytest.mark.parametrize("dt", [0.004, 0.5])
def test_steps_are_the_printed_matrices(dt):
    walk, correlated = RandomWalk(0.3), TimeCorrelated(rate=1.7, std=0.6)
    T = {"T": dt, "beta": 1.7, "sigma": 0.6}
    assert_matrices(DrivenVelocity(walk, single_noise), dt, lehmann_matrices.random_walk_velocity(dt, 0.3 * dt**0.5))
    assert_matrices(DrivenVelocity(correlated, single_noise), dt, lehmann_matrices.time_correlated_velocity(**T))
    assert_matrices(DrivenVelocity(correlated, euler), dt, lehmann_matrices.langevin(**T))
    acceleration = DrivenAcceleration(correlated, single_noise)
    assert_matrices(acceleration, dt, lehmann_matrices.time_correlated_acceleration(**T))


@pytest.mark.parametrize("discretise", [euler, single_noise, exact])
def test_speed_is_the_stationary_speed(discretise):
    matrix, gain = DrivenVelocity(TimeCorrelated(rate=3.0, std=1.5), discretise)(0.07)
    stationary = matrix[1, 1] ** 2 * 1.5**2 + gain[1].square().sum()
    torch.testing.assert_close(stationary, torch.tensor(1.5**2))


@pytest.mark.parametrize("discretise", [single_noise, exact])
def test_velocity_of_two_half_steps_is_that_of_one_step(discretise):
    half, whole = (DrivenVelocity(TimeCorrelated(rate=3.0, std=1.5), discretise)(dt)[0] for dt in (0.05, 0.1))
    torch.testing.assert_close(half @ half, whole)


@every_model
@pytest.mark.parametrize("axes", [2, 3])
def test_law_is_the_matrices_applied(make, axes):
    model = make(axes=axes)
    state, (F, G) = torch.randn(5, model.state_dim), model.matrices(0.4)
    law = model(state, 0.4)
    assert_shapes(law, (5,), (model.state_dim,))
    torch.testing.assert_close(law.mean, torch.stack([F @ x for x in state]))
    torch.testing.assert_close(law.covariance_matrix[3], G @ G.T)


def test_samples_have_the_moments_of_the_law():
    model = CoordinateUncoupled(DrivenVelocity(TimeCorrelated(rate=2.0, std=0.7), euler))
    law = model(torch.tensor([1.0, -2.0, 0.3, 0.8]), 0.4)
    F, G = (torch.as_tensor(x) for x in lehmann_matrices.langevin(0.4, beta=2.0, sigma=0.7))
    assert_moments(law, F @ torch.tensor([1.0, -2.0, 0.3, 0.8]), G @ G.T)


@exact_models
@pytest.mark.parametrize("axes", [2, 3])
def test_exact_motion_has_the_density_of_its_moments(name, axes):
    model = MODELS[name](axes=axes)
    law = model(torch.randn(5, model.state_dim), 0.4)
    full, value = MultivariateNormal(law.mean, law.covariance_matrix), law.sample((3,))
    torch.testing.assert_close(law.log_prob(value), full.log_prob(value))


@exact_models
def test_coordinates_of_exact_motion_are_independent(name):
    model, one = MODELS[name](axes=3), MODELS[name](axes=1)
    state, value = torch.randn(5, model.state_dim), torch.randn(5, model.state_dim)
    each = [one(state[:, a::3], 0.4).log_prob(value[:, a::3]) for a in range(3)]
    torch.testing.assert_close(model(state, 0.4).log_prob(value), sum(each))


@pytest.mark.parametrize("name", ["CU-RWVE", "CU-TCVE", "CU-TCAC", "CU-LAN"])
def test_printed_motion_has_no_density(name):
    model = lehmann2007(name)
    with pytest.raises(SingularLawError, match=f"2 noise numbers drive {model.state_dim} variables"):
        model(torch.zeros(model.state_dim), 0.032).log_prob(torch.zeros(model.state_dim))


@every_model
@pytest.mark.parametrize("batch", [(), (7,), (3, 7), (2, 3, 7)])
def test_transition_draws_from_the_law(make, batch):
    model = make(axes=3)
    state, noise = inputs(model, *batch)
    torch.testing.assert_close(model.transition(0.4)(state, noise), model(state, 0.4).at_noise(noise))
    torch.testing.assert_close(model.transition(0.4)(state, noise), Dynamics.transition(model, 0.4)(state, noise))


@every_model
@pytest.mark.parametrize("batch", [(7,), (3, 7)])
def test_variables_come_first_in_memory(make, batch):
    model = make()
    moved = model.transition(0.4)(*inputs(model, *batch))
    assert moved.movedim(-1, 0).is_contiguous()


@every_model
def test_transition_leaves_its_inputs_alone(make):
    model = make()
    assert_step_leaves_its_inputs_alone(model.transition(0.4), *inputs(model, 7))


@every_model
def test_noise_may_have_more_draws_than_states(make):
    model = make()
    state, noise = torch.randn(7, model.state_dim), torch.randn(5, 7, model.noise_dim)
    many = model.transition(0.4)(state, noise)
    torch.testing.assert_close(many[3], model.transition(0.4)(state, noise[3]))


@every_model
def test_each_talker_may_have_its_own_dt(make):
    model, dt = make(), torch.tensor([0.01, 0.1, 1.0])
    state, noise = inputs(model, 3)
    law, moved = model(state, dt), model.transition(dt)(state, noise)
    for i in range(3):
        one = model(state[i], float(dt[i]))
        torch.testing.assert_close((law.mean[i], law.gain[i]), (one.mean, one.gain))
        torch.testing.assert_close(moved[i], one.at_noise(noise[i]))


@every_model
def test_each_recording_may_have_its_own_dt(make):
    model, dt = make(), torch.tensor([0.1, 0.2, 0.3])
    state, noise = inputs(model, 3, 7)
    moved = model.transition(dt[:, None])(state, noise)
    torch.testing.assert_close(moved[2], model.transition(0.3)(state[2], noise[2]))


@every_model
def test_dt_as_number_and_as_tensor_agree(make):
    model = make()
    torch.testing.assert_close(model.matrices(0.032), model.matrices(torch.tensor(0.032)), rtol=0, atol=0)
    assert model.matrices(torch.full((3, 1), 0.032))[0].shape == (3, 1, model.state_dim, model.state_dim)


@every_model
def test_permuting_particles_permutes_what_becomes_of_them(make):
    model, order = make(), torch.randperm(6)
    step, (state, noise) = model.transition(0.1), inputs(model, 6)
    torch.testing.assert_close(step(state[order], noise[order]), step(state, noise)[order])


def turned(vectors, angle):
    """Pairs of coordinates (..., 2 K) rotated in the plane."""
    c, s = torch.tensor(angle).cos(), torch.tensor(angle).sin()
    pairs = vectors.unflatten(-1, (-1, 2)) @ torch.stack([torch.stack([c, s]), torch.stack([-s, c])])
    return pairs.flatten(-2)


@every_model
def test_rotating_the_room_rotates_the_motion(make):
    model = make()
    step, (state, noise) = model.transition(0.1), inputs(model, 6)
    torch.testing.assert_close(step(turned(state, 0.9), turned(noise, 0.9)), turned(step(state, noise), 0.9))


@pytest.mark.parametrize("discretise", [single_noise, euler])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("rate", [1e-30, 1e-12, 1e-6])
def test_slow_forgetting_is_constant_velocity(discretise, rate, dtype):
    matrix, gain = DrivenVelocity(TimeCorrelated(rate=rate, std=2.0), discretise).to(dtype)(0.5)
    torch.testing.assert_close(matrix, torch.tensor([[1.0, 0.5], [0.0, 1.0]], dtype=dtype), rtol=1e-6, atol=0)
    sigma = 2 * (2 * 0.5 * rate) ** 0.5
    torch.testing.assert_close(gain, torch.tensor([[0.5 * sigma], [sigma]], dtype=dtype), rtol=1e-4, atol=0)


@pytest.mark.parametrize(("discretise", "drift"), [(single_noise, 1e-8), (euler, 0.0)])
def test_fast_forgetting_is_a_new_velocity_each_step(discretise, drift):
    matrix, gain = DrivenVelocity(TimeCorrelated(rate=1e8, std=2.0), discretise)(0.5)
    torch.testing.assert_close(matrix, torch.tensor([[1.0, drift], [0.0, 0.0]]))
    torch.testing.assert_close(gain, torch.tensor([[1.0], [2.0]]))


@every_model
def test_gradients_of_the_step_are_finite_differences(make):
    model, dt = make(), torch.tensor(0.4)
    assert_gradients(model, lambda m, state, noise, dt: m.transition(dt)(state, noise), *inputs(model, 3), dt)
    assert_gradients(model, lambda m, state, noise, dt: m(state, dt).at_noise(noise), *inputs(model, 3), dt)


@exact_models
def test_gradients_of_the_density_are_finite_differences(name):
    model, value = MODELS[name](), torch.randn(3, MODELS[name]().state_dim)
    dt = torch.tensor([0.2, 0.4, 0.9])
    assert_gradients(model, lambda m, state, value, dt: m(state, dt).log_prob(value), inputs(model, 3)[0], value, dt)
    assert_density_gradients(lambda state: model(state, 0.4), [inputs(model, 3)[0]], value)


@every_model
def test_parameters_are_reached_through_a_plain_dt(make):
    model = make()
    model.transition(0.4)(*inputs(model, 5)).square().sum().backward()
    assert all(torch.isfinite(p.grad) and p.grad != 0 for p in model.parameters())


@every_model
def test_float32_is_close_to_float64(make):
    double, single = make(), make().float()
    state, noise = inputs(double, 9)
    moved = single.transition(0.032)(state.float(), noise.float())
    assert moved.dtype == torch.float32
    torch.testing.assert_close(moved.double(), double.transition(0.032)(state, noise), rtol=1e-5, atol=1e-6)


@exact_models
def test_density_in_float32_is_close_to_float64(name):
    double, single = MODELS[name](), MODELS[name]().float()
    law = double(inputs(double, 9)[0], 0.032)
    noise = torch.randn(9, double.noise_dim)
    value = law.at_noise(noise) - law.mean
    rough = single(torch.zeros(9, double.state_dim, dtype=torch.float32), 0.032).log_prob(value.float())
    torch.testing.assert_close(rough.double(), law.log_prob(value + law.mean), rtol=1e-4, atol=1e-4)


@every_model
def test_parameters_survive_saving(make):
    assert_survives_saving(make(), lambda model: torch.cat(model.matrices(0.1), -1))


@every_model
@pytest.mark.parametrize("axes", [2, 3])
def test_kinematics_and_back(make, axes):
    model = make(axes=axes)
    state = torch.cat([torch.randn(5, 2 * axes), torch.zeros(5, model.state_dim - 2 * axes)], -1)
    kinematics = model.kinematics(state)
    torch.testing.assert_close(kinematics.position, state[:, :axes])
    torch.testing.assert_close(kinematics.velocity, state[:, axes : 2 * axes])
    torch.testing.assert_close(model.from_kinematics(kinematics), state)


def test_a_talker_looks_where_it_goes():
    kinematics = lehmann2007("CU-LAN").kinematics(torch.tensor([5.0, 1.0, -3.0, 2.0]))
    torch.testing.assert_close(kinematics.heading, torch.atan2(torch.tensor(2.0), torch.tensor(-3.0)))
    assert Kinematics(*kinematics[:2], torch.tensor(0.3)).heading == 0.3


def test_a_talker_who_stands_looks_along_x():
    velocity = torch.zeros(3, 2, requires_grad=True)
    heading = Kinematics(torch.randn(3, 2), velocity).heading
    heading.sum().backward()
    assert torch.equal(heading, torch.zeros(3))
    assert velocity.grad.isfinite().all()


class Steady(torch.nn.Module):
    """Axis model of a third order, written by a user."""

    def forward(self, dt):
        matrix = torch.tensor([[1.0, dt, dt**2 / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
        return matrix, torch.tensor([[0.1], [0.2], [0.5]])


def test_acceleration_follows_velocity_in_the_state():
    model = CoordinateUncoupled(Steady())
    state = torch.tensor([1.0, 2.0, 0.3, 0.4, 10.0, -10.0])
    moved = model.transition(0.1)(state, torch.tensor([1.0, 2.0]))
    torch.testing.assert_close(moved, torch.tensor([1.18, 2.19, 1.5, -0.2, 10.5, -9.0]))
    torch.testing.assert_close(model.from_kinematics(model.kinematics(state)), state * torch.tensor([1, 1, 1, 1, 0, 0]))


def test_noise_numbers_of_an_exact_step_come_derivative_by_derivative():
    model = CoordinateUncoupled(DrivenVelocity(RandomWalk(0.3)))
    second = model.transition(0.5)(torch.zeros(4), torch.tensor([0.0, 0.0, 1.0, 2.0]))
    assert (second[:2] == 0).all()
    torch.testing.assert_close(second[3], 2 * second[2])


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


@every_model
@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf")])
def test_a_time_that_is_none_is_named(make, bad):
    model = make()
    with pytest.raises(InputError, match=f"dt must be finite and positive, got {bad}"):
        model.transition(bad)
    with pytest.raises(InputError, match=f"dt must be finite and positive, got {bad}"):
        model(torch.zeros(model.state_dim), bad)


def test_rejects_a_wrong_state():
    with pytest.raises(ShapeError, match=r"state must have shape \(\.\.\., 4\), got \(7, 6\)"):
        lehmann2007("CU-LAN")(torch.zeros(7, 6), 0.1)
    with pytest.raises(ShapeError, match=r"state must have shape \(\.\.\., 9\), got \(7, 4\)"):
        lehmann2007("CU-TCAC", 3).kinematics(torch.zeros(7, 4))
    with pytest.raises(ShapeError, match=r"position must have shape \(\.\.\., 2\), got \(3,\)"):
        lehmann2007("CU-LAN").from_kinematics(Kinematics(torch.zeros(3), torch.zeros(2)))
    with pytest.raises(ShapeError, match=r"velocity must have shape \(\.\.\., 2\), got \(3,\)"):
        lehmann2007("CU-LAN").from_kinematics(Kinematics(torch.zeros(2), torch.zeros(3)))


@pytest.mark.parametrize("bad", [0, -2, 2.0, True])
def test_rejects_a_number_of_axes_that_is_none(bad):
    with pytest.raises(InputError, match=f"axes must be an integer of at least 1, got {bad}"):
        CoordinateUncoupled(DrivenVelocity(RandomWalk(0.3)), axes=bad)


class Given(torch.nn.Module):
    """Axis model of constant matrix and gain."""

    def __init__(self, *shapes):
        super().__init__()
        self.parts = tuple(torch.zeros(shape) for shape in shapes)

    def forward(self, _dt):
        return self.parts


@pytest.mark.parametrize(
    "shapes",
    [
        ((1, 1), (1, 1)),
        ((2, 3), (2, 1)),
        ((2, 3), (3, 1)),
        ((2, 2), (2,)),
        ((2, 2), (3, 1)),
        ((3, 3), (2, 1)),
        ((), ()),
    ],
)
def test_rejects_an_axis_model_of_wrong_shapes(shapes):
    with pytest.raises(ShapeError, match=r"matrix \(K, K\) and a gain \(K, J\) with K at least 2, got \("):
        CoordinateUncoupled(Given(*shapes))


def test_rejects_a_process_without_an_exact_step_at_once():
    with pytest.raises(InputError, match="WhiteNoise has no value in continuous time"):
        CoordinateUncoupled(DrivenVelocity(WhiteNoise(0.3)))
