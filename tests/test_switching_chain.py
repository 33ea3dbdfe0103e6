"""Markov chain over motion models: powers, dwelling, listening, zeros and mistakes."""

import copy
import math

import pytest
import torch
from properties import assert_gradients, assert_survives_saving

from probtrack.errors import InputError, ShapeError
from probtrack.switching import MarkovChain

FIRST = [0.2, 0.5, 0.3]
SPEECH = [[0.7, 0.2, 0.1], [0.05, 0.9, 0.05], [0.3, 0.15, 0.55]]
SILENCE = [[0.4, 0.35, 0.25], [0.1, 0.3, 0.6], [0.02, 0.08, 0.9]]
DT = 0.032


def chain(**kwargs):
    return MarkovChain(FIRST, SPEECH, **{"dt": DT} | kwargs)


def matrix(chain, dt, *speech):
    return chain(dt, *speech).exp()[..., :-1, :]


# probabilities as they were given


def test_over_its_own_step_the_chain_gives_its_probabilities():
    table = chain()(DT).exp()
    assert table.shape == (4, 3)
    torch.testing.assert_close(table[:3], torch.tensor(SPEECH))
    torch.testing.assert_close(table[3], torch.tensor(FIRST))


@pytest.mark.parametrize("size", [1, 2, 5])
def test_any_number_of_modes(size):
    made = MarkovChain(torch.rand(size).softmax(-1), torch.rand(size, size).softmax(-1))
    assert made.num_modes == size
    assert made(DT).shape == (size + 1, size)


@pytest.mark.parametrize("dt", [1e-6, 0.01, 0.016, 0.05, 0.32, 31.0])
def test_rows_sum_to_one_at_every_time_step(dt):
    table = chain(silence=SILENCE)(dt, torch.tensor([0.0, 0.3, 1.0])).exp()
    assert (table >= 0).all()
    torch.testing.assert_close(table.sum(-1), torch.ones(3, 4))


def test_first_mode_does_not_depend_on_the_time_step():
    torch.testing.assert_close(chain()(0.005).exp()[-1], torch.tensor(FIRST))


# other time steps


@pytest.mark.parametrize("steps", [2, 3, 7])
def test_whole_steps_are_powers_of_the_matrix(steps):
    P = torch.tensor(SPEECH)
    torch.testing.assert_close(matrix(chain(), steps * DT), torch.linalg.multi_dot([torch.eye(3), *[P] * steps]))


@pytest.mark.parametrize("other", [2 * DT, 0.4 * DT, 1.7 * DT])
def test_a_whole_step_and_another_make_their_sum(other):
    made = chain()
    joint = matrix(made, DT) @ matrix(made, other)
    torch.testing.assert_close(matrix(made, DT + other), joint)


@pytest.mark.parametrize("share", [0.5, 0.125, 1e-3])
def test_within_a_step_modes_are_left_as_often_per_second(share):
    leaving = matrix(chain(), share * DT) - torch.eye(3)
    torch.testing.assert_close(leaving, share * (torch.tensor(SPEECH) - torch.eye(3)))


def test_between_whole_steps_the_rest_is_taken_in_proportion():
    P = torch.tensor(SPEECH)
    torch.testing.assert_close(matrix(chain(), 2.25 * DT), P @ P @ (torch.eye(3) + 0.25 * (P - torch.eye(3))))


@pytest.mark.parametrize("steps", [3, 5, 10, 1001])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_whole_steps_are_whole_however_they_are_rounded(steps, dtype):
    torch.set_default_dtype(dtype)
    turn = MarkovChain([1, 0, 0], [[0, 1, 0], [0, 0, 1], [1, 0, 0]], dt=0.032)
    for dt in (steps * 0.032, torch.tensor(steps * 0.032, dtype=torch.float32)):
        moved = matrix(turn, dt)
        assert moved.dtype == dtype
        assert torch.equal(moved, torch.eye(3).roll(steps, 1))  # an impossible mode stays impossible


# dwelling


