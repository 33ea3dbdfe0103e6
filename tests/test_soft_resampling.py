"""Soft resampling: draws by blended weights, importance weights, and what their gradients are."""

import math

import pytest
import torch
from torch import nn
from torch.distributions import Independent, Normal

from probtrack.dynamics import Dynamics, Kinematics
from probtrack.errors import InputError
from probtrack.filters import (
    Adaptive,
    Gaussian,
    ParticleFilter,
    StopGradient,
    kalman_filter,
    position_system,
    resampling,
)
from probtrack.filters.resampling import MarginalStopGradient, Soft, multinomial, systematic
from probtrack.likelihoods import GaussianPosition

SCHEMES = [systematic, resampling.stratified, multinomial, resampling.residual]


def cloud(*batch, size=9):
    log_weight = torch.log_softmax(1.5 * torch.randn(*batch, size), -1)
    return torch.randn(*batch, size, 4), log_weight


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_clouds_are_those_of_the_scheme_under_the_blended_weights(scheme, batch):
    state, log_weight = cloud(*batch)
    uniforms = torch.rand(*batch, scheme.num_uniforms(9, 4))
    blended = 0.3 * log_weight.exp() + 0.7 / 9
    drawn, _ = Soft(scheme, 0.3)(state, log_weight, uniforms)
    assert torch.equal(drawn, scheme(state, blended.log(), uniforms)[0])
    assert Soft(scheme).num_uniforms(9, 4) == scheme.num_uniforms(9, 4)


def test_each_copy_weighs_its_weight_over_how_likely_it_was_drawn():
    state, log_weight = cloud(3)
    state[..., 0] = torch.arange(9.0)  # tells who was drawn
    drawn, new = Soft(multinomial, 0.3)(state, log_weight, torch.rand(3, 9))
    weight = log_weight.exp().gather(-1, drawn[..., 0].long())
    torch.testing.assert_close(new.exp(), weight / (0.3 * weight + 0.7 / 9) / 9)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_weighted_means_are_unbiased(scheme):
    (state, log_weight), runs = cloud(), 20_000
    drawn, new = Soft(scheme, 0.4)(
        state.expand(runs, 9, 4), log_weight.expand(runs, 9), torch.rand(runs, scheme.num_uniforms(9, 4))
    )
    for value, exact in ((torch.ones(runs, 9), torch.tensor(1.0)), (drawn[..., 0], log_weight.exp() @ state[:, 0])):
        sums = (new.exp() * value).sum(-1)
        assert (sums.mean() - exact).abs() < 5 * sums.std() / runs**0.5


def test_particles_of_weight_zero_stay_so_and_hurt_no_gradient():
    leaf = torch.randn(7, requires_grad=True)
    gone = torch.tensor([False, True, False, False, True, False, False])
    state, log_weight = torch.arange(7.0)[:, None], torch.log_softmax(leaf.masked_fill(gone, -math.inf), -1)
    drawn, new = Soft(systematic, 0.2)(state, log_weight, torch.tensor([0.3]))
    assert (gone[drawn[:, 0].long()] == new.isneginf()).all()
    assert new.isneginf().any()
    torch.logsumexp(new + torch.randn(7), -1).backward()
    assert leaf.grad.isfinite().all()


def test_share_of_one_is_the_scheme():
    (state, log_weight), uniforms = cloud(3), torch.rand(3, 1)
    drawn, new = Soft(systematic, 1.0)(state, log_weight, uniforms)
    plain, equal = systematic(state, log_weight, uniforms)
    assert torch.equal(drawn, plain)
    torch.testing.assert_close(new, equal)


def test_gradient_is_that_of_the_ratio():
    leaf, uniforms, value = torch.randn(9, requires_grad=True), torch.rand(9), torch.randn(9)
    state, log_weight = torch.arange(9.0)[:, None], torch.log_softmax(leaf, -1)
    drawn, new = Soft(multinomial, 0.3)(state, log_weight, uniforms)
    (made,) = torch.autograd.grad((new * value).sum(), leaf, retain_graph=True)
    weight = log_weight.exp()[drawn[:, 0].long()]
    (expected,) = torch.autograd.grad(((weight / (0.3 * weight + 0.7 / 9)).log() * value).sum(), leaf)
    torch.testing.assert_close(made, expected)


def gradients_of_the_mean(resample, size=6, runs=40_000):
    """Gradients (runs, size) of the weighted mean of new clouds in the logits of the weights, and the exact one."""
    logits, state = torch.randn(size), torch.randn(size, 1)
    leaf = logits.expand(runs, size).clone().requires_grad_()
    drawn, new = resample(state.expand(runs, size, 1), torch.log_softmax(leaf, -1), torch.rand(runs, size))
    (new.exp() * drawn[..., 0]).sum().backward()
    weight = logits.softmax(-1)
    return leaf.grad, weight * (state[:, 0] - weight @ state[:, 0])


