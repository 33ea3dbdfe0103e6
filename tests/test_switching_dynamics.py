"""Switching motion: what particles keep when they change their mode, how modes are drawn, and mistakes."""

import copy
import itertools
import math
from typing import NamedTuple

import pytest
import torch
from properties import assert_gradients, assert_survives_saving
from torch.func import functional_call, grad

from probtrack.distributions import Switched
from probtrack.dynamics import (
    CoordinateUncoupled,
    Curvilinear,
    DrivenAcceleration,
    DrivenVelocity,
    Dynamics,
    Kinematics,
    RandomWalk,
    TimeCorrelated,
    TurnAngle,
    WithHeading,
    euler,
    lehmann2007,
)
from probtrack.errors import InputError, ShapeError, SingularLawError
from probtrack.switching import MarkovChain, SwitchingDynamics

DT = 0.05
MODELS = {
    "CU 4-D": lambda axes=2: CoordinateUncoupled(DrivenVelocity(TimeCorrelated(1.7, 0.6)), axes),
    "CU 6-D": lambda axes=2: CoordinateUncoupled(DrivenAcceleration(TimeCorrelated(2.5, 1.2)), axes),
    "CL 4-D": lambda axes=2: Curvilinear(RandomWalk(0.4), TurnAngle(RandomWalk(0.9)), axes=axes),
    "CL 5-D": lambda axes=2: lehmann2007("CL-TCVE-TCAC", axes),
    "heading": lambda axes=2: WithHeading(lehmann2007("CU-LAN", axes), DrivenVelocity(TimeCorrelated(4.0, 0.8))),
    "path and heading": lambda axes=2: WithHeading(lehmann2007("CL-RWVE-RAAC", axes)),
}
ROWS = [[0.5, 0.2, 0.3], [0.1, 0.6, 0.3], [0.25, 0.35, 0.4]]
ALL = [
    [0.1, 0.3, 0.1, 0.2, 0.2, 0.1],
    [0.2, 0.1, 0.2, 0.1, 0.3, 0.1],
    [0.1, 0.2, 0.2, 0.2, 0.1, 0.2],
    [0.3, 0.1, 0.1, 0.1, 0.2, 0.2],
    [0.1, 0.2, 0.3, 0.1, 0.1, 0.2],
    [0.2, 0.2, 0.1, 0.3, 0.1, 0.1],
]


def models(*names, axes=2):
    return [MODELS[name](axes) for name in names]


def forced(parts, to, dt=DT):
    """A model whose next mode is `to`, whatever it was."""
    row = torch.eye(len(parts))[to]
    return SwitchingDynamics(parts, MarkovChain(row, row.expand(len(parts), -1), dt=dt))


def at_once(parts, of, to):
    """Kinematics, and states, before and after a change of mode that takes no time."""
    switching = forced(parts, to, dt=1e-9)
    state = in_mode(switching, of)
    after = switching.transition(1e-9)(state, torch.zeros(9, switching.noise_dim))
    assert (after[:, -1] == to).all()
    return switching.models[of].kinematics(state[:, : switching.models[of].state_dim]), after, switching


def three(**kwargs):
    """Three linear models, two of one layout."""
    parts = [*models("CU 4-D", "CU 6-D"), CoordinateUncoupled(DrivenVelocity(TimeCorrelated(0.6, 1.1)))]
    return SwitchingDynamics(parts, MarkovChain([0.2, 0.5, 0.3], ROWS, dt=DT), **kwargs)


def every(axes=2):
    return SwitchingDynamics(models(*MODELS, axes=axes), MarkovChain(ALL[2], ALL, dt=DT))


def in_mode(switching, mode, batch=(9,)):
    """States (*batch, D) of one mode, whose own variables are all different from zero."""
    state = torch.zeros(*batch, switching.state_dim)
    size = switching.models[mode].state_dim
    state[..., :size] = 0.4 * torch.randn(*batch, size) + 0.3
    state[..., -1] = mode
    return state


def mixed(switching, *batch):
    """States (*batch, D) of all modes, and of none yet."""
    pick = torch.randint(switching.num_modes + 1, batch)
    each = torch.stack([in_mode(switching, s, batch) for s in range(switching.num_modes)])
    start = torch.cat([each[0][..., :-1], torch.full((*batch, 1), float(switching.num_modes))], -1)
    every_one = torch.stack([*each, start])
    return torch.gather(every_one, 0, pick[None, ..., None].expand(1, *batch, switching.state_dim))[0]


def noise(switching, *batch):
    return torch.randn(*batch, switching.noise_dim)


def own(switching, state):
    """The model of one particle, and the state as that model has it."""
    model = switching.models[int(state[-1]) % switching.num_modes]
    return model, state[: model.state_dim]


