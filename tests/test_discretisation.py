"""Steps of driven coordinates: exact ones against a matrix exponential, printed ones against the exact."""

import numpy as np
import pytest
import torch
from oracles.van_loan import van_loan
from properties import assert_density_gradients, assert_gradients, assert_shapes
from torch.distributions import MultivariateNormal

from probtrack.distributions import LinearGaussian
from probtrack.dynamics import (
    DrivenAcceleration,
    DrivenVelocity,
    RandomWalk,
    TimeCorrelated,
    WhiteNoise,
    euler,
    exact,
    single_noise,
)
from probtrack.errors import InputError, NotFiniteError, SingularLawError

RATES = [1e-9, 1e-3, 0.2, 1.0, 10.0, 30.0, 3e3]
STEPS = [1e-4, 0.032, 0.5, 20.0]
ORDERS = [2, 3]
PROCESSES = {
    "random walk": lambda: RandomWalk(0.7),
    "slow": lambda: TimeCorrelated(rate=0.2, std=0.6),
    "fast": lambda: TimeCorrelated(rate=30.0, std=2.0),
}


def moments(matrix, gain):
    return matrix, gain @ gain.mT


def assert_moments_are(step, expected, rtol=1e-10):
    """Each within that fraction of the product of the standard deviations, so that units do not matter."""
    (matrix, cov), (F, Q) = moments(*step), expected
    torch.testing.assert_close(matrix, torch.as_tensor(F), rtol=rtol, atol=1e-290)
    torch.testing.assert_close(cov, torch.as_tensor(Q), rtol=rtol, atol=0)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("dt", STEPS)
@pytest.mark.parametrize("rate", RATES)
def test_exact_step_is_the_matrix_exponential(rate, dt, order):
    step = exact(TimeCorrelated(rate=rate, std=0.6), order, dt)
    assert_moments_are(step, van_loan(rate, 0.6 * (2 * rate) ** 0.5, dt, order))


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("dt", STEPS)
def test_exact_step_of_a_walk_is_the_matrix_exponential(dt, order):
    assert_moments_are(exact(RandomWalk(0.7), order, dt), van_loan(0.0, 0.7, dt, order))


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("parts", [(0.05, 0.05), (0.001, 0.7), (4.0, 0.3)])
@pytest.mark.parametrize("make", PROCESSES.values(), ids=PROCESSES)
def test_two_exact_steps_make_one_of_both_times(make, parts, order):
    (A, P), (B, Q) = (moments(*exact(make(), order, dt)) for dt in parts)
    assert_moments_are(exact(make(), order, sum(parts)), (B @ A, B @ P @ B.mT + Q))


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("make", PROCESSES.values(), ids=PROCESSES)
def test_exact_step_has_the_density_of_its_moments(make, order):
    matrix, gain = exact(make(), order, 0.4)
    law, value = LinearGaussian(torch.randn(5, order) @ matrix.mT, gain), torch.randn(3, 5, order)
    full = MultivariateNormal(law.mean, gain @ gain.mT)
    assert_shapes(law, (5,), (order,))
    torch.testing.assert_close(law.log_prob(value), full.log_prob(value))


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("discretise", [single_noise, euler])
def test_printed_steps_have_no_density(discretise, order):
    matrix, gain = discretise(TimeCorrelated(rate=1.3, std=0.6), order, 0.4)
    assert gain.shape == (order, 1)
    with pytest.raises(SingularLawError, match=f"1 noise numbers drive {order} variables"):
        LinearGaussian(matrix[0], gain).log_prob(matrix[0])


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("rate", [1e-9, 1e-5])
def test_slow_forgetting_is_a_driven_random_walk(rate, order):
    slow = exact(TimeCorrelated(rate=rate, std=0.6), order, 0.5)
    walk = exact(RandomWalk(0.6 * (2 * rate) ** 0.5), order, 0.5)
    assert_moments_are(slow, moments(*walk), rtol=rate)


@pytest.mark.parametrize("rate", [1e6, 1e12])
def test_fast_forgetting_diffuses_the_position(rate):
    _, gain = exact(TimeCorrelated(rate=rate, std=0.6), 2, 0.5)
    diffused = 2 * 0.36 * 0.5 / rate
    expected = torch.tensor([[diffused, 0.36 / rate], [0.36 / rate, 0.36]])
    torch.testing.assert_close(gain @ gain.mT, expected, rtol=4 / rate, atol=0)


