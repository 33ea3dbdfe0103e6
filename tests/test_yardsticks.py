"""The exact figures that resampling schemes are held against, and what holds for schemes against them."""

import json
import math

import pytest
import torch
from torch.distributions import MultivariateNormal, Normal

from experiments import resampling_schemes, stochastic_volatility
from experiments.autoregressive import Autoregressive, EachRun, NoisyPosition, Volatility
from experiments.resampling_schemes import MODELS, Scheme, estimated, exact, moments, simulate
from experiments.stochastic_volatility import exact_fit, exact_log_evidence
from probtrack.dynamics import Kinematics, lehmann2007
from probtrack.errors import InputError
from probtrack.filters import StopGradient
from probtrack.filters.resampling import multinomial, systematic

NAIVE, STOP = Scheme(multinomial), Scheme(StopGradient(multinomial))


def dense_log_evidence(seen, a, log_q, log_r):
    """Return log p of a scalar sequence (T,) by its covariance: Var x_0 = 1, x_t = a x_{t-1} + q u, y = x + r e."""
    frames = len(seen)
    variance = [a**2 + (2 * log_q).exp()]
    for _ in range(frames - 1):
        variance.append(a**2 * variance[-1] + (2 * log_q).exp())
    rows = [[variance[min(i, j)] * a ** abs(i - j) for j in range(frames)] for i in range(frames)]
    covariance = torch.stack([torch.stack(row) for row in rows]) + (2 * log_r).exp() * torch.eye(frames)
    return MultivariateNormal(torch.zeros(frames), covariance).log_prob(seen)


def test_exact_evidence_and_gradient_are_those_of_the_dense_covariance():
    model = MODELS["autoregressive, d = 1"](3)
    seen = simulate(model, 7, seed=0)
    truth = exact(model, seen)
    for run in range(3):
        at = [torch.tensor(x, requires_grad=True) for x in (0.5, 0.0, 0.5 * math.log(0.5))]
        value = dense_log_evidence(seen[:, run, 0], *at)
        gradients = torch.autograd.grad(value, at)
        torch.testing.assert_close(truth.log_evidence[run], value.detach())
        for found, wanted in zip(truth.gradient.values(), gradients, strict=True):
            torch.testing.assert_close(found[run], wanted)


def test_dimensions_add_their_evidence():
    wide, narrow = MODELS["autoregressive, d = 2"](3), MODELS["autoregressive, d = 1"](3)
    seen = simulate(wide, 5, seed=1)
    both, each = exact(wide, seen), [exact(narrow, seen[..., k : k + 1]) for k in range(2)]
    torch.testing.assert_close(both.log_evidence, each[0].log_evidence + each[1].log_evidence)
    torch.testing.assert_close(both.gradient["a"], each[0].gradient["a"] + each[1].gradient["a"])


def test_simulated_sequences_have_the_model_s_covariance():
    seen = simulate(MODELS["autoregressive, d = 1"](40_000), 2, seed=0)[..., 0]
    first, second = 0.25 + 1, 0.25 * (0.25 + 1) + 1  # variances of the state
    wanted = torch.tensor([[first + 0.5, 0.5 * first], [0.5 * first, second + 0.5]])
    spread = (
        wanted.square() + wanted.diagonal()[:, None] * wanted.diagonal()
    ).sqrt() / 200  # of a normal law's moments
    assert ((torch.cov(seen) - wanted).abs() < 5 * spread).all()


def test_runs_with_parameters_of_their_own_move_like_single_models():
    model = lehmann2007("CU-LAN")
    runs = EachRun(lehmann2007("CU-LAN"), 2)
    runs.model.axis_model.process.log_rate.data[1] += 1.0
    state, noise = torch.randn(2, 5, 4), torch.randn(2, 5, 2)
    moved = runs.transition(0.3)(state, noise)
    torch.testing.assert_close(moved[0], model.transition(0.3)(state[0], noise[0]))
    model.axis_model.process.log_rate.data += 1.0
    torch.testing.assert_close(moved[1], model.transition(0.3)(state[1], noise[1]))
    F, G = runs.matrices(0.3)
    torch.testing.assert_close(moved[1], state[1] @ F[1].mT + noise[1] @ G[1].mT)


