"""A head that turns apart from the body: against the printed steps, around the circle, on any motion."""

import math
from typing import NamedTuple

import numpy as np
import pytest
import torch
from properties import (
    assert_each_talker_has_its_own_dt,
    assert_gradients,
    assert_normalised,
    assert_step_leaves_its_inputs_alone,
    assert_survives_saving,
    box,
)

from probtrack.dynamics import (
    CoordinateUncoupled,
    DrivenAcceleration,
    DrivenVelocity,
    Dynamics,
    Kinematics,
    RandomWalk,
    TimeCorrelated,
    WithHeading,
    lehmann2007,
)
from probtrack.errors import InputError, ShapeError, SingularLawError
from probtrack.geometry import wrap_angle
from probtrack.switching import MarkovChain, SwitchingDynamics

MOTIONS = {
    "uncoupled": lambda: lehmann2007("CU-LAN"),
    "exact": lambda: lehmann2007("CU-LAN", printed=False),
    "curvilinear": lambda: lehmann2007("CL-RWVE-RAAC"),
    "in space": lambda: lehmann2007("CU-TCAC", 3),
    "curvilinear in space": lambda: lehmann2007("CL-TCVE-TCAC", 3),
}
HEADS = {
    "printed": lambda: None,
    "exact": lambda: DrivenVelocity(TimeCorrelated(2.0, 1.5)),
    "driven acceleration": lambda: DrivenAcceleration(TimeCorrelated(2.0, 1.5)),
}
every_motion = pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
every_head = pytest.mark.parametrize("head", HEADS.values(), ids=HEADS)


def inputs(model, *batch):
    return torch.randn(*batch, model.state_dim), torch.randn(*batch, model.noise_dim)


def langevin_turn(theta, rate, u, T):
    """S2, section 4.2: the Langevin step of heading and its rate, by hand, with its wrap-around."""
    a = np.exp(-10.0 * T)
    rate = a * rate + 0.1 * np.sqrt(1 - a**2) * u
    theta = theta + T * rate
    return np.array([theta - 2 * np.pi * np.floor((theta + np.pi) / (2 * np.pi)), rate])


@pytest.mark.parametrize("T", [0.032, 0.4])
@pytest.mark.parametrize(
    ("theta", "rate", "u"), [(0.3, -2.0, 0.7), (3.1, 9.0, 1.2), (-3.1, -9.0, -0.4), (7.0, 0.2, 3.0)]
)
@every_motion
def test_the_head_turns_as_printed(motion, theta, rate, u, T):
    model = WithHeading(motion())
    state, noise = inputs(model)
    state[-2:], noise[-1] = torch.tensor([theta, rate]), u
    moved = model.transition(T)(state, noise)
    torch.testing.assert_close(moved[-2:], torch.as_tensor(langevin_turn(theta, rate, u, T)))


@every_head
@every_motion
def test_the_body_moves_as_it_would_without_a_head(motion, head):
    model, alone = WithHeading(motion(), head()), motion()
    D, J = alone.state_dim, alone.noise_dim
    state, noise = inputs(model, 7)
    moved = model.transition(0.1)(state, noise)
    torch.testing.assert_close(moved[:, :D], alone.transition(0.1)(state[:, :D], noise[:, :J]))
    law = model(state, 0.1)
    torch.testing.assert_close(law.parts[0].at_noise(noise[:, :J]), moved[:, :D])


@every_head
@every_motion
def test_the_head_turns_by_the_model_of_one_coordinate(motion, head):
    model = WithHeading(motion(), head())
    D, J, (matrix, gain) = model.motion.state_dim, model.motion.noise_dim, model.turning(0.1)
    state, noise = inputs(model, 7)
    state[:, D] *= 3
    turned = state[:, D:] @ matrix.mT + noise[:, J:] @ gain.mT
    expected = torch.cat([wrap_angle(turned[:, :1]), turned[:, 1:]], -1)
    torch.testing.assert_close(model.transition(0.1)(state, noise)[:, D:], expected)
    torch.testing.assert_close(model(state, 0.1).parts[1].at_noise(noise[:, J:]), expected)


@every_head
@every_motion
@pytest.mark.parametrize("batch", [(), (7,), (3, 7)])
def test_law_and_transition_share_their_shapes(motion, head, batch):
    model = WithHeading(motion(), head())
    state, noise = inputs(model, *batch)
    law = model(state, 0.1)
    assert law.batch_shape == batch
    assert law.event_shape == (model.state_dim,)
    assert law.sample((3,)).shape == (3, *batch, model.state_dim)
    assert model.transition(0.1)(state, noise).shape == (*batch, model.state_dim)


