"""Scalar processes: against their printed steps, the law of two half steps, and values of zero."""

import pytest
import torch
from properties import assert_gradients, assert_survives_saving

from probtrack.dynamics import RandomWalk, TimeCorrelated, WhiteNoise
from probtrack.errors import InputError

PROCESSES = {
    "random walk": lambda: RandomWalk(0.7),
    "time-correlated": lambda: TimeCorrelated(rate=1.3, std=0.6),
    "white noise": lambda: WhiteNoise(0.4),
}
ZERO = {
    "no diffusion": lambda: RandomWalk(0.0),
    "no rate": lambda: TimeCorrelated(rate=0.0, std=0.6),
    "no spread": lambda: TimeCorrelated(rate=1.3, std=0.0),
    "no rate or spread": lambda: TimeCorrelated(rate=0.0, std=0.0),
    "no intensity": lambda: WhiteNoise(0.0),
}
CONTINUOUS = ["random walk", "time-correlated"]


@pytest.mark.parametrize("dt", [0.008, 0.4, 30.0])
def test_steps_are_those_of_the_paper(dt):
    sigma, T = 0.6, torch.tensor(dt)
    step = TimeCorrelated(rate=1.3, std=sigma)(dt)  # eq. 11
    torch.testing.assert_close(step.decay, (-1.3 * T).exp())
    torch.testing.assert_close(step.std, sigma * (1 - (-2 * 1.3 * T).exp()).sqrt())
    step = RandomWalk(sigma / dt**0.5)(dt)  # eq. 9
    torch.testing.assert_close(torch.stack([*step]), torch.tensor([1.0, sigma]))
    step = WhiteNoise(sigma * dt**0.5)(dt)  # eq. 29
    torch.testing.assert_close(torch.stack([*step]), torch.tensor([0.0, sigma]))


@pytest.mark.parametrize("name", CONTINUOUS)
@pytest.mark.parametrize("parts", [(0.2, 0.2), (0.01, 1.7), (5.0, 0.3)])
def test_two_steps_make_one_of_both_times(name, parts):
    process = PROCESSES[name]()
    (a, s), (b, r), whole = process(parts[0]), process(parts[1]), process(sum(parts))
    torch.testing.assert_close(a * b, whole.decay)
    torch.testing.assert_close(b**2 * s**2 + r**2, whole.std**2)


@pytest.mark.parametrize("steps", [1, 10, 250])
def test_white_noise_moves_what_it_drives_alike_at_every_frame_rate(steps):
    dt = 2.0 / steps
    change = steps * (dt * WhiteNoise(0.4)(dt).std) ** 2
    torch.testing.assert_close(change, torch.tensor(2 * 0.4**2))


def test_correlation_over_time_is_exponential():
    process, dt, frames = TimeCorrelated(rate=1.3, std=0.6), 0.25, 5
    decay, std = process(dt)
    values = [0.6 * torch.randn(40_000)]
    for _ in range(frames):
        values.append(decay * values[-1] + std * torch.randn(40_000))
    products = values[0] * torch.stack(values)
    expected = 0.36 * torch.exp(-1.3 * dt * torch.arange(frames + 1))  # eq. 13
    assert ((products.mean(1) - expected).abs() < 5 * products.std(1) / 40_000**0.5).all()


@pytest.mark.parametrize("name", CONTINUOUS)
def test_short_steps_follow_the_differential_equation(name):
    dt, process = 1e-7, PROCESSES[name]()
    (decay, std), (rate, intensity) = process(dt), process.diffusion()
    torch.testing.assert_close((1 - decay) / dt, rate, rtol=1e-6, atol=0)
    torch.testing.assert_close(std**2 / dt, intensity**2, rtol=1e-6, atol=0)


@pytest.mark.parametrize("rate", [1e-300, 1e-30, 1e-12])
def test_slow_forgetting_is_a_random_walk(rate):
    decay, std = TimeCorrelated(rate=rate, std=0.6)(0.5)
    walk = RandomWalk(0.6 * (2 * rate) ** 0.5)(0.5)
    torch.testing.assert_close(decay, walk.decay, rtol=0, atol=rate)
    torch.testing.assert_close(std, walk.std, rtol=1e-12, atol=0)  # the log of 1e-300 is 700, its last digit 1e-13


@pytest.mark.parametrize("rate", [1e3, 1e30])
def test_fast_forgetting_is_a_new_value_each_step(rate):
    step = TimeCorrelated(rate=rate, std=0.6)(0.5)
    torch.testing.assert_close(torch.stack([*step]), torch.tensor([0.0, 0.6]))


@pytest.mark.parametrize("name", PROCESSES)
def test_gradients_are_finite_differences(name):
    assert_gradients(PROCESSES[name](), lambda p, dt: torch.stack([*p(dt)]), torch.rand(3) + 0.1)