class Heard(NamedTuple):
    speech: torch.Tensor


# what survives a change of mode


@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize(("of", "to"), list(itertools.permutations(range(6), 2)))
def test_position_and_velocity_survive_a_change_of_mode(of, to, axes):
    before, after, switching = at_once(models(*MODELS, axes=axes), of, to)
    known = switching.kinematics(after)
    torch.testing.assert_close(known.position, before.position, rtol=0, atol=1e-7)
    torch.testing.assert_close(known.velocity, before.velocity, rtol=0, atol=1e-7)


@pytest.mark.parametrize(("of", "to"), [(0, 1), (1, 0)])
def test_heading_survives_a_change_between_models_that_have_one(of, to):
    before, after, switching = at_once(models("heading", "path and heading"), of, to)
    heading = switching.kinematics(after).modelled_heading
    torch.testing.assert_close(heading, before.modelled_heading, rtol=0, atol=1e-7)


def test_a_new_heading_is_the_direction_of_motion():
    before, after, switching = at_once(models("CU 4-D", "heading"), 0, 1)
    torch.testing.assert_close(switching.kinematics(after).modelled_heading, before.heading, rtol=0, atol=1e-7)


def test_acceleration_starts_at_zero():
    assert (at_once(models("CU 4-D", "CU 6-D"), 0, 1)[1][:, 4:6] == 0).all()
    assert (at_once(models("heading", "CU 6-D"), 0, 1)[1][:, 4:6] == 0).all()


@pytest.mark.parametrize("of", [0, 1])
def test_a_state_shorter_than_the_first_ends_in_zeros(of):
    switching = forced(models("CU 6-D", "CU 4-D"), 1)
    assert (switching.transition(DT)(in_mode(switching, of), noise(switching, 9))[:, 4:6] == 0).all()


@pytest.mark.parametrize("mode", range(6))
def test_particles_that_stay_move_as_their_own_model_moves_them(mode):
    switching = forced(models(*MODELS), mode)
    state, u, model = in_mode(switching, mode), noise(switching, 9), switching.models[mode]
    moved = switching.transition(DT)(state, u)
    alone = model.transition(DT)(state[:, : model.state_dim], u[:, : model.noise_dim])
    torch.testing.assert_close(moved[:, : model.state_dim], alone)
    assert (moved[:, model.state_dim : -1] == 0).all()


@pytest.mark.parametrize("axes", [2, 3])
def test_a_mixed_cloud_moves_as_each_particle_would(axes):
    switching = every(axes)
    state, u = mixed(switching, 5, 20), noise(switching, 5, 20)
    moved = switching.transition(DT)(state, u).reshape(100, -1)
    assert len(moved[:, -1].unique()) == 6
    for before, numbers, after in zip(state.reshape(100, -1), u.reshape(100, -1), moved, strict=True):
        giver, x = own(switching, before)
        taker, y = own(switching, after)
        x = x if taker is giver else taker.from_kinematics(giver.kinematics(x))
        torch.testing.assert_close(y, taker.transition(DT)(x, numbers[: taker.noise_dim]))
        assert (after[taker.state_dim : -1] == 0).all()


def test_states_and_noise_broadcast():
    switching = three()
    state, u = mixed(switching, 4, 1), noise(switching, 3, 1, 7)
    moved = switching.transition(DT)(state, u)
    assert moved.shape == (3, 4, 7, switching.state_dim)
    torch.testing.assert_close(moved[2, 1], switching.transition(DT)(state[1].expand(7, -1), u[2, 0]))


# the mode


def mode_frequencies(switching, before, size=4000):
    """How often each mode follows `before`, over evenly spaced quantiles of the number that picks it."""
    u = torch.zeros(size, switching.noise_dim)
    u[:, -1] = torch.special.ndtri((torch.arange(size) + 0.5) / size)
    state = in_mode(switching, before % switching.num_modes, (size,))
    state[:, -1] = before
    return torch.bincount(switching.transition(DT)(state, u)[:, -1].long(), minlength=switching.num_modes) / size


@pytest.mark.parametrize("before", range(4))
def test_modes_follow_each_other_by_the_chain(before):
    expected = torch.tensor([*ROWS, [0.2, 0.5, 0.3]][before])
    torch.testing.assert_close(mode_frequencies(three(), before), expected, rtol=0, atol=1 / 4000)


def test_modes_of_a_longer_step_follow_by_the_chain_of_that_step():
    switching = three()
    u = torch.zeros(4000, switching.noise_dim)
    u[:, -1] = torch.special.ndtri((torch.arange(4000) + 0.5) / 4000)
    moved = switching.transition(3 * DT)(in_mode(switching, 1, (4000,)), u)
    expected = torch.linalg.matrix_power(torch.tensor(ROWS), 3)[1]
    torch.testing.assert_close(torch.bincount(moved[:, -1].long()) / 4000, expected, rtol=0, atol=1 / 4000)