@every_head
@every_motion
def test_each_talker_may_have_its_own_dt(motion, head):
    model, dt = WithHeading(motion(), head()), torch.tensor([0.01, 0.1, 1.0])
    state, noise = inputs(model, 5, 3)
    assert_each_talker_has_its_own_dt(model, state, noise, dt)


@every_motion
def test_one_state_may_take_steps_of_several_lengths(motion):
    model, dt = WithHeading(motion()), torch.tensor([0.1, 1.0, 0.3])
    state, noise = torch.randn(model.state_dim), torch.randn(3, model.noise_dim)
    assert model(state, dt).sample().shape == (3, model.state_dim)
    torch.testing.assert_close(model.transition(dt)(state, noise)[1], model.transition(1.0)(state, noise[1]))


@every_head
@every_motion
def test_noise_may_have_more_draws_than_states(motion, head):
    model = WithHeading(motion(), head())
    state, noise = torch.randn(7, model.state_dim), torch.randn(5, 7, model.noise_dim)
    step = model.transition(0.1)
    torch.testing.assert_close(step(state, noise)[3], step(state, noise[3]))


class Restless(torch.nn.Module):
    """A user's head: its matrix is the same at every step, its noise is not."""

    def forward(self, dt):
        spread = torch.as_tensor(dt)[..., None, None].sqrt()
        return torch.tensor([[1.0, 0.0], [0.0, 0.5]]), spread * torch.tensor([[0.3, 0.0], [0.0, 0.7]])


@pytest.mark.parametrize("dt", [(0.1, 0.5, 0.9), (0.4,)])
def test_a_users_head_may_have_a_constant_matrix(dt):
    model, dt = WithHeading(lehmann2007("CU-LAN"), Restless()), torch.tensor(dt)
    state, noise = inputs(model, 3)
    moved = model.transition(dt)(state, noise)
    one = model.transition(float(dt[-1]))(state[2], noise[2])
    torch.testing.assert_close(moved[2], one)


@every_head
def test_a_turn_more_of_the_heading_is_none(head):
    model = WithHeading(lehmann2007("CU-LAN"), head())
    state, noise = inputs(model, 7)
    turned = state.clone()
    turned[:, 4] -= 4 * math.pi
    torch.testing.assert_close(model.transition(0.1)(turned, noise), model.transition(0.1)(state, noise))


def test_headings_stay_on_the_circle():
    model = WithHeading(lehmann2007("CU-LAN"), HEADS["exact"]())
    state = torch.randn(200, 6)
    state[:, 4] = math.pi - 1e-3
    for moved in (model.transition(0.4)(state, torch.randn(200, 4)), model(state, 0.4).sample()):
        torch.testing.assert_close(wrap_angle(moved[:, 4]), moved[:, 4])
        assert (moved[:, 4] < 0).sum() > 20
        assert (moved[:, 4] > 0).sum() > 20


def test_mean_heading_goes_through_the_wrap_not_around():
    model = WithHeading(lehmann2007("CU-LAN"), HEADS["exact"]())
    mean = model(torch.tensor([0.2, 0.5, 0.3, -0.4, 3.1, 1.0]), 0.1).mean
    assert -math.pi <= mean[4] < -3.0


@every_head
def test_gradients_are_finite_differences_across_the_wrap(head):
    model = WithHeading(lehmann2007("CL-RWVE-RAAC"), head())
    state, noise = inputs(model, 2)
    state[:, 5], state[:, 6], noise[:, 1] = torch.tensor([3.1, -3.1]), torch.tensor([3.0, -3.0]), 0.02
    dt = torch.tensor(0.3)
    assert_gradients(model, lambda m, state, noise, dt: m.transition(dt)(state, noise), state, noise, dt)


def exact_model():
    """Everything about it has a density."""
    return WithHeading(CoordinateUncoupled(DrivenVelocity(RandomWalk(0.6))), HEADS["exact"]())


def test_density_is_the_product_of_body_and_head():
    model, state = exact_model(), torch.randn(7, 6)
    law, value = model(state, 0.4), torch.randn(3, 7, 6)
    parts = [part.log_prob(x) for part, x in zip(law.parts, value.split([4, 2], -1), strict=True)]
    torch.testing.assert_close(law.log_prob(value), parts[0] + parts[1])
    torch.testing.assert_close(parts[0], model.motion(state[:, :4], 0.4).log_prob(value[..., :4]))


