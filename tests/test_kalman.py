"""Kalman filter and smoother: against dense conditioning of all frames at once."""

import numpy as np
import pytest
import torch
from oracles.joint_gaussian import JointGaussian
from properties import assert_gradients

from probtrack.dynamics import CoordinateUncoupled, DrivenVelocity, TimeCorrelated, euler, lehmann2007
from probtrack.errors import InputError, NotFiniteError, ShapeError
from probtrack.filters import Gaussian, LinearSystem, kalman_filter, kalman_smoother, position_system

T, D, K, J = 7, 3, 2, 2


def covariance(*batch, dim):
    root = torch.randn(*batch, dim, dim + 1)
    return root @ root.mT


def random_system(*lead):
    """System with fewer noises than states: G G^T has rank 2 of 3."""
    F, G = 0.6 * torch.randn(*lead, D, D), torch.randn(*lead, D, K)
    return LinearSystem(F, G, torch.randn(J, D), covariance(dim=J))


def random_initial(*batch):
    return Gaussian(torch.randn(*batch, D), covariance(*batch, dim=D))


def joint(system, initial):
    """Oracle of one sequence whose F and G are (T, ...) or constant."""
    F, G = (np.broadcast_to(x, (T, *x.shape[-2:])) for x in system[:2])
    return JointGaussian(F, G, system.H.numpy(), system.R.numpy(), initial.mean.numpy(), initial.covariance.numpy())


def assert_gaussian(belief, expected):
    for made, dense in zip(belief, expected, strict=True):
        torch.testing.assert_close(made, torch.as_tensor(dense))


def simulate(system, initial, frames, batch):
    """Return observations (frames, batch, J) of a system without leading dimensions."""
    x, ys = initial.mean + torch.randn(batch, D) @ torch.linalg.cholesky(initial.covariance).mT, []
    for _ in range(frames):
        x = x @ system.F.mT + torch.randn(batch, K) @ system.G.mT
        ys.append(x @ system.H.mT + torch.randn(batch, J) @ torch.linalg.cholesky(system.R).mT)
    return torch.stack(ys)


SEEN = {
    "all": [True] * T,
    "gaps": [True, False, False, True, True, False, True],
    "late": [False, False, True, True, True, True, True],
    "lost": [True, True, True, True, True, False, False],
    "none": [False] * T,
}


@pytest.mark.parametrize("seen", SEEN.values(), ids=SEEN)
@pytest.mark.parametrize("lead", [(), (T,)], ids=["constant", "time-varying"])
def test_beliefs_and_evidence_are_those_of_the_joint_law(seen, lead):
    system, initial, y = random_system(*lead), random_initial(), torch.randn(T, J)
    result = kalman_filter(y, system, initial, observed=torch.tensor(seen))
    dense = joint(system, initial)
    assert_gaussian(result.filtered, dense.filtered(y.numpy(), seen))
    assert_gaussian(kalman_smoother(result, system), dense.given(y.numpy(), np.flatnonzero(seen)))
    torch.testing.assert_close(result.log_evidence, torch.tensor(dense.log_evidence(y.numpy(), seen)))


def test_predictions_are_beliefs_of_a_frame_that_is_not_observed():
    system, initial, y = random_system(), random_initial(), torch.randn(T, J)
    dense, result = joint(system, initial), kalman_filter(y, system, initial)
    for t in range(T):
        mean, cov = dense.given(y.numpy(), list(range(t)))
        assert_gaussian((result.predicted.mean[t], result.predicted.covariance[t]), (mean[t], cov[t]))


def test_increments_add_up_to_the_evidence_of_every_beginning():
    system, initial, y = random_system(), random_initial(), torch.randn(T, J)
    increments, dense = kalman_filter(y, system, initial).increments, joint(system, initial)
    for t in range(T):
        beginning = dense.log_evidence(y.numpy(), [s <= t for s in range(T)])
        torch.testing.assert_close(increments[: t + 1].sum(), torch.tensor(beginning))