SPARSE = [
    [0.0, 0.3, 0.0, 0.7, 0.0],
    [0.1, 0.0, 0.9, 0.0, 0.0],
    [0.0, 0.0, 0.0, 0.0, 1.0],
    [1.0, 0.0, 0.0, 0.0, 0.0],
    [0.0, 0.3, 0.3, 0.4, 0.0],
]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("explore", [0.0, 0.4])
@torch.no_grad()
def test_impossible_modes_are_never_drawn(dtype, explore):
    torch.set_default_dtype(dtype)
    chain = MarkovChain([0.0, 1.0, 0.0, 0.0, 0.0], SPARSE, dt=DT)
    switching = SwitchingDynamics(models("CU 4-D") * 5, chain, explore=explore)
    u, state = torch.zeros(170_000, switching.noise_dim), torch.zeros(6, 170_000, switching.state_dim)
    u[:, -1] = torch.linspace(-40, 40, 170_000)
    state[..., -1] = torch.arange(6)[:, None]
    after = next(iter(switching.moves(None, DT)))(state, u)[0][..., -1].long()
    for drawn, row in zip(after, [*SPARSE, [0.0, 1.0, 0.0, 0.0, 0.0]], strict=True):
        assert drawn.unique().tolist() == [s for s in range(5) if row[s] > 0]


def test_zeros_leave_gradients_finite():
    chain = MarkovChain([0.0, 1.0, 0.0, 0.0, 0.0], SPARSE, dt=DT)
    switching = SwitchingDynamics(models("CU 4-D") * 5, chain, explore=0.2)
    state, log_weight = next(iter(switching.moves(None, DT)))(mixed(switching, 500), noise(switching, 500))
    (log_weight.exp() * state[:, 0]).sum().backward()
    assert log_weight.isfinite().all()
    assert all(p.grad.isfinite().all() for p in switching.parameters())
    assert ((chain.logit_transition.grad != 0) <= (torch.tensor(SPARSE) > 0)).all()


def test_mode_is_ones_and_zeros():
    switching = three()
    state = torch.stack([in_mode(switching, s, (2,)) for s in (2, 0, 1, 1)])
    expected = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 1, 0]])
    assert torch.equal(switching.mode(state), expected[:, None].expand(4, 2, 3))


def test_start_is_as_the_first_model_has_it_and_its_mode_is_still_to_be_drawn():
    switching = SwitchingDynamics(models("CU 6-D", "heading", "CL 5-D"), MarkovChain([0.2, 0.5, 0.3], ROWS))
    known = Kinematics(torch.randn(7, 2), torch.randn(7, 2))
    state = switching.from_kinematics(known)
    assert state.shape == (7, 7)
    assert torch.equal(state[:, :6], switching.models[0].from_kinematics(known))
    assert (state[:, 6] == 3).all()
    assert (switching.mode(state) == 0).all()
    assert torch.equal(switching.kinematics(state).velocity, known.velocity)


# kinematics


@pytest.mark.parametrize("axes", [2, 3])
def test_kinematics_are_those_of_each_particles_own_model(axes):
    switching = every(axes)
    state = mixed(switching, 6, 30)
    known = switching.kinematics(state)
    position, velocity = known.position.reshape(180, axes), known.velocity.reshape(180, axes)
    for i, particle in enumerate(state.reshape(180, -1)):
        model, x = own(switching, particle)
        torch.testing.assert_close(position[i], model.kinematics(x).position)
        torch.testing.assert_close(velocity[i], model.kinematics(x).velocity)
        torch.testing.assert_close(known.modelled_heading.flatten()[i], model.kinematics(x).heading)


def test_there_is_no_heading_where_no_model_has_one():
    switching = three()
    assert switching.kinematics(mixed(switching, 6)).modelled_heading is None


@pytest.mark.parametrize("names", [["CU 4-D", "heading"], ["heading", "CU 4-D"]])
def test_heading_is_the_direction_of_motion_for_models_without_one(names):
    switching = SwitchingDynamics(models(*names), MarkovChain([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]]))
    state = in_mode(switching, names.index("CU 4-D"))
    torch.testing.assert_close(switching.kinematics(state).modelled_heading, torch.atan2(state[:, 3], state[:, 2]))


# one mode, equal rows