def test_density_of_the_head_is_the_sum_over_its_turns():
    model, state = exact_model(), torch.tensor([0.1, 0.2, 0.3, -0.4, 2.9, 1.2])
    head = CoordinateUncoupled(model.turning, axes=1)(state[4:], 1.7)
    value = torch.tensor([-2.5, 0.4])
    turns = [head.log_prob(value + torch.tensor([2 * math.pi * k, 0.0])) for k in range(-5, 6)]
    torch.testing.assert_close(model(state, 1.7).parts[1].log_prob(value), torch.stack(turns).logsumexp(0))


@pytest.mark.parametrize("dt", [0.4, 1.7])
def test_density_of_the_head_integrates_to_one(dt):
    law = exact_model()(torch.tensor([0.1, 0.2, 0.3, -0.4, 2.9, 1.2]), dt).parts[1]
    assert_normalised(law, *box((-math.pi, math.pi, 300), (-8.0, 8.0, 300)))


def test_density_does_not_depend_on_turns_of_the_value():
    law, value = exact_model()(torch.randn(7, 6), 0.4), torch.randn(7, 6)
    turned = value + torch.tensor([0, 0, 0, 0, 6 * math.pi, 0])
    torch.testing.assert_close(law.log_prob(turned), law.log_prob(value))


def test_gradients_of_the_density_are_finite_differences():
    state, value, dt = torch.randn(3, 6), torch.randn(3, 6), torch.tensor([0.3, 0.6, 1.1])
    assert_gradients(exact_model(), lambda m, state, value, dt: m(state, dt).log_prob(value), state, value, dt)


@pytest.mark.parametrize(
    "model",
    [
        lambda: WithHeading(lehmann2007("CU-LAN", printed=False)),
        lambda: WithHeading(lehmann2007("CU-LAN"), HEADS["exact"]()),
        lambda: WithHeading(lehmann2007("CL-RWVE-RAAC"), HEADS["exact"]()),
    ],
    ids=["printed head", "printed body", "curvilinear body"],
)
def test_there_is_no_density_unless_both_parts_have_one(model):
    model = model()
    law = model(torch.randn(7, model.state_dim), 0.1)
    with pytest.raises(SingularLawError):
        law.log_prob(law.sample())


@every_head
@every_motion
def test_a_talker_looks_where_the_model_says(motion, head):
    model = WithHeading(motion(), head())
    state = torch.randn(3, 7, model.state_dim)
    kinematics, alone = model.kinematics(state), model.motion.kinematics(state[..., : model.motion.state_dim])
    torch.testing.assert_close(kinematics[:2], alone[:2])
    assert torch.equal(kinematics.heading, state[..., model.motion.state_dim])
    assert not torch.equal(alone.heading, kinematics.heading)


@every_head
@every_motion
def test_kinematics_and_back(motion, head):
    model = WithHeading(motion(), head())
    heading = wrap_angle(3 * torch.randn(3, 7))
    wanted = Kinematics(torch.randn(3, 7, model.axes), torch.randn(3, 7, model.axes), heading)
    state = model.from_kinematics(wanted)
    assert state.shape == (3, 7, model.state_dim)
    torch.testing.assert_close(model.kinematics(state), wanted)
    assert (state[..., model.motion.state_dim + 1 :] == 0).all()  # a head at rest


def test_a_talker_without_a_heading_looks_where_it_goes():
    velocity = torch.tensor([[-0.3, 0.4], [0.2, -0.7]])
    state = WithHeading(lehmann2007("CU-LAN")).from_kinematics(Kinematics(torch.randn(2, 2), velocity))
    torch.testing.assert_close(state[:, 4], torch.atan2(velocity[:, 1], velocity[:, 0]))


def test_a_heading_off_the_circle_is_wrapped():
    kinematics = Kinematics(torch.randn(2), torch.randn(2), torch.tensor(7.0))
    state = WithHeading(lehmann2007("CU-LAN")).from_kinematics(kinematics)
    torch.testing.assert_close(state[4], torch.tensor(7.0 - 2 * math.pi))


@every_head
@every_motion
@pytest.mark.parametrize("batch", [(7,), (3, 7)])
def test_variables_come_first_in_memory(motion, head, batch):
    model = WithHeading(motion(), head())
    assert model.transition(0.1)(*inputs(model, *batch)).movedim(-1, 0).is_contiguous()