@pytest.mark.parametrize("name", CONTINUOUS)
def test_gradients_of_the_differential_equation_are_finite_differences(name):
    assert_gradients(PROCESSES[name](), lambda p: torch.stack([*p.diffusion()]))


@pytest.mark.parametrize("make", ZERO.values(), ids=ZERO)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_zero_makes_no_noise_and_stays_zero_in_learning(make, dtype):
    process, dt = make().to(dtype), torch.tensor([0.1, 2.0], dtype=dtype, requires_grad=True)
    before = [p.detach().clone() for p in process.parameters()]
    decay, std = process(dt)
    (decay + std).sum().backward()
    assert torch.equal(std, torch.zeros(2, dtype=dtype))
    assert decay.isfinite().all()
    assert dt.grad.isfinite().all()
    torch.optim.Adam(process.parameters()).step()
    for parameter, start in zip(process.parameters(), before, strict=True):
        assert parameter.grad.isfinite()
        assert parameter.isfinite() == start.isfinite()


@pytest.mark.parametrize("name", CONTINUOUS)
def test_zero_has_a_differential_equation_without_noise(name):
    process = {"random walk": RandomWalk(0.0), "time-correlated": TimeCorrelated(0.0, 0.6)}[name]
    rate, intensity = process.diffusion()
    (rate + intensity).backward()
    assert rate == intensity == 0
    assert all(p.grad.isfinite() for p in process.parameters())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("log_rate", [-1000.0, -80.0, -20.0, 0.0, 20.0, 80.0])
def test_gradients_are_finite_at_any_rate(log_rate, dtype):
    process, dt = TimeCorrelated(rate=1.0, std=2.0).to(dtype), torch.tensor(0.5, dtype=dtype, requires_grad=True)
    torch.nn.init.constant_(process.log_rate, log_rate)
    sum([*process(dt), *process.diffusion()]).backward()
    assert all(g.isfinite() for g in (dt.grad, process.log_rate.grad, process.log_std.grad))


@pytest.mark.parametrize("name", PROCESSES)
def test_single_precision_is_close_to_double(name):
    double, single = PROCESSES[name](), PROCESSES[name]().float()
    for rough, fine in zip(single(0.004), double(0.004), strict=True):
        assert rough.dtype == torch.float32
        torch.testing.assert_close(rough.double(), fine, rtol=1e-6, atol=0)


@pytest.mark.parametrize("name", PROCESSES)
def test_each_talker_may_have_its_own_dt(name):
    process, dt = PROCESSES[name](), torch.tensor([[0.1], [0.5], [2.0]])
    decay, std = process(dt)
    assert decay.shape == std.shape == (3, 1)
    torch.testing.assert_close(torch.stack([decay[2, 0], std[2, 0]]), torch.stack([*process(2.0)]))


@pytest.mark.parametrize("name", PROCESSES)
def test_parameters_survive_saving(name):
    assert_survives_saving(PROCESSES[name](), lambda p: torch.stack([*p(0.3)]))


@pytest.mark.parametrize("bad", [-1.0, float("nan"), float("inf")])
@pytest.mark.parametrize(
    ("make", "name"),
    [
        (RandomWalk, "diffusion"),
        (WhiteNoise, "intensity"),
        (lambda x: TimeCorrelated(rate=x, std=1.0), "rate"),
        (lambda x: TimeCorrelated(rate=1.0, std=x), "std"),
    ],
)
def test_a_parameter_that_is_none_is_named(make, name, bad):
    with pytest.raises(InputError, match=f"{name} must be finite and not negative, got {bad}"):
        make(bad)


@pytest.mark.parametrize("name", PROCESSES)
@pytest.mark.parametrize("bad", [0.0, -0.1, float("nan"), float("inf"), [0.1, 0.0]])
def test_a_time_that_is_none_is_named(name, bad):
    with pytest.raises(InputError, match="dt must be finite and positive, got"):
        PROCESSES[name]()(torch.tensor(bad))


def test_white_noise_has_no_differential_equation():
    with pytest.raises(
        InputError, match="WhiteNoise has no value in continuous time: let RandomWalk drive one derivative lower"
    ):
        WhiteNoise(0.4).diffusion()


def test_repr_shows_physical_values():
    shown = [repr(make()) for make in PROCESSES.values()]
    assert shown == ["RandomWalk(diffusion=0.7)", "TimeCorrelated(rate=1.3/s, std=0.6)", "WhiteNoise(intensity=0.4)"]


def test_rejects_what_is_not_one_number():
    with pytest.raises(InputError, match=r"diffusion must be one number, got shape \(2,\)"):
        RandomWalk(torch.ones(2))
    with pytest.raises(InputError, match="rate must be a number, got 'fast'"):
        TimeCorrelated("fast", 0.7)