@pytest.mark.parametrize("lead", [(), (5,), (2, 5), (T, 1, 1), (T, 2, 5)])
def test_batch_elements_do_not_mix(lead):
    system, initial, y = random_system(*lead), random_initial(5), torch.randn(T, 2, 5, J)
    observed = torch.rand(T, 2, 5) < 0.7
    result = kalman_filter(y, system, initial, observed=observed)
    smoothed = kalman_smoother(result, system)
    F, G = (x.expand(T, 2, 5, *x.shape[-2:])[:, 1, 3] for x in system[:2])
    dense = joint(system._replace(F=F, G=G), Gaussian(initial.mean[3], initial.covariance[3]))
    one, seen = y[:, 1, 3].numpy(), observed[:, 1, 3].tolist()
    assert_gaussian([x[:, 1, 3] for x in result.filtered], dense.filtered(one, seen))
    assert_gaussian([x[:, 1, 3] for x in smoothed], dense.given(one, np.flatnonzero(seen)))
    torch.testing.assert_close(result.log_evidence[1, 3], torch.tensor(dense.log_evidence(one, seen)))


def test_permuting_the_batch_permutes_the_answer():
    system, initial, y, order = random_system(), random_initial(5), torch.randn(T, 5, J), torch.randperm(5)
    result = kalman_filter(y, system, initial)
    permuted = kalman_filter(y[:, order], system, Gaussian(initial.mean[order], initial.covariance[order]))
    torch.testing.assert_close(permuted.filtered.mean, result.filtered.mean[:, order])
    torch.testing.assert_close(permuted.log_evidence, result.log_evidence[order])


def test_every_frame_has_its_own_observation_error():
    system, initial, y = random_system(), random_initial(), torch.randn(T, J)
    R = system.R.repeat(T, 1, 1)
    R[2] *= 1e14
    ignored = kalman_filter(y, system, initial, observed=torch.arange(T) != 2)
    torch.testing.assert_close(
        kalman_filter(y, system._replace(R=R), initial).filtered.mean, ignored.filtered.mean, rtol=1e-6, atol=1e-6
    )


def test_what_is_missing_may_be_nan():
    system, initial, y, observed = random_system(), random_initial(), torch.randn(T, J), torch.arange(T) != 3
    result = kalman_filter(y, system, initial, observed=observed)
    y[3] = torch.nan
    again = kalman_filter(y, system, initial, observed=observed)
    torch.testing.assert_close(again, result, rtol=0, atol=0)
    for unused in (again.increments[3], again.innovation[3], again.precision[3], again.gain[3]):
        assert (unused == 0).all()


def test_innovations_are_standard_normal_where_the_system_is_true():
    system, initial = random_system(), random_initial()
    result = kalman_filter(simulate(system, initial, T, 2000), system, initial)
    squares = torch.einsum("tbi,tbij,tbj->tb", result.innovation, result.precision, result.innovation)
    assert ((squares.mean(1) - J).abs() < 5 * (2 * J / 2000) ** 0.5).all()  # chi-square with J degrees


def test_a_known_start_without_noise_stays_known():
    system = random_system()._replace(G=torch.zeros(D, K))
    initial = Gaussian(torch.randn(D), torch.zeros(D, D))
    result = kalman_filter(torch.randn(T, J), system, initial)
    path = torch.stack([torch.linalg.matrix_power(system.F, t + 1) @ initial.mean for t in range(T)])
    torch.testing.assert_close(kalman_smoother(result, system).mean, path)
    torch.testing.assert_close(result.filtered.covariance, torch.zeros(T, D, D))


def test_exact_observations_are_believed():
    system, initial = random_system()._replace(R=torch.zeros(J, J)), random_initial()
    y = torch.randn(T, J)
    smoothed = kalman_smoother(kalman_filter(y, system, initial), system)
    torch.testing.assert_close(smoothed.mean @ system.H.mT, y, rtol=1e-6, atol=1e-6)


def talker(frames, batch, *, dt, std, model):
    """Return noisy positions (frames, batch, A) of talkers that move like `model` from a stationary start."""
    with torch.no_grad():
        step, x = model.transition(dt), torch.cat([torch.randn(batch, 2), 0.8 * torch.randn(batch, 2)], -1)
        ys = []
        for _ in range(frames):
            x = step(x, torch.randn(batch, 2))
            ys.append(x[:, :2] + std * torch.randn(batch, 2))
    return torch.stack(ys)