@pytest.mark.parametrize("name", MODELS)
def test_one_mode_is_the_plain_model(name):
    (plain,) = models(name)
    switching = SwitchingDynamics([plain], MarkovChain([1.0], [[1.0]], dt=DT))
    known = Kinematics(torch.randn(9, 2), torch.randn(9, 2))
    u = noise(switching, 9)
    state, expected = switching.from_kinematics(known), plain.from_kinematics(known)
    for _ in range(3):
        state = switching.transition(DT)(state, u)
        expected = plain.transition(DT)(expected, u[:, :-1])
    assert torch.equal(state, torch.cat([expected, torch.zeros(9, 1)], -1))


def test_equal_rows_are_a_mixture_at_each_step():
    parts, share = [*models("CU 4-D"), CoordinateUncoupled(DrivenVelocity(TimeCorrelated(0.6, 1.1)))], [0.35, 0.65]
    switching = SwitchingDynamics(parts, MarkovChain(share, [share, share], dt=DT))
    x, y = torch.randn(4), 0.1 * torch.randn(7, 4)
    mixture = sum(p * part(x, DT).log_prob(x + y).exp() for p, part in zip(share, parts, strict=True))
    for before in range(3):
        law = switching(torch.cat([x, torch.tensor([float(before)])]), DT)
        after = [law.log_prob(torch.cat([x + y, torch.full((7, 1), float(s))], -1)).exp() for s in range(2)]
        torch.testing.assert_close(after[0] + after[1], mixture)


# the law of a step


def test_density_is_that_of_the_next_mode_and_of_its_motion():
    switching = three()
    state, table = mixed(switching, 40), switching.chain(DT)
    law = switching(state, DT)
    value = switching.transition(DT)(state, noise(switching, 40))
    assert isinstance(law, Switched)
    for before, after, log_prob in zip(state, value, law.log_prob(value), strict=True):
        giver, x = own(switching, before)
        taker, y = own(switching, after)
        x = x if taker is giver else taker.from_kinematics(giver.kinematics(x))
        torch.testing.assert_close(log_prob, table[int(before[-1]), int(after[-1])] + taker(x, DT).log_prob(y))


def test_density_is_that_of_the_next_motion_from_the_same_kinematics():
    path, plain = parts = models("CL 5-D", "CU 6-D")
    switching = SwitchingDynamics(parts, MarkovChain([0.5, 0.5], [[0.6, 0.4], [0.3, 0.7]], dt=DT))
    state, value = in_mode(switching, 0), in_mode(switching, 1)
    carried = plain.from_kinematics(path.kinematics(state[:, :5]))
    expected = math.log(0.4) + plain(carried, DT).log_prob(value[:, :6])
    torch.testing.assert_close(switching(state, DT).log_prob(value), expected)


def test_steps_are_samples_of_the_law():
    switching, size = three(), 20_000
    state = in_mode(switching, 1, ())
    drawn = switching(state, DT).sample(torch.Size([size]))
    stepped = switching.transition(DT)(state.expand(size, -1), noise(switching, size)).detach()

    def features(x):
        each = [x * (x[:, -1:] == s) for s in range(3)]
        return torch.cat([switching.mode(x), *each, *[e.square() for e in each]], -1)

    one, other = features(drawn), features(stepped)
    error = one.mean(0) - other.mean(0)
    assert (error.abs() <= 5 * ((one.var(0) + other.var(0)) / size).sqrt() + 1e-12).all()


def test_only_a_step_without_density_that_is_asked_is_an_error():
    switching = SwitchingDynamics(models("CU 4-D", "CL 4-D"), MarkovChain([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]]))
    state = in_mode(switching, 0)
    law = switching(state, DT)
    assert law.log_prob(in_mode(switching, 0)).isfinite().all()
    with pytest.raises(SingularLawError):
        law.log_prob(in_mode(switching, 1))


@pytest.mark.parametrize("names", [["CU 4-D", "CU 6-D"], ["CL 5-D", "path and heading"]])
def test_gradients_of_steps(names):
    switching = SwitchingDynamics(models(*names), MarkovChain([0.5, 0.5], [[0.6, 0.4], [0.3, 0.7]], dt=DT))
    state, u = mixed(switching, 3), noise(switching, 3)

    def moved(model, x, numbers):
        before, pick = torch.cat([x, state[:, -1:]], -1), torch.cat([numbers, u[:, -1:]], -1)
        after = model.transition(DT)(before, pick)
        return torch.cat([after[:, :-1], model.kinematics(after).velocity], -1)

    assert_gradients(switching, moved, state[:, :-1], u[:, :-1])


def test_gradients_of_densities():
    switching = three()
    state = mixed(switching, 3)
    value = switching.transition(DT)(state, noise(switching, 3)).detach()

    def log_prob(model, x, y):
        return model(torch.cat([x, state[:, -1:]], -1), DT).log_prob(torch.cat([y, value[:, -1:]], -1))

    assert_gradients(switching, log_prob, state[:, :-1], value[:, :-1])