@every_motion
def test_transition_leaves_its_inputs_alone(motion):
    model = WithHeading(motion())
    assert_step_leaves_its_inputs_alone(model.transition(0.1), *inputs(model, 7))


@every_head
@every_motion
def test_float32_is_close_to_float64(motion, head):
    double, single = WithHeading(motion(), head()), WithHeading(motion(), head()).float()
    state, noise = inputs(double, 9)
    moved = single.transition(0.032)(state.float(), noise.float())
    assert moved.dtype == single(state.float(), 0.032).sample().dtype == torch.float32
    torch.testing.assert_close(moved.double(), double.transition(0.032)(state, noise), rtol=1e-5, atol=1e-5)


@every_motion
def test_parameters_of_body_and_head_survive_saving(motion):
    model = WithHeading(motion())
    state, noise = inputs(model, 7)
    assert_survives_saving(model, lambda model: model.transition(0.1)(state, noise))
    assert len(list(model.parameters())) == len(list(motion().parameters())) + 2


def test_a_user_s_motion_has_a_head_too():
    class Still(Dynamics):
        state_dim, noise_dim, axes = 2, 2, 2

        def forward(self, state, dt):
            return torch.distributions.MultivariateNormal(state, dt * torch.eye(2))

        def kinematics(self, state):
            return Kinematics(state, torch.zeros_like(state))

        def from_kinematics(self, kinematics):
            return kinematics.position

    model, state = WithHeading(Still(), HEADS["exact"]()), torch.randn(7, 4)
    assert model(state, 0.1).log_prob(state).shape == (7,)
    moved = model.transition(0.25)(state, torch.tensor([1.0, -2.0, 0.0, 0.0]).expand(7, 4))
    torch.testing.assert_close(moved[:, :2], state[:, :2] + torch.tensor([0.5, -1.0]))


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf")])
@every_motion
def test_a_time_that_is_none_is_named(motion, bad):
    with pytest.raises(InputError, match=f"dt must be finite and positive, got {bad}"):
        WithHeading(motion()).transition(bad)


@every_motion
def test_rejects_a_wrong_state(motion):
    model = WithHeading(motion())
    D, wrong = model.state_dim, torch.zeros(7, model.motion.state_dim)
    with pytest.raises(ShapeError, match=rf"state must have shape \(\.\.\., {D}\), got \(7, {D - 2}\)"):
        model(wrong, 0.1)
    with pytest.raises(ShapeError, match=rf"state must have shape \(\.\.\., {D}\), got \(7, {D - 2}\)"):
        model.kinematics(wrong)


class Flat(torch.nn.Module):
    def forward(self, _dt):
        return torch.zeros(1, 1), torch.zeros(1, 1)


def test_rejects_a_head_that_is_no_axis_model():
    with pytest.raises(ShapeError, match=r"with K at least 2, got \(1, 1\) and \(1, 1\)"):
        WithHeading(lehmann2007("CU-LAN"), Flat())


class Heard(NamedTuple):
    """What a chain listens to."""

    speech: torch.Tensor


def test_a_heading_joins_models_that_switch():
    chain = MarkovChain([0.3, 0.7], [[0.9, 0.1], [0.2, 0.8]], silence=[[0.1, 0.9], [0.4, 0.6]], dt=0.1)
    motion = SwitchingDynamics([lehmann2007("CU-LAN"), lehmann2007("CL-RWVE-RAAC")], chain, explore=0.2)
    model = WithHeading(motion)
    state = model.from_kinematics(Kinematics(torch.randn(7, 2), torch.randn(7, 2), torch.randn(7)))
    noise, heard = torch.randn(7, model.noise_dim), Heard(torch.tensor([0.8]))
    moved, log_weight = next(iter(model.moves(heard, 0.1)))(state, noise)
    alone, weight_alone = next(iter(motion.moves(heard, 0.1)))(state[:, :6], noise[:, :3])
    torch.testing.assert_close(moved[:, :6], alone)
    torch.testing.assert_close(log_weight, weight_alone)
    torch.testing.assert_close(model.mode(moved), motion.mode(alone))
    turned = model.turning(0.1)[0] @ state[:, 6:].T + model.turning(0.1)[1] @ noise[:, 3:].T
    torch.testing.assert_close(moved[:, 6:], torch.stack([wrap_angle(turned[0]), turned[1]], -1))