def at_rest(speed=0.8):
    return Gaussian(torch.zeros(4), torch.diag(torch.tensor([1.0, 1.0, speed**2, speed**2])))


def test_position_system_is_dynamics_seen_with_error():
    model = lehmann2007("CU-LAN", 3)
    system = position_system(model, 0.032, torch.tensor([0.1, 0.2, 0.3]))
    torch.testing.assert_close(system[:2], model.matrices(0.032))
    torch.testing.assert_close(system.H, torch.eye(6)[:3])
    torch.testing.assert_close(system.R, torch.diag(torch.tensor([0.01, 0.04, 0.09])))
    torch.testing.assert_close(position_system(model, 0.032, 0.2).R, 0.04 * torch.eye(3))


def test_a_gap_is_one_long_step():
    model, y = lehmann2007("CU-RWVE"), torch.randn(3, 5, 2)
    with torch.no_grad():
        uneven = position_system(model, torch.tensor([0.1, 0.7, 0.2])[:, None], 0.2)
        whole = kalman_filter(y, uneven, at_rest()).filtered
        for t, dt in enumerate([0.1, 0.7, 0.2]):
            before = at_rest() if t == 0 else Gaussian(whole.mean[t - 1], whole.covariance[t - 1])
            one = kalman_filter(y[t : t + 1], position_system(model, dt, 0.2), before)
            torch.testing.assert_close(one.filtered.mean[0], whole.mean[t])


@pytest.mark.parametrize("seen", [[True] * 4, [True, False, True, True]])
def test_evidence_gradients_of_langevin_motion(seen):
    model, y = CoordinateUncoupled(DrivenVelocity(TimeCorrelated(rate=1.5, std=0.7), euler)), torch.randn(4, 2, 2)
    observed = torch.tensor(seen)[:, None].expand(4, 2)

    def evidence(model, y, std, dt):
        return kalman_filter(y, position_system(model, dt, std), at_rest(), observed=observed).log_evidence

    assert_gradients(model, evidence, y, torch.tensor(0.2), torch.tensor(0.1))


def test_smoother_gradients_of_langevin_motion():
    model, y = CoordinateUncoupled(DrivenVelocity(TimeCorrelated(rate=1.5, std=0.7), euler)), torch.randn(3, 2)

    def smoothed(model, y):
        system = position_system(model, 0.1, 0.2)
        return tuple(kalman_smoother(kalman_filter(y, system, at_rest()), system))

    assert_gradients(model, smoothed, y)


def test_nan_of_a_missing_frame_does_not_reach_the_gradient():
    model, y = lehmann2007("CU-LAN"), torch.randn(5, 2)
    y[2] = torch.nan
    result = kalman_filter(y, position_system(model, 0.032, 0.1), at_rest(), observed=torch.arange(5) != 2)
    (result.log_evidence + result.filtered.mean.sum()).backward()
    assert all(torch.isfinite(p.grad) and p.grad != 0 for p in model.parameters())


def test_maximum_evidence_recovers_langevin_motion():
    truth = CoordinateUncoupled(DrivenVelocity(TimeCorrelated(rate=1.3, std=0.8), euler))
    y = talker(60, 400, dt=0.25, std=0.05, model=truth)
    model = CoordinateUncoupled(DrivenVelocity(TimeCorrelated(rate=5.0, std=0.3), euler))
    optimiser = torch.optim.LBFGS(model.parameters(), line_search_fn="strong_wolfe", max_iter=20)

    def loss():
        optimiser.zero_grad()
        value = -kalman_filter(y, position_system(model, 0.25, 0.05), at_rest()).increments.mean()
        value.backward()
        return value

    optimiser.step(loss)
    for fitted, true in zip(model.parameters(), truth.parameters(), strict=True):
        assert abs(fitted.exp() / true.exp() - 1) < 0.1