# weights that carry the gradient of the chain


def moved_from(switching, before, size=3000):
    """Mode after a step from mode `before`, and its log weight, over evenly spaced quantiles."""
    u = torch.zeros(size, switching.noise_dim)
    u[:, -1] = torch.special.ndtri((torch.arange(size) + 0.5) / size)
    state = torch.zeros(size, switching.state_dim)
    state[:, -1] = before
    after, log_weight = next(iter(switching.moves(None, DT)))(state, u)
    return after[:, -1].long(), log_weight


@pytest.mark.parametrize("before", range(4))
def test_without_exploring_weights_are_one_and_carry_the_score_of_the_mode(before):
    switching = three()
    after, log_weight = moved_from(switching, before)
    assert (log_weight == 0).all()
    coefficient = torch.randn(3)
    (coefficient[after] * log_weight).sum().backward()
    row = torch.tensor([*ROWS, [0.2, 0.5, 0.3]][before])
    counts = torch.bincount(after, minlength=3) * coefficient
    score = counts - counts.sum() * row
    chain = switching.chain
    given = chain.logit_initial.grad if before == 3 else chain.logit_transition.grad[before]
    torch.testing.assert_close(given, score)


@pytest.mark.parametrize("before", range(4))
@pytest.mark.parametrize("explore", [0.1, 0.6])
def test_exploring_draws_evenly_in_a_share_and_weights_correct_for_it(explore, before):
    after, log_weight = moved_from(three(explore=explore), before)
    p = torch.tensor([*ROWS, [0.2, 0.5, 0.3]][before])
    q = (1 - explore) * p + explore / 3
    torch.testing.assert_close(torch.bincount(after) / 3000, q, rtol=0, atol=1 / 3000)
    torch.testing.assert_close(log_weight, (p / q).log()[after])


def test_exploring_leaves_out_what_is_impossible():
    chain = MarkovChain([1.0, 0.0, 0.0], [[0.9, 0.1, 0.0], *ROWS[1:]], dt=DT)
    after, log_weight = moved_from(SwitchingDynamics(list(three().models), chain, explore=0.5), 0)
    torch.testing.assert_close(torch.bincount(after) / 3000, torch.tensor([0.7, 0.3]), rtol=0, atol=1 / 3000)
    torch.testing.assert_close(log_weight.exp(), torch.tensor([0.9 / 0.7, 0.1 / 0.3])[after])


@torch.no_grad()
def test_without_gradients_only_exploring_needs_weights():
    assert moved_from(three(), 0)[1] is None
    assert moved_from(three(explore=0.1), 0)[1] is not None


def test_a_chain_that_is_not_learned_needs_no_weights():
    switching = three()
    switching.chain.requires_grad_(requires_grad=False)
    assert moved_from(switching, 0)[1] is None


@pytest.mark.parametrize("explore", [0.0, 0.6])
def test_a_plain_step_does_not_explore(explore):
    frequencies = mode_frequencies(three(explore=explore), 2)
    torch.testing.assert_close(frequencies, torch.tensor(ROWS[2]), rtol=0, atol=1 / 4000)


# listening


def listening(**kwargs):
    chain = MarkovChain([0.5, 0.5], [[1.0, 0.0], [0.9, 0.1]], silence=[[0.0, 1.0], [0.3, 0.7]], dt=DT)
    return SwitchingDynamics(models("CU 4-D", "CU 6-D"), chain, **kwargs)


def test_each_frame_has_the_chain_of_its_speech():
    switching = listening()
    u = noise(switching, 2000)
    u[:, -1] = torch.special.ndtri((torch.arange(2000) + 0.5) / 2000)
    speech, state = torch.tensor([1.0, 0.0, 0.25]), in_mode(switching, 1, (2000,))
    shares = [move(state, u)[0][:, -1].mean().item() for move in switching.moves(Heard(speech), DT)]
    assert shares == pytest.approx([0.1, 0.7, 0.25 * 0.1 + 0.75 * 0.7], abs=1 / 2000)


def test_each_run_of_a_batch_has_its_own_speech():
    switching = listening()
    speech = torch.tensor([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5]])
    state, u = in_mode(switching, 0, (3, 50)), noise(switching, 3, 50)
    first, second = (move(state, u)[0][..., -1] for move in switching.moves(Heard(speech), DT))
    assert (first[0] == 0).all()
    assert (first[1] == 1).all()
    assert (second[0] == 1).all()
    assert (second[1] == 0).all()
    assert torch.equal(first[2], second[2])