def test_the_law_of_a_step_agrees_with_the_step_whatever_lies_between_batch_and_particles():
    model = Autoregressive(torch.tensor([0.3, 0.8]).view(2, 1, 1), torch.tensor([0.5, 2.0]).view(2, 1, 1), dim=3)
    state, noise = torch.randn(2, 5, 3), torch.randn(2, 5, 3)
    moved = model.transition(1.0)(state, noise)
    law = model(state, 1.0)
    torch.testing.assert_close((moved - law.mean) / law.stddev, noise)
    between = model(state[:, None].expand(2, 4, 5, 3), 1.0)
    torch.testing.assert_close(between.mean[:, 2], law.mean)
    torch.testing.assert_close(between.stddev[:, 2], law.stddev)


def test_likelihoods_of_the_yardsticks_are_normal_densities():
    state, seen = torch.randn(2, 5, 3), torch.randn(4, 2, 3)
    position = Kinematics(state, torch.zeros_like(state))
    noisy = NoisyPosition(torch.tensor([[0.3], [2.0]]))
    wanted = Normal(state, torch.tensor([0.3, 2.0]).view(2, 1, 1)).log_prob(seen[1][:, None]).sum(-1)
    torch.testing.assert_close(noisy(noisy.prepare(seen)[1], position), wanted)
    volatility = Volatility(0.7)
    wanted = Normal(0.0, 0.7 * (state[..., :1] / 2).exp()).log_prob(seen[1][:, None, :1]).sum(-1)
    found = volatility(volatility.prepare(seen[..., :1])[1], Kinematics(state[..., :1], state[..., :1]))
    torch.testing.assert_close(found, wanted)


def test_stop_gradient_weighted_by_the_evidence_has_the_exact_gradient_as_its_mean():
    """E[Z grad log Z] = grad E[Z]: the estimate of the evidence itself, not of its logarithm, is unbiased."""
    runs = 6000
    model = MODELS["autoregressive, d = 1"](runs)
    seen = simulate(MODELS["autoregressive, d = 1"](1), 5, seed=3).expand(-1, runs, -1)
    truth, bias = exact(model, seen), {}
    for name, scheme in (("naive", NAIVE), ("stop", STOP)):
        found = estimated(model, seen, scheme, 4, seed=0)
        ratio = (found.log_evidence - truth.log_evidence).exp()
        assert abs(ratio.mean() - 1) < 5 * ratio.std() / runs**0.5
        errors = [ratio * found.gradient[key] - truth.gradient[key] for key in truth.gradient]
        bias[name] = [float(e.mean() / (e.std() / runs**0.5)) for e in errors]
    assert max(map(abs, bias["stop"])) < 5
    assert max(map(abs, bias["naive"])) > 8


def test_the_first_cloud_is_drawn_from_the_law_that_the_exact_filter_starts_from():
    for name in ("autoregressive, d = 2", "CU-LAN, d = 4"):
        model, seen, size = MODELS[name](2), torch.zeros(1, 2, 2), 40_000
        found, truth = estimated(model, seen, NAIVE, size, seed=0), exact(model, seen)
        # over particles the likelihood varies by less than its mean: two normal laws of about one width
        assert (found.log_evidence - truth.log_evidence).abs().max() < 5 / size**0.5


def test_a_gradient_cut_later_than_the_end_is_whole_and_a_cut_changes_no_value():
    model = MODELS["autoregressive, d = 1"](3)
    seen = simulate(model, 6, seed=0)
    whole, cut, late = (estimated(model, seen, Scheme(StopGradient(systematic), c), 5, seed=0) for c in (None, 2, 6))
    torch.testing.assert_close(cut.log_evidence, whole.log_evidence)
    torch.testing.assert_close(late.gradient, whole.gradient)
    assert (cut.gradient["a"] - whole.gradient["a"]).abs().max() > 0.01
    first = estimated(model, seen[:2], Scheme(StopGradient(systematic)), 5, seed=0)
    once = estimated(model, seen[:2], Scheme(StopGradient(systematic), 2), 5, seed=0)
    torch.testing.assert_close(once.gradient, first.gradient)