@pytest.mark.parametrize("dt", [0.1, 0.05, 0.02])
def test_modes_last_as_long_as_they_should(dt):
    stay = matrix(MarkovChain.dwelling([0.7, 2.0, 0.25], dt=0.1), dt).diagonal()
    torch.testing.assert_close(dt / (1 - stay), torch.tensor([0.7, 2.0, 0.25]))  # mean of a geometric law


def test_other_modes_follow_alike():
    leaving = matrix(MarkovChain.dwelling([0.7, 2.0, 0.25], dt=0.1), 0.1)
    torch.testing.assert_close(leaving[0, 1], leaving[0, 2])
    torch.testing.assert_close(leaving[2, 0], leaving[2, 1])


def test_first_mode_is_that_of_the_long_run():
    table = MarkovChain.dwelling([0.7, 2.0, 0.25], dt=0.1)(0.1).exp()
    torch.testing.assert_close(table[3] @ table[:3], table[3])


def test_dwelling_takes_a_tensor_of_times_and_whole_numbers():
    torch.testing.assert_close(MarkovChain.dwelling(torch.tensor([2, 3]))(DT), MarkovChain.dwelling([2.0, 3.0])(DT))


def test_a_mode_may_last_one_frame():
    table = matrix(MarkovChain.dwelling([DT, 1.0], dt=DT), DT)
    torch.testing.assert_close(table[0], torch.tensor([0.0, 1.0]))


# listening


def test_speech_weighs_the_two_matrices():
    alpha = torch.tensor([[0.0, 0.3], [0.9, 1.0], [0.5, 0.25]])
    moved = matrix(chain(silence=SILENCE), DT, alpha)
    assert moved.shape == (3, 2, 3, 3)
    a = alpha[..., None, None]
    torch.testing.assert_close(moved, a * torch.tensor(SPEECH) + (1 - a) * torch.tensor(SILENCE))


def test_each_matrix_is_taken_to_the_power_of_the_step():
    P, Q = torch.tensor(SPEECH), torch.tensor(SILENCE)
    moved = matrix(chain(silence=SILENCE), 2 * DT, torch.tensor(0.3))
    torch.testing.assert_close(moved, 0.3 * P @ P + 0.7 * Q @ Q)


def test_only_a_chain_with_a_matrix_for_silence_listens():
    assert chain(silence=SILENCE).listens
    assert not chain().listens
    torch.testing.assert_close(chain()(DT, torch.tensor([0.2, 0.9])), chain()(DT))


# gradients and zeros


@pytest.mark.parametrize("dt", [DT, 0.4 * DT, 2.6 * DT])
def test_gradients(dt):
    alpha = torch.tensor([0.2, 0.7])
    assert_gradients(chain(silence=SILENCE), lambda made, alpha: made(dt, alpha), alpha)


@pytest.mark.parametrize("dt", [DT, 0.4 * DT, 3 * DT])
def test_impossible_modes_stay_impossible_and_have_no_gradient(dt):
    made = MarkovChain([1, 0], [[0.8, 0.2], [0, 1]])
    made(dt)[torch.tensor([[True, True], [False, True], [True, False]])].sum().backward()
    assert made(dt)[1, 0] == made(dt)[2, 1] == -math.inf
    assert made.logit_transition.grad.isfinite().all()
    assert (made.logit_transition.grad[1] == 0).all()
    assert (made.logit_initial.grad == 0).all()
    assert (made.logit_transition.grad[0] != 0).all()


def test_impossible_modes_stay_impossible_in_learning():
    made = MarkovChain([1, 0], [[0.8, 0.2], [0, 1]], silence=[[0.5, 0.5], [0, 1]])
    optimiser = torch.optim.Adam(made.parameters(), lr=0.1)
    for _ in range(3):
        optimiser.zero_grad()
        (-made(DT, torch.tensor(0.4))[0, 1]).backward()
        optimiser.step()
    learned = made(DT, torch.tensor(0.4)).exp()
    assert learned[1, 0] == learned[2, 1] == 0
    assert learned[0, 1] > 0.4 * 0.2 + 0.6 * 0.5
    torch.testing.assert_close(learned.sum(-1), torch.ones(3))