def test_with_stop_gradient_inside_the_gradient_is_unbiased_and_alone_it_is_not():
    both, exact = gradients_of_the_mean(Soft(StopGradient(multinomial), 0.5))
    assert ((both.mean(0) - exact).abs() < 5 * both.std(0) / len(both) ** 0.5).all()
    alone, exact = gradients_of_the_mean(Soft(multinomial, 0.5))
    assert ((alone.mean(0) - exact).abs() > 5 * alone.std(0) / len(alone) ** 0.5).any()


def test_clouds_that_are_not_resampled_keep_weights_and_gradients():
    state, leaf = torch.randn(3, 9, 4), torch.randn(3, 9)
    leaf[1] = 0
    leaf.requires_grad_()
    log_weight = torch.log_softmax(leaf, -1)
    drawn, new = Adaptive(Soft(systematic), 0.9)(state, log_weight, torch.rand(3, 1))
    alone = Soft(systematic)(state, log_weight, torch.full((3, 1), 0.5))[1]
    assert torch.equal(drawn[1], state[1])
    assert torch.equal(new[1], log_weight[1])
    assert alone.shape == new.shape
    value = torch.randn(3, 9)
    (made,) = torch.autograd.grad((new[1] * value[1]).sum(), leaf, retain_graph=True)
    (expected,) = torch.autograd.grad((log_weight[1] * value[1]).sum(), leaf, retain_graph=True)
    torch.testing.assert_close(made, expected)
    (made,) = torch.autograd.grad((new[0] * value[0]).sum(), leaf)
    assert (made[0] != 0).any()


class Walk(Dynamics):
    """The position alone, with a learnable step."""

    state_dim = noise_dim = axes = 2

    def __init__(self):
        super().__init__()
        self.log_scale = nn.Parameter(torch.tensor(0.7).log())

    def forward(self, state, dt):
        return Independent(Normal(state, self.log_scale.exp() * dt**0.5), 1)

    def matrices(self, dt):
        return torch.eye(2), self.log_scale.exp() * dt**0.5 * torch.eye(2)

    def kinematics(self, state):
        return Kinematics(state, torch.zeros_like(state))

    def from_kinematics(self, kinematics):
        return kinematics.position


@pytest.mark.parametrize("resample", [Soft(systematic, 0.4), Adaptive(Soft(StopGradient(systematic)), 0.6)])
@torch.no_grad()
def test_evidence_of_the_filter_is_unbiased(resample):
    y, model, runs = 0.4 * torch.randn(6, 2).cumsum(0), Walk(), 800
    exact = kalman_filter(y, position_system(model, 0.5, 0.4), Gaussian(torch.zeros(2), 0.3**2 * torch.eye(2)))
    bootstrap = ParticleFilter(model, GaussianPosition(0.4), num_particles=150, resample=resample)
    noise = bootstrap.noise(torch.arange(runs))
    belief = bootstrap.spread_around(torch.zeros(runs, 2), noise, std=0.3)
    ratio = (bootstrap.advance(belief, y[:, None], 0.5, noise)[0].log_evidence - exact.log_evidence).exp()
    assert ratio.std() < 1
    assert (ratio.mean() - 1).abs() < 5 * ratio.std() / runs**0.5


@pytest.mark.parametrize("bad", [0, -0.1, 1.1, float("nan")])
def test_rejects_a_share_that_is_none(bad):
    with pytest.raises(InputError, match=r"share must be in \(0, 1\], got"):
        Soft(systematic, bad)


@torch.no_grad()
def test_weights_sum_to_one_where_no_particle_was_possible():
    class Near(GaussianPosition):
        def forward(self, observation, kinematics):
            away = observation.position.abs().amax(-1) > 50
            return super().forward(observation, kinematics).masked_fill(away, -math.inf)

    bootstrap = ParticleFilter(Walk(), Near(0.4), num_particles=12, resample=Soft(systematic, 0.3))
    noise = bootstrap.noise(torch.arange(3))
    y = torch.zeros(4, 3, 2)
    y[2] = 1e3
    _, cloud = bootstrap.run(bootstrap.spread_around(torch.zeros(3, 2), noise), y, 0.5, noise)
    assert cloud.lost.sum() == 3
    torch.testing.assert_close(cloud.log_weight.exp().sum(-1), torch.ones(4, 3))


def test_a_scheme_that_follows_moves_is_refused():
    with pytest.raises(InputError, match="would leave out what it does after them"):
        Soft(MarginalStopGradient(systematic))
