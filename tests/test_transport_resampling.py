"""Optimal transport: plans against plain loops and closed forms, gradients, and what they are limited to."""

import math

import pytest
import torch
from oracles import transport as oracle

from probtrack.errors import InputError
from probtrack.filters import Adaptive
from probtrack.filters.resampling import OptimalTransport, systematic
from probtrack.filters.resampling.sinkhorn import plan_gradients, potentials, transport_plan
from probtrack.filters.resampling.spread import half_squared_distances

NONE = torch.empty(0)


def cloud(*batch, size=13, dtype=torch.float64):
    """Clouds whose dimensions have units of their own, far from the origin."""
    scale = torch.tensor([0.1, 3.0, 40.0], dtype=dtype)
    state = scale * torch.randn(*batch, size, 3, dtype=dtype) + torch.tensor([5.0, -2.0, 100.0], dtype=dtype)
    return state, torch.log_softmax(1.5 * torch.randn(*batch, size, dtype=dtype), -1)


def exactly(epsilon, clip=math.inf):
    return OptimalTransport(epsilon, tolerance=1e-14, iterations=20_000, clip=clip)


@pytest.mark.parametrize("epsilon", [0.5, 0.1])
def test_new_particles_are_those_of_plain_loops(epsilon):
    state, log_weight = cloud(size=7)
    moved, weights = exactly(epsilon)(state, log_weight, NONE)
    expected = torch.tensor(oracle.blended(state.tolist(), log_weight.exp().tolist(), epsilon))
    torch.testing.assert_close(moved, expected, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(weights, torch.full((7,), -math.log(7)))
    assert OptimalTransport().num_uniforms(7, 4) == 0


def test_without_entropy_a_line_is_mapped_in_order():
    weight = torch.tensor([0.05, 0.3, 0.1, 0.35, 0.2])
    state = torch.tensor([0.3, -1.0, 2.0, 0.9, 5.0])[:, None]
    moved, _ = exactly(1e-3)(state, weight.log(), NONE)
    # the i-th of N equal masses takes its share of the sorted weighted ones
    order = state[:, 0].argsort()
    ends, equal = torch.cat([torch.zeros(1), weight[order].cumsum(0)]), torch.arange(6)[:, None] / 5
    taken = (torch.minimum(ends[1:], equal[1:]) - torch.maximum(ends[:-1], equal[:-1])).clamp_min(0)
    torch.testing.assert_close(moved[order, 0], 5 * taken @ state[order, 0], rtol=0, atol=2e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("epsilon", [1.0, 0.2, 0.05])
def test_rows_are_equal_and_columns_are_the_weights_within_the_tolerance(dtype, epsilon):
    points, log_weight = torch.randn(5, 41, 3, dtype=dtype), torch.log_softmax(2 * torch.randn(5, 41, dtype=dtype), -1)
    weight = log_weight.exp()
    plan = transport_plan(points, weight, *potentials(points, weight, epsilon, 1e-3, 1000), epsilon)
    torch.testing.assert_close(plan.sum(2), torch.full_like(weight, 1 / 41), rtol=2e-5, atol=0)
    assert ((plan.sum(1) - weight).abs().sum(1) < 1e-3).all()


@pytest.mark.parametrize("epsilon", [0.5, 0.01])
def test_float32_survives_weights_that_are_nearly_all_zero(epsilon):
    state = torch.randn(3, 50, 4, dtype=torch.float32) * torch.tensor([0.1, 0.1, 1, 1], dtype=torch.float32)
    log_weight = torch.log_softmax(-800 * (state[..., :2] - 0.15).square().sum(-1), -1).requires_grad_()
    log_weight.data[0] = -math.inf
    log_weight.data[0, 17] = 0
    state.requires_grad_()
    moved, _ = OptimalTransport(epsilon)(state, log_weight, NONE)
    torch.testing.assert_close(moved[0], state[0, 17].expand(50, 4), rtol=1e-4, atol=1e-5)
    moved.square().sum().backward()
    assert moved.isfinite().all()
    assert state.grad.isfinite().all()
    assert log_weight.grad.isfinite().all()


def test_mean_is_kept():
    state, log_weight = cloud(4)
    moved, _ = exactly(0.3)(state, log_weight, NONE)
    torch.testing.assert_close(moved.mean(1), (log_weight.exp()[..., None] * state).sum(1))


def test_units_and_origin_of_a_dimension_play_no_part():
    (state, log_weight), unit = cloud(), torch.tensor([1.0, 100.0, 1e-3])
    moved, _ = exactly(0.3)(state, log_weight, NONE)
    other, _ = exactly(0.3)(unit * state + 7, log_weight, NONE)
    torch.testing.assert_close(other, unit * moved + 7)


def test_a_dimension_in_which_all_agree_is_left_alone():
    state, log_weight = cloud()
    flat = torch.cat([state[:, :1], torch.full((13, 1), 0.7)], -1)
    moved, _ = exactly(0.3)(flat, log_weight, NONE)
    torch.testing.assert_close(moved[:, 1], flat[:, 1])
    assert moved[:, 0].std() > 0.01


def test_batches_do_not_mix_and_keep_variables_first():
    state, log_weight = cloud(2, 3)
    moved, weights = exactly(0.3)(state, log_weight, torch.empty(2, 3, 0))
    assert weights.shape == (2, 3, 13)
    assert moved.movedim(-1, 0).is_contiguous()
    for i, j in [(0, 2), (1, 1)]:
        torch.testing.assert_close(moved[i, j], exactly(0.3)(state[i, j], log_weight[i, j], NONE)[0])


def gradients(resample, state, logits, seed=1):
    state, logits = state.clone().requires_grad_(), logits.clone().requires_grad_()
    moved, _ = resample(state, torch.log_softmax(logits, -1), NONE)
    value = torch.randn(moved.shape, generator=torch.Generator().manual_seed(seed))
    return torch.autograd.grad((moved * value).sum(), [state, logits]), value


@pytest.mark.parametrize("epsilon", [0.5, 0.15])
def test_gradient_in_the_weights_is_the_finite_difference(epsilon):
    state, logits = cloud(size=7)
    (_, made), value = gradients(exactly(epsilon), state, logits)
    # spreads count as constants: they are held by a scale of their own
    unit = _unit(state, logits)
    for n in range(7):
        ends = []
        for step in (1e-5, -1e-5):
            shifted = logits + step * (torch.arange(7) == n)
            weight = shifted.softmax(-1)
            points = ((state - state.mean(0)) / unit)[None]
            pair = potentials(points, weight[None], epsilon, 1e-14, 20_000)
            ends.append((7 * transport_plan(points, weight[None], *pair, epsilon)[0] @ state * value).sum())
        assert made[n].item() == pytest.approx((ends[0] - ends[1]).item() / 2e-5, rel=1e-6, abs=1e-7)


def _unit(state, log_weight):
    weight = log_weight.softmax(-1)
    return ((weight @ (state - weight @ state).square()) * state.shape[1]).sqrt()


def test_plan_gradients_are_those_of_autograd_through_the_iterations():
    points = torch.randn(2, 6, 3, requires_grad=True)
    logits = torch.randn(2, 6, requires_grad=True)
    log_weight, cost = torch.log_softmax(logits, -1), 0.5 * (points[:, :, None] - points[:, None]).square().sum(-1)
    f, g = torch.zeros(2, 6), torch.zeros(2, 6)
    for _ in range(600):
        f = -0.4 * torch.logsumexp(log_weight[:, None] + (g[:, None] - cost) / 0.4, 2)
        g = -0.4 * (torch.logsumexp((f[:, :, None] - cost) / 0.4, 1) - math.log(6))
    plan = (log_weight[:, None] + (f[:, :, None] + g[:, None] - cost) / 0.4).exp() / 6
    value = torch.randn(2, 6, 3)
    through = (6 * plan @ points.detach() * value).sum()
    expected_points, expected_logits = torch.autograd.grad(through, [points, logits])
    of_points, of_weights = plan_gradients(plan.detach(), points.detach(), value, 0.4)
    torch.testing.assert_close(of_points, expected_points, rtol=1e-8, atol=1e-9)
    of_logits = of_weights - log_weight.exp() * of_weights.sum(1, keepdim=True)
    torch.testing.assert_close(of_logits, expected_logits, rtol=1e-8, atol=1e-9)


def test_gradient_in_the_states_moves_with_them():
    state, logits = cloud(size=7)
    (made, _), value = gradients(exactly(0.3), state, logits)
    # a shift of the whole cloud shifts all new particles
    torch.testing.assert_close(made.sum(0), value.sum(0))


def test_what_passes_the_plan_is_limited_cloud_by_cloud():
    state, logits = cloud(size=7)
    state[:3] += 4 * torch.tensor([0.1, 3.0, 40.0])  # two clusters: mass hangs on a thread between them
    (_, free), value = gradients(exactly(0.05), state, logits)
    (_, limited), _ = gradients(exactly(0.05, clip=0.5), state, logits)
    assert limited.norm() < free.norm()
    torch.testing.assert_close(limited / limited.norm(), free / free.norm())
    arrived = (value * _unit(state, logits)).norm()
    assert limited.norm() <= 0.5 * arrived * (1 + 1e-9)
    (_, wide), _ = gradients(exactly(0.05, clip=1e6), state, logits)
    torch.testing.assert_close(wide, free)


def test_the_limit_does_not_depend_on_the_scale_of_the_loss():
    state, log_weight = cloud(size=7)
    state[:3] += 4 * torch.tensor([0.1, 3.0, 40.0])
    grads = []
    for scale in (1.0, 1e3):
        leaf = log_weight.clone().requires_grad_()
        exactly(0.05, clip=0.1)(state, leaf, NONE)[0].square().sum().mul(scale).backward()
        grads.append(leaf.grad / scale)
    torch.testing.assert_close(grads[0], grads[1])


def test_weights_at_the_end_of_float32_have_finite_gradients():
    state, log_weight = cloud(4, size=30, dtype=torch.float32)
    state[:, :3] += 30 * torch.tensor([0.1, 3.0, 40.0])  # far from all others, with weights whose inverse overflows
    log_weight[:, :3] = -100.0
    state.requires_grad_()
    log_weight.requires_grad_()
    moved, _ = OptimalTransport(0.05)(state, log_weight, NONE)
    moved.square().sum().backward()
    assert moved.isfinite().all()
    assert state.grad.isfinite().all()
    assert log_weight.grad.isfinite().all()


def test_adaptive_transports_poor_clouds_only_and_passes_gradients_of_both():
    state, log_weight = cloud(3)
    log_weight[1] = -math.log(13)
    state.requires_grad_()
    log_weight.requires_grad_()
    moved, new = Adaptive(exactly(0.3), 0.9)(state, log_weight, torch.empty(3, 0))
    assert torch.equal(moved[1], state[1])
    assert torch.equal(new[1], log_weight[1])
    torch.testing.assert_close(moved[2], exactly(0.3)(state[2], log_weight[2], NONE)[0])
    (moved.sum() + new[1].sum()).backward()
    torch.testing.assert_close(state.grad[1], torch.ones(13, 3))
    torch.testing.assert_close(log_weight.grad[1], torch.ones(13))
    assert (log_weight.grad[0] != 0).any()


def test_cost_is_half_the_squared_distance():
    points, others = torch.randn(2, 9, 3), torch.randn(2, 5, 3)
    expected = 0.5 * (points[:, :, None] - others[:, None]).square().sum(-1)
    torch.testing.assert_close(half_squared_distances(points, others), expected)


@pytest.mark.parametrize("copies", [True, False])
def test_says_whether_it_copies(copies):
    scheme = systematic if copies else OptimalTransport()
    assert scheme.copies is copies
    assert Adaptive(scheme).copies is copies


@pytest.mark.parametrize(
    "bad", [{"epsilon": 0.0}, {"epsilon": math.nan}, {"tolerance": -1.0}, {"iterations": 0}, {"clip": 0.0}]
)
def test_rejects_settings_that_are_none(bad):
    with pytest.raises(InputError, match=f"{next(iter(bad))} must be"):
        OptimalTransport(**bad)