def test_float32_is_close_to_float64_over_a_long_track():
    model = lehmann2007("CU-LAN")
    y = talker(400, 3, dt=0.032, std=0.05, model=model)
    with torch.no_grad():
        double = position_system(model, 0.032, 0.05)
        single = LinearSystem(*(x.float() for x in double))
        exact = kalman_filter(y, double, at_rest())
        rough = kalman_filter(y.float(), single, Gaussian(*(x.float() for x in at_rest())))
        assert rough.filtered.mean.dtype == torch.float32
        torch.testing.assert_close(rough.filtered.mean.double(), exact.filtered.mean, rtol=0, atol=1e-3 * 0.05)
        torch.testing.assert_close(rough.log_evidence.double(), exact.log_evidence, rtol=1e-5, atol=0)
        assert (torch.linalg.eigvalsh(rough.filtered.covariance) > -1e-7).all()
        smooth = kalman_smoother(rough, single).mean.double()
    torch.testing.assert_close(smooth, kalman_smoother(exact, double).mean, rtol=0, atol=1e-2 * 0.05)


def test_frame_that_is_not_finite_is_named():
    y = torch.randn(T, 4, J)
    y[5, 2, 1] = torch.inf
    with pytest.raises(NotFiniteError, match=r"observations must be finite, not so in frame 5: .*observed"):
        kalman_filter(y, random_system(), random_initial())


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"F": (D, 2)}, r"F must have shape \(\.\.\., 2, 2\), got \(3, 2\)"),
        ({"G": (2, K)}, r"G must have shape \(\.\.\., 3, 2\), got \(2, 2\)"),
        ({"H": (J, 4)}, r"H must have shape \(\.\.\., 2, 3\), got \(2, 4\)"),
        ({"R": (3, 3)}, r"R must have shape \(\.\.\., 2, 2\), got \(3, 3\)"),
        ({"F": (T + 1, 1, D, D)}, r"leading dimensions of F must broadcast to \(7, 4\), got \(8, 1\)"),
        ({"G": (T, D, K)}, r"leading dimensions of G must broadcast to \(7, 4\), got \(7,\)"),
    ],
)
def test_rejects_shapes_that_do_not_go_together(changed, match):
    system = random_system()._replace(**{name: torch.zeros(shape) for name, shape in changed.items()})
    with pytest.raises(ShapeError, match=match):
        kalman_filter(torch.randn(T, 4, J), system, random_initial())


@pytest.mark.parametrize(
    ("initial", "match"),
    [
        (lambda: random_initial(3), "leading dimensions of initial covariance"),
        (lambda: Gaussian(torch.zeros(2), torch.eye(D)), r"initial mean must have shape \(\.\.\., 3\)"),
        (lambda: Gaussian(torch.zeros(D), -torch.eye(D)), "initial covariance must be positive semi-definite"),
    ],
)
def test_rejects_an_initial_law_that_does_not_fit(initial, match):
    with pytest.raises(InputError, match=match):
        kalman_filter(torch.randn(T, 4, J), random_system(), initial())


@pytest.mark.parametrize(
    ("R", "match"),
    [
        ([[1.0, 0.2], [0.3, 1.0]], "R must be symmetric"),
        ([[1.0, 2.0], [2.0, 1.0]], "R must be positive semi-definite"),
        ([[1.0, float("nan")], [float("nan"), 1.0]], "R must be finite"),
    ],
)
def test_rejects_an_error_covariance_that_is_none(R, match):
    with pytest.raises(InputError, match=match):
        kalman_filter(torch.randn(T, J), random_system()._replace(R=torch.tensor(R)), random_initial())


def test_rejects_observations_without_frames_and_flags_of_another_shape():
    with pytest.raises(ShapeError, match=r"observations must have shape \(T, \*batch, J\) with T > 0"):
        kalman_filter(torch.zeros(0, J), random_system(), random_initial())
    with pytest.raises(ShapeError, match=r"observed must be bool of shape \(7, 4\), got torch.bool of shape \(7,\)"):
        kalman_filter(torch.zeros(T, 4, J), random_system(), random_initial(), observed=torch.ones(T) > 0)


def test_a_prediction_without_any_error_is_named():
    system = random_system()._replace(G=torch.zeros(D, K), R=torch.zeros(J, J))
    with pytest.raises(InputError, match="must be finite and positive definite, it is not in frame 0"):
        kalman_filter(torch.randn(T, J), system, Gaussian(torch.zeros(D), torch.zeros(D, D)))


def test_rejects_a_std_that_is_not_positive():
    with pytest.raises(InputError, match="std must be finite and positive"):
        position_system(lehmann2007("CU-LAN"), 0.032, 0.0)