def test_speech_may_be_shared_by_the_runs_of_a_recording():
    switching = listening()
    speech = torch.rand(2, 3, 1)
    state, u = mixed(switching, 3, 4, 50), noise(switching, 3, 4, 50)
    shared, own_speech = (list(switching.moves(Heard(s), DT)) for s in (speech, speech.expand(2, 3, 4)))
    for one, other in zip(shared, own_speech, strict=True):
        for a, b in zip(one(state, u), other(state, u), strict=True):
            assert torch.equal(a, b)


def test_gradients_reach_what_is_heard():
    switching = listening()
    speech = torch.tensor([0.3, 0.8], requires_grad=True)
    for move in switching.moves(Heard(speech), DT):
        after, log_weight = move(in_mode(switching, 1, (50,)), noise(switching, 50))
        (log_weight * after[:, -1]).sum().backward(retain_graph=True)
    assert (speech.grad < 0).all()  # mode 1 is the likelier the less is said


# a module


def test_learns_every_model_and_the_chain():
    names = {name.split(".")[0] for name, _ in three().named_parameters()}
    assert names == {"models", "chain"}
    assert len(list(three().parameters())) == 3 * 2 + 2


def test_survives_saving():
    switching = three()
    state, u = mixed(switching, 30), noise(switching, 30)
    assert_survives_saving(switching, lambda model: model.transition(DT)(state, u).detach())


def test_a_copy_moves_by_its_own_parameters():
    switching = three()
    state, u = in_mode(switching, 0, (30,)), noise(switching, 30)
    before, other = switching.transition(DT)(state, u), copy.deepcopy(switching)
    with torch.no_grad():
        for parameter in other.models.parameters():
            parameter += 1
    assert torch.equal(switching.transition(DT)(state, u), before)
    assert not torch.equal(other.transition(DT)(state, u)[:, 2:4], before[:, 2:4])


class Stepped(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, state, u):
        return self.model.kinematics(self.model.transition(DT)(state, u)).velocity


def test_parameters_can_be_replaced_from_outside():
    switching = three()
    state, u, stepped = mixed(switching, 30), noise(switching, 30), Stepped(switching)
    other = {name: p.detach() + 0.3 for name, p in stepped.named_parameters()}
    replaced = functional_call(stepped, other, (state, u))
    gradient = grad(lambda given: functional_call(stepped, given, (state, u)).square().sum())(other)
    stepped.load_state_dict(other)
    assert torch.equal(stepped(state, u), replaced)
    stepped(state, u).square().sum().backward()
    for name, p in switching.models.named_parameters():
        torch.testing.assert_close(gradient[f"model.models.{name}"], p.grad)


@pytest.mark.parametrize("name", MODELS)
def test_float32(name):
    torch.set_default_dtype(torch.float32)
    switching = SwitchingDynamics(models(name, "CU 6-D"), MarkovChain([0.5, 0.5], [[0.6, 0.4], [0.3, 0.7]], dt=DT))
    state, u = mixed(switching, 60), noise(switching, 60)
    after, log_weight = next(iter(switching.moves(None, DT)))(state, u)
    assert after.dtype == log_weight.dtype == switching.kinematics(after).position.dtype == torch.float32
    double = copy.deepcopy(switching).double().transition(DT)(state.double(), u.double())
    torch.testing.assert_close(after.double(), double, rtol=1e-4, atol=1e-5)


# mistakes


def test_rejects_another_number_of_models_than_modes():
    with pytest.raises(InputError, match="models must be as many as the modes of the chain, 3, got 2"):
        SwitchingDynamics(models("CU 4-D", "CU 6-D"), MarkovChain([0.2, 0.5, 0.3], ROWS))


def test_rejects_models_of_different_axes():
    parts = [*models("CU 4-D"), *models("CU 6-D", axes=3)]
    with pytest.raises(InputError, match="models must have one number of axes, got 2, 3"):
        SwitchingDynamics(parts, MarkovChain([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]]))


@pytest.mark.parametrize("explore", [-0.1, 1.0, 1.5, math.nan])
def test_rejects_a_share_that_is_none(explore):
    with pytest.raises(InputError, match=rf"explore must be in \[0, 1\), got {explore}"):
        three(explore=explore)


@pytest.mark.parametrize("dt", [0.0, -0.1, math.nan, math.inf])
def test_rejects_a_time_step_that_is_none(dt):
    switching = three()
    for act in (switching.transition, lambda dt: switching.moves(None, dt), lambda dt: switching(torch.zeros(7), dt)):
        with pytest.raises(InputError, match="dt must be finite and positive"):
            act(dt)