def test_probabilities_need_not_sum_to_one_beyond_rounding():
    third = torch.full((3,), 1 / 3, dtype=torch.float32)
    made = MarkovChain(third, [[1 / 3] * 3] * 3)
    torch.testing.assert_close(made(DT).exp().sum(-1), torch.ones(4), rtol=0, atol=1e-15)


def test_float32():
    double = chain(silence=SILENCE)(1.3 * DT, torch.tensor(0.3))
    torch.set_default_dtype(torch.float32)
    single = chain(silence=SILENCE)(1.3 * DT, torch.tensor(0.3))
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), double, rtol=1e-5, atol=1e-6)


# a module


def test_survives_saving():
    assert_survives_saving(chain(silence=SILENCE), lambda made: made(DT, torch.tensor(0.3)).detach())


def test_a_copy_has_its_own_probabilities():
    made = chain()
    other = copy.deepcopy(made)
    with torch.no_grad():
        other.logit_transition[0, 1] += 1
    torch.testing.assert_close(matrix(made, DT), torch.tensor(SPEECH))
    assert matrix(other, DT)[0, 1] > SPEECH[0][1]


def test_learns_first_mode_and_transitions_with_and_without_speech():
    assert {n for n, _ in chain().named_parameters()} == {"logit_initial", "logit_transition"}
    assert "logit_silence" in dict(chain(silence=SILENCE).named_parameters())


def test_shows_its_probabilities():
    assert repr(MarkovChain([0.25, 0.75], [[1, 0], [0.5, 0.5]], dt=0.1)) == (
        "MarkovChain(initial=[0.25, 0.75], transition=[[1.0, 0.0], [0.5, 0.5]], dt=0.1 s)"
    )


# mistakes


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("initial", [0.5, 0.4, 0.2], r"initial must have rows that sum to 1, got sums 1\.1"),
        ("initial", [1.5, -0.5, 0.0], r"initial must be finite and not negative, got \[1\.5, -0\.5, 0\.0\]"),
        ("initial", [math.nan, 0.5, 0.5], "initial must be finite and not negative"),
        ("transition", [[0.7, 0.2, 0.2], *SPEECH[1:]], r"transition must have rows that sum to 1, got sums \[1\.1, "),
        ("transition", [[1.2, -0.2, 0.0], *SPEECH[1:]], "transition must be finite and not negative"),
        ("transition", [[math.inf, 0.0, 0.0], *SPEECH[1:]], "transition must be finite and not negative"),
        ("silence", [[0.7, 0.2, 0.2], *SPEECH[1:]], "silence must have rows that sum to 1"),
        ("silence", [[math.nan, 0.5, 0.5], *SPEECH[1:]], "silence must be finite and not negative"),
    ],
)
def test_rejects_what_are_no_probabilities(name, value, message):
    with pytest.raises(InputError, match=message):
        MarkovChain(**{"initial": FIRST, "transition": SPEECH, "silence": SILENCE} | {name: value})


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("initial", [[0.2, 0.8]], r"initial must have shape \(S,\), got \(1, 2\)"),
        ("initial", 1.0, r"initial must be a table of numbers, got 1\.0"),
        ("initial", None, "initial must be a table of numbers with rows of one length, got None"),
        ("transition", SPEECH[:2], r"transition must have shape \(3, 3\), got \(2, 3\)"),
        ("transition", [[0.5, 0.5]] * 2, r"transition must have shape \(3, 3\), got \(2, 2\)"),
        ("transition", [[0.5, 0.5], [1.0], [0.0, 1.0]], r"transition must be a table .* of one length, got \[\[0\.5"),
        ("silence", [SILENCE], r"silence must have shape \(3, 3\), got \(1, 3, 3\)"),
        ("silence", [[0.5, 0.5], [1.0], [0.0, 1.0]], "silence must be a table of numbers with rows of one length"),
    ],
)
def test_rejects_other_shapes(name, value, message):
    with pytest.raises(ShapeError, match=message):
        MarkovChain(**{"initial": FIRST, "transition": SPEECH, "silence": SILENCE} | {name: value})