@pytest.mark.parametrize(
    ("discretise", "process", "order", "T"),
    [
        (single_noise, RandomWalk(0.7), 2, [[1, 0.4], [0, 1], [0.2, 1]]),
        (single_noise, RandomWalk(0.7), 3, [[1, 0.4, 0.08], [0, 1, 0.4], [0, 0, 1], [0.16 / 6, 0.2, 1]]),
        (euler, RandomWalk(0.7), 2, [[1, 0.4], [0, 1], [0.4, 1]]),
        (euler, RandomWalk(0.7), 3, [[1, 0.4, 0.16], [0, 1, 0.4], [0, 0, 1], [0.16, 0.4, 1]]),
        (euler, WhiteNoise(0.7 * 0.4), 2, [[1, 0], [0, 0], [0.4, 1]]),
    ],
)
def test_one_noise_enters_every_derivative(discretise, process, order, T):
    *rows, lead = torch.tensor(T, dtype=torch.float64)
    matrix, gain = discretise(process.double(), order, 0.4)
    torch.testing.assert_close(matrix, torch.stack(rows))
    torch.testing.assert_close(gain[:, 0], 0.7 * 0.4**0.5 * lead)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("discretise", [single_noise, euler])
@pytest.mark.parametrize("make", PROCESSES.values(), ids=PROCESSES)
def test_printed_steps_move_and_drive_the_process_as_exact_ones(make, discretise, order):
    (F, P), (A, Q) = (moments(*step(make(), order, 0.4)) for step in (discretise, exact))
    torch.testing.assert_close(F[-1], A[-1])
    torch.testing.assert_close(P[-1, -1], Q[-1, -1])


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(("discretise", "error"), [(single_noise, 1e-14), (euler, 3.0)])
@pytest.mark.parametrize("make", PROCESSES.values(), ids=PROCESSES)
def test_mean_of_printed_steps_is_exact_to_first_order(make, discretise, error, order):
    dt = 1e-4
    change = (discretise(make(), order, dt)[0] - exact(make(), order, dt)[0]) / dt
    assert (change.abs() <= error * 31 * dt + 1e-14 / dt).all()  # 31: the fastest rate


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("discretise", [single_noise, euler])
@pytest.mark.parametrize("make", PROCESSES.values(), ids=PROCESSES)
def test_moments_of_many_printed_steps_approach_the_exact_ones(make, discretise, order):
    F, Q = moments(*exact(make(), order, 1.0))
    errors = []
    for steps in (2000, 4000):
        A, P = moments(*discretise(make(), order, 1 / steps))
        matrix, cov = torch.eye(order), torch.zeros(order, order)
        for _ in range(steps):
            matrix, cov = A @ matrix, A @ cov @ A.mT + P
        errors.append(max((matrix - F).abs().max() / F.abs().max(), ((cov - Q) / Q).abs().max()))
    assert errors[1] < 0.02
    assert errors[1] < 0.55 * errors[0] + 1e-9  # half, as the step is


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("discretise", [exact, single_noise, euler])
@pytest.mark.parametrize("make", PROCESSES.values(), ids=PROCESSES)
def test_gradients_are_finite_differences(make, discretise, order):
    assert_gradients(make(), lambda p, dt: discretise(p, order, dt), torch.tensor([0.02, 0.9]))