def test_bias_on_a_sequence_and_chance_are_told_apart():
    torch.manual_seed(0)
    repeats, sequences = 4, 20_000
    error = 0.7 + 2.0 * torch.randn(sequences) + 5.0 * torch.randn(repeats, sequences)
    found = moments(error)
    assert abs(found["bias"] - 0.7) < 5 * found["se"]
    assert found["se"] == pytest.approx(math.sqrt((4 + 25 / repeats) / sequences), rel=0.05)
    assert found["rms_bias"] == pytest.approx(math.sqrt(0.49 + 4), rel=0.05)
    assert found["chance"] == pytest.approx(5.0, rel=0.02)
    means = torch.randn(2000, 4, 50)
    squares = (means.mean(1).square() - means.var(1) / 4).mean(-1)
    assert moments(torch.randn(4, 50))["resolution"] ** 2 == pytest.approx(2 * float(squares.std()), rel=0.3)


def test_the_grid_s_evidence_of_a_volatility_is_that_of_many_draws():
    alpha, runs = torch.tensor([0.6]), 400_000
    seen = torch.tensor([0.3, -1.2, 0.05]).view(3, 1, 1, 1)
    torch.manual_seed(0)
    state, log_p = torch.randn(runs) / math.sqrt(1 - 0.36), torch.zeros(runs)
    for value in seen.flatten():
        state = 0.6 * state + torch.randn(runs)
        log_p = log_p + Normal(0.0, 0.5 * (state / 2).exp()).log_prob(value)
    p = log_p.exp()
    found = exact_log_evidence(alpha, seen)[0, 0].exp()
    assert abs(p.mean() - found) < 5 * p.std() / runs**0.5
    torch.testing.assert_close(exact_log_evidence(alpha, seen, 0.1), exact_log_evidence(alpha, seen))


def test_the_exact_fit_is_where_the_evidence_is_largest():
    seen = stochastic_volatility.simulate(torch.full((2, 1, 1, 1), 0.91), 20, seed=0)
    best = exact_fit(seen)
    at, below, above = (exact_log_evidence(best + shift, seen).sum(-1) for shift in (0, -1e-3, 1e-3))
    assert (at > below).all()
    assert (at > above).all()
    # a normal law of the fit: twice what its curvature says, five standard errors
    curvature = (2 * at - above - below) / 1e-6
    assert ((best - 0.91).abs() < 5 * curvature.rsqrt()).all()


def test_simulated_volatilities_are_stationary():
    seen = stochastic_volatility.simulate(torch.full((1, 1, 1, 1), 0.91), 20_000, seed=0)
    log_square = (seen / 0.5).square().log()[..., 0].squeeze(1)
    variance = 1 / (1 - 0.91**2) + math.pi**2 / 2  # of the state and of log chi^2
    for frame in (0, 100):
        assert log_square[frame].var() == pytest.approx(variance, rel=0.06)
    lag = torch.cov(log_square[[50, 51]])[0, 1]
    assert lag == pytest.approx(0.91 / (1 - 0.91**2), rel=0.08)


def test_learning_runs_towards_the_truth_from_each_start():
    seen = stochastic_volatility.simulate(torch.full((2, 1, 1, 1), 0.91), 375, seed=0).float()
    started = stochastic_volatility.learn(Scheme(systematic), seen[:5], 0, seed=0)
    learned = stochastic_volatility.learn(Scheme(systematic), seen[:5], 1, seed=0)
    assert learned.shape == (2,)
    assert ((learned - 0.91).abs() < (started - 0.91).abs()).all()


def test_quick_study_of_schemes_prints_one_line_and_writes_table_and_picture(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(resampling_schemes, "SCHEMES", {"naive": NAIVE, "stop-gradient": STOP})
    resampling_schemes.main(resampling_schemes.Config(quick=True, out=tmp_path / "schemes"))
    (line,) = capsys.readouterr().out.splitlines()
    assert [row["scheme"] for row in json.loads(line)["result"]] == ["naive", "stop-gradient"]
    assert "| stop-gradient |" in (tmp_path / "schemes.md").read_text()
    assert (tmp_path / "schemes.png").stat().st_size > 10_000


def test_unknown_scheme_is_refused_before_any_work(tmp_path):
    with pytest.raises(InputError, match=r"schemes must be of naive, .*, got 'hard'"):
        stochastic_volatility.main(stochastic_volatility.Config(schemes=("hard",), out=tmp_path / "table"))