@pytest.mark.parametrize("dt", [0.0, -0.01, math.nan, math.inf])
def test_rejects_a_time_step_that_is_none(dt):
    several = torch.tensor([DT, dt])
    for act in (
        lambda: chain(dt=dt),
        lambda: chain()(dt),
        lambda: chain()(several),
        lambda: MarkovChain.dwelling([1.0, 2.0], dt=dt),
    ):
        with pytest.raises(InputError, match="dt must be finite and positive"):
            act()


STEPS = [[DT, 0.4 * DT, 3 * DT], [7.3 * DT, 1000 * DT, 1e-6]]


def test_each_talker_has_its_own_time_step():
    made = chain()
    table = made(torch.tensor(STEPS))
    assert table.shape == (2, 3, made.num_modes + 1, made.num_modes)
    for row, steps in zip(table, STEPS, strict=True):
        for one, dt in zip(row, steps, strict=True):
            torch.testing.assert_close(one, made(dt), rtol=0, atol=1e-14)


def test_each_talker_has_its_own_time_step_and_speech():
    made, alpha = chain(silence=SILENCE), torch.rand(4, 2, 3)
    table = made(torch.tensor(STEPS), alpha)
    for i, j, k in [(0, 0, 1), (3, 1, 0), (2, 1, 1)]:
        torch.testing.assert_close(table[i, j, k], made(STEPS[j][k], alpha[i, j, k]))


def test_long_steps_are_powers():
    made, steps = chain(), torch.tensor([0.0, 1.0, 2.0, 5.0, 13.0, 64.0]) + 1
    for n, table in zip(steps.tolist(), made(steps * DT).exp(), strict=True):
        torch.testing.assert_close(table[:-1], torch.linalg.matrix_power(matrix(made, DT), int(n)))


def test_gradients_of_steps_that_differ():
    assert_gradients(chain(silence=SILENCE), lambda made, alpha: made(torch.tensor(STEPS), alpha), torch.rand(2, 3))


def test_the_matrices_are_for_one_time_step():
    for act in (chain, lambda dt: MarkovChain.dwelling([1.0, 2.0], dt=dt)):
        with pytest.raises(InputError, match=r"dt must be one number for the matrices of a chain, got shape \(2,\)"):
            act(dt=torch.tensor([0.1, 0.2]))


@pytest.mark.parametrize("value", [-0.1, 1.001, math.nan])
def test_rejects_speech_that_is_no_probability(value):
    with pytest.raises(InputError, match=r"speech must be a probability in \[0, 1\], got values from"):
        chain(silence=SILENCE)(DT, torch.tensor([0.5, value]))


def test_rejects_silence_about_speech():
    with pytest.raises(InputError, match="speech must be given to a chain that listens to it, got None"):
        chain(silence=SILENCE)(DT)


@pytest.mark.parametrize("times", [[1.0, 0.0], [1.0, -2.0], [1.0, math.nan], [math.inf, 1.0]])
def test_rejects_times_that_are_none(times):
    with pytest.raises(InputError, match="times must be finite and positive"):
        MarkovChain.dwelling(times)


def test_rejects_times_below_a_frame():
    with pytest.raises(InputError, match=r"times must be at least dt = 0\.1 s, got \[0\.05, 1\.0\]"):
        MarkovChain.dwelling([0.05, 1.0], dt=0.1)


@pytest.mark.parametrize("times", [[], [1.0], 2.0, [[1.0, 2.0]]])
def test_rejects_times_of_fewer_than_two_modes(times):
    with pytest.raises(ShapeError, match=r"times must have shape \(S,\) with S at least 2"):
        MarkovChain.dwelling(times)


@pytest.mark.parametrize("dt", [0.032, 1.0, 1000.0, 32_000.0])
def test_rows_sum_to_one_in_float32_however_long_the_step(dt):
    chain = MarkovChain([0.3, 0.7], [[0.9, 0.1], [0.2, 0.8]]).float()
    torch.testing.assert_close(chain(dt).exp().sum(-1), torch.ones(3, dtype=torch.float32), rtol=0, atol=1e-6)