@pytest.mark.parametrize("order", ORDERS)
def test_gradients_of_the_density_are_finite_differences(order):
    def law(log_rate, log_std, dt):
        process = TimeCorrelated(1.0, 1.0)
        del process.log_rate, process.log_std
        process.log_rate, process.log_std = log_rate, log_std
        return LinearGaussian(torch.full((order,), 0.3), exact(process, order, dt)[1])

    assert_density_gradients(law, [torch.tensor(0.3), torch.tensor(-0.4), torch.tensor(0.8)], torch.randn(order))


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("discretise", [exact, single_noise, euler])
@pytest.mark.parametrize("process", [RandomWalk(0.0), TimeCorrelated(0.0, 0.6), TimeCorrelated(1.3, 0.0)], ids=repr)
def test_no_noise_has_values_and_gradients(process, discretise, order):
    process, dt = process.double(), torch.tensor(0.4, requires_grad=True)
    process.zero_grad()
    matrix, gain = discretise(process, order, dt)
    (matrix.sum() + gain.sum()).backward()
    assert torch.equal(gain, torch.zeros_like(gain))
    assert all(x.isfinite().all() for x in (matrix, dt.grad, *(p.grad for p in process.parameters())))
    with pytest.raises(SingularLawError):
        LinearGaussian(matrix[0], gain).log_prob(matrix[0])


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("discretise", [exact, single_noise, euler])
@pytest.mark.parametrize("log_rate", [-1000.0, -80.0, -20.0, 0.0, 20.0, 80.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_at_any_rate(dtype, log_rate, discretise, order):
    process, dt = TimeCorrelated(1.0, 2.0).to(dtype), torch.tensor(0.5, dtype=dtype, requires_grad=True)
    torch.nn.init.constant_(process.log_rate, log_rate)
    matrix, gain = discretise(process, order, dt)
    (matrix.sum() + gain.sum()).backward()
    assert all(x.isfinite().all() for x in (matrix, gain, dt.grad, process.log_rate.grad, process.log_std.grad))


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("dt", [0.002, 0.032, 0.5])
@pytest.mark.parametrize("rate", [1e-4, 0.2, 30.0])
def test_exact_step_in_single_precision_is_as_exact(rate, dt, order):
    matrix, gain = exact(TimeCorrelated(rate, 0.6).float(), order, dt)
    F, Q = van_loan(rate, 0.6 * (2 * rate) ** 0.5, dt, order)
    assert matrix.dtype == gain.dtype == torch.float32
    torch.testing.assert_close(matrix.double(), torch.as_tensor(F), rtol=1e-5, atol=0)
    torch.testing.assert_close(gain.double(), torch.as_tensor(np.linalg.cholesky(Q)), rtol=1e-5, atol=0)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("discretise", [exact, single_noise, euler])
@pytest.mark.parametrize("make", PROCESSES.values(), ids=PROCESSES)
def test_each_talker_may_have_its_own_dt(make, discretise, order):
    dt = torch.tensor([[0.01, 0.1], [0.4, 2.0], [0.2, 0.3]])
    matrix, gain = discretise(make(), order, dt)
    assert matrix.shape == (3, 2, order, order)
    assert gain.shape[:3] == (3, 2, order)
    one = discretise(make(), order, 2.0)
    torch.testing.assert_close((matrix[1, 1], gain[1, 1]), one)


@pytest.mark.parametrize("discretise", [exact, single_noise, euler])
def test_driven_coordinates_take_the_steps_of_their_discretisation(discretise):
    process = TimeCorrelated(rate=1.3, std=0.6)
    velocity, acceleration = DrivenVelocity(process, discretise), DrivenAcceleration(process, discretise)
    torch.testing.assert_close(velocity(0.4), discretise(process, 2, 0.4), rtol=0, atol=0)
    torch.testing.assert_close(acceleration(0.4), discretise(process, 3, 0.4), rtol=0, atol=0)
    assert f"discretise={discretise.__name__}" in repr(velocity)
    assert f"discretise={discretise.__name__}" in repr(acceleration)


@pytest.mark.parametrize("driven", [DrivenVelocity, DrivenAcceleration])
def test_a_coordinate_takes_exact_steps_unless_told(driven):
    process = TimeCorrelated(rate=1.3, std=0.6)
    torch.testing.assert_close(driven(process)(0.4), driven(process, exact)(0.4), rtol=0, atol=0)


@pytest.mark.parametrize("discretise", [exact, single_noise])
def test_what_has_no_solution_is_refused(discretise):
    with pytest.raises(InputError, match="WhiteNoise has no value in continuous time"):
        discretise(WhiteNoise(0.4), 2, 0.1)
    with pytest.raises(InputError, match=r"order must be 2 .* or 3 .*, got 4"):
        discretise(RandomWalk(0.4), 4, 0.1)


@pytest.mark.parametrize("discretise", [exact, single_noise, euler])
@pytest.mark.parametrize("bad", [0.0, -0.1, float("nan"), float("inf")])
def test_a_time_that_is_none_is_named(discretise, bad):
    with pytest.raises(InputError, match=f"dt must be finite and positive, got {bad}"):
        discretise(RandomWalk(0.4), 2, bad)


def test_a_rate_that_has_diverged_is_named():
    process = TimeCorrelated(1.0, 0.7)
    torch.nn.init.constant_(process.log_rate, torch.nan)
    with pytest.raises(NotFiniteError, match="the rate of a process is NaN or infinite"):
        exact(process, 2, 0.1)