def test_rejects_a_time_step_for_each_particle():
    switching, dt = three(), torch.tensor([0.1, 0.2])
    for act in (switching.transition, lambda dt: switching.moves(None, dt)):
        with pytest.raises(ShapeError, match=r"dt must be one number, or one for each cloud \(\*batch, 1\), got shape"):
            act(dt)


@pytest.mark.parametrize("observations", [torch.zeros(4, 2), Heard(None)])
def test_rejects_observations_without_speech(observations):
    with pytest.raises(InputError, match="observations must have `speech` for a chain that listens to it"):
        listening().moves(observations, DT)


def test_a_chain_that_listens_has_no_step_without_speech():
    switching = listening()
    for act in (lambda: switching.transition(DT), lambda: switching(in_mode(switching, 0), DT)):
        with pytest.raises(InputError, match="speech must be given to a chain that listens to it"):
            act()


def test_rejects_states_and_noise_of_another_size():
    switching = three()
    step = switching.transition(DT)
    for act in (lambda x: step(x, noise(switching, 5)), lambda x: switching(x, DT), switching.kinematics):
        with pytest.raises(ShapeError, match=r"state must have shape \(\.\.\., 7\), got \(5, 6\)"):
            act(torch.zeros(5, 6))
    with pytest.raises(ShapeError, match=r"noise must have shape \(\.\.\., 7\), got \(5, 6\)"):
        step(mixed(switching, 5), torch.zeros(5, 6))


class Rooted(Dynamics):
    """A user's model whose step takes the root of x, which is NaN left of the origin."""

    state_dim = 4
    noise_dim = axes = 2

    def transition(self, dt):
        return lambda state, noise: state + dt * state[..., :1].sqrt() + 0 * noise.sum(-1, keepdim=True)

    def forward(self, state, dt):
        raise NotImplementedError

    def kinematics(self, state):
        return Kinematics(state[..., :2], state[..., 2:])

    def from_kinematics(self, kinematics):
        return torch.cat([kinematics.position, kinematics.velocity], -1)


def test_a_model_that_fails_on_others_particles_leaves_them_alone():
    chain = MarkovChain([0.6, 0.4], [[1.0, 0.0], [0.0, 1.0]])
    for order in ([Rooted(), lehmann2007("CU-LAN")], [lehmann2007("CU-LAN"), Rooted()]):
        model, rooted = SwitchingDynamics(order, chain), isinstance(order[1], Rooted)
        place = torch.linspace(-2.0, 3.0, 30)
        mode = ((place > 0) == rooted).to(place)  # Rooted has those right of the origin alone
        state = torch.stack([place, place, torch.ones(30), torch.ones(30), mode], -1)
        moved = model.transition(0.032)(state, torch.randn(30, model.noise_dim))
        assert torch.isfinite(moved).all()
        assert torch.equal(moved[:, -1], mode)


def test_the_state_that_stands_in_for_others_is_of_the_first_particles_own_layout():
    class Positive(Rooted):
        """Knows only talkers right of the origin."""

        def from_kinematics(self, kinematics):
            assert (kinematics.position[..., 0] > 0).all()
            return super().from_kinematics(kinematics)

    model = SwitchingDynamics(
        [WithHeading(lehmann2007("CU-LAN")), lehmann2007("CL-RWVE-RAAC"), Positive()],
        MarkovChain([0.2, 0.3, 0.5], torch.eye(3)),
    )
    right = Kinematics(torch.rand(7, 2) + 1, torch.randn(7, 2))
    state = torch.nn.functional.pad(lehmann2007("CL-RWVE-RAAC").from_kinematics(right), (0, 2))
    state[:, -1] = 1  # of the second model's layout, the first particle too
    torch.testing.assert_close(model.kinematics(state).velocity, right.velocity)


def test_a_talker_who_stopped_long_ago_walks_on_with_finite_gradients():
    stopped = CoordinateUncoupled(DrivenVelocity(TimeCorrelated(10.0, 0.0), euler)).float()
    chain = MarkovChain([0.5, 0.5], [[0.99, 0.01], [0.0, 1.0]])
    model = SwitchingDynamics([stopped, lehmann2007("CL-RWVE-RAAC")], chain).float()
    state = model.from_kinematics(Kinematics(torch.zeros(40, 2), torch.ones(40, 2)))
    state, step = state.float(), model.transition(0.032)
    for _ in range(400):
        state = step(state, torch.randn(40, model.noise_dim, dtype=torch.float32))
    model.kinematics(state).position.sum().backward()
    gradients = [p.grad for p in model.parameters() if p.grad is not None]
    assert all(torch.isfinite(g).all() for g in gradients)
    assert len(gradients) > 2


def test_a_model_put_in_later_is_the_one_that_moves():
    model = SwitchingDynamics([lehmann2007("CU-LAN")], MarkovChain([1.0], [[1.0]]))
    model.models[0] = lehmann2007("CU-LAN-ORIG")
    state, noise = model.from_kinematics(Kinematics(torch.zeros(5, 2), torch.ones(5, 2))), torch.randn(5, 3)
    expected = lehmann2007("CU-LAN-ORIG").transition(0.1)(state[:, :4], noise[:, :2])
    torch.testing.assert_close(model.transition(0.1)(state, noise)[:, :4], expected)


def test_rejects_a_model_that_does_not_say_its_axes():
    class Silent(Dynamics):
        """Says its sizes but not its axes."""

        state_dim = noise_dim = 2
        forward = kinematics = from_kinematics = None

    for make in (WithHeading, lambda m: SwitchingDynamics([m], MarkovChain([1.0], [[1.0]]))):
        with pytest.raises(InputError, match="Silent must say its number of spatial `axes`"):
            make(Silent())


def test_rejects_speech_of_another_batch():
    model = SwitchingDynamics([lehmann2007("CU-LAN")] * 2, MarkovChain([0.5, 0.5], ROWS_2, silence=ROWS_2))
    move = next(iter(model.moves(Spoken(torch.rand(4, 2)), 0.1)))
    with pytest.raises(ShapeError, match=r"speech must have the belief's batch \(3,\), got \(2,\)"):
        move(torch.zeros(3, 7, 5), torch.zeros(3, 7, 3))


ROWS_2 = [[0.7, 0.3], [0.2, 0.8]]


class Spoken(NamedTuple):
    """What a chain listens to."""

    speech: torch.Tensor


def test_models_of_one_layout_exchange_states_as_they_are():
    quick, slow = (CoordinateUncoupled(DrivenAcceleration(TimeCorrelated(rate, 1.2))) for rate in (2.5, 0.3))
    model = SwitchingDynamics([quick, slow], MarkovChain([0.5, 0.5], [[0.0, 1.0], [1.0, 0.0]], dt=0.1))
    state, noise = torch.cat([torch.randn(7, 6), torch.zeros(7, 1)], -1), torch.randn(7, 7)
    moved = model.transition(0.1)(state, noise)
    torch.testing.assert_close(moved[:, :6], slow.transition(0.1)(state[:, :6], noise[:, :6]))
    law, alone = model(state, 0.1), slow(state[:, :6], 0.1)
    torch.testing.assert_close(law.log_prob(moved), alone.log_prob(moved[:, :6]))


CLOUD_STEPS = torch.tensor([[DT], [0.3 * DT], [2.6 * DT]])


@pytest.mark.parametrize("make", [three, every], ids=["one layout", "all layouts"])
def test_each_cloud_has_its_own_time_step(make):
    switching = make()
    state, numbers = mixed(switching, 3, 40), noise(switching, 3, 40)
    moved = switching.transition(CLOUD_STEPS)(state, numbers)
    for i, dt in enumerate(CLOUD_STEPS[:, 0].tolist()):
        torch.testing.assert_close(moved[i], switching.transition(dt)(state[i], numbers[i]))


def test_weights_of_clouds_with_their_own_time_steps():
    switching = three(explore=0.4)
    state, numbers = mixed(switching, 3, 40), noise(switching, 3, 40)
    _, log_weight = next(iter(switching.moves(None, CLOUD_STEPS)))(state, numbers)
    for i, dt in enumerate(CLOUD_STEPS[:, 0].tolist()):
        _, one = next(iter(switching.moves(None, dt)))(state[i], numbers[i])
        torch.testing.assert_close(log_weight[i], one)


def test_clouds_that_listen_have_their_own_time_steps():
    switching = listening()
    state, numbers, speech = mixed(switching, 3, 40), noise(switching, 3, 40), torch.rand(1, 3)
    moved, _ = next(iter(switching.moves(Heard(speech), CLOUD_STEPS)))(state, numbers)
    for i, dt in enumerate(CLOUD_STEPS[:, 0].tolist()):
        one, _ = next(iter(switching.moves(Heard(speech[:, i]), dt)))(state[i], numbers[i])
        torch.testing.assert_close(moved[i], one)


def test_the_density_takes_a_time_step_for_each_state():
    switching = three()
    state, dt = mixed(switching, 3, 4), torch.tensor([DT, 0.3 * DT, 2.6 * DT, 2 * DT])
    value = switching.transition(DT)(state, noise(switching, 3, 4))
    density = switching(state, dt).log_prob(value)
    for j in range(4):
        torch.testing.assert_close(density[:, j], switching(state[:, j], dt[j].item()).log_prob(value[:, j]))
