"""Kernel mixtures: the density that is drawn from, and the gradient that the weights carry."""

import math

import pytest
import torch
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal

from probtrack.dynamics import lehmann2007
from probtrack.errors import InputError
from probtrack.filters import Adaptive, ParticleFilter
from probtrack.filters.resampling import KernelMixture, multinomial, systematic
from probtrack.filters.resampling.spread import centre_and_spread
from probtrack.likelihoods import GaussianPosition


def cloud(*batch, size=7, dtype=torch.float64):
    scale = torch.tensor([0.1, 3.0, 40.0], dtype=dtype)
    state = scale * torch.randn(*batch, size, 3, dtype=dtype) + torch.tensor([5.0, -2.0, 100.0], dtype=dtype)
    return state, torch.log_softmax(1.5 * torch.randn(*batch, size, dtype=dtype), -1)


def mixture(state, log_weight, bandwidth):
    weight = log_weight.exp()
    spread = (weight @ (state - weight @ state).square()).sqrt()
    kernels = Independent(Normal(state, (bandwidth * spread).expand_as(state)), 1)
    return MixtureSameFamily(Categorical(logits=log_weight), kernels)


def uniforms_for(scheme, *batch, size=7):
    return torch.rand(*batch, scheme.num_uniforms(size, 3))


@pytest.mark.parametrize("resampler", [systematic, multinomial])
def test_new_particles_have_the_moments_of_the_mixture(resampler):
    (state, log_weight), runs, scheme = cloud(), 20_000, KernelMixture(0.4, resampler)
    drawn, weights = scheme(state.expand(runs, 7, 3), log_weight.expand(runs, 7), uniforms_for(scheme, runs))
    law = mixture(state, log_weight, 0.4)
    assert torch.equal(weights, torch.full((runs, 7), -math.log(7)))
    mean = drawn.mean(1)
    assert ((mean.mean(0) - law.mean).abs() < 5 * mean.std(0) / runs**0.5).all()
    second = (drawn - law.mean).square().mean(1)
    assert ((second.mean(0) - law.variance).abs() < 5 * second.std(0) / runs**0.5).all()


def test_variance_grows_by_the_square_of_the_bandwidth():
    state, log_weight = cloud()
    weight = log_weight.exp()
    variance = weight @ (state - weight @ state).square()
    torch.testing.assert_close(mixture(state, log_weight, 0.4).variance, (1 + 0.4**2) * variance)


@pytest.mark.parametrize("bandwidth", [0.1, 0.7])
def test_weights_carry_the_gradient_of_the_mixture_density(bandwidth):
    state, logits = cloud()
    state, logits = state.requires_grad_(), logits.requires_grad_()
    log_weight, value, scheme = torch.log_softmax(logits, -1), torch.randn(7), KernelMixture(bandwidth)
    drawn, weights = scheme(state, log_weight, uniforms_for(scheme))
    assert not drawn.requires_grad
    torch.testing.assert_close(weights, torch.full((7,), -math.log(7)))
    made = torch.autograd.grad((weights * value).sum(), [state, logits])
    expected = torch.autograd.grad(
        (mixture(state, torch.log_softmax(logits, -1), bandwidth).log_prob(drawn) * value).sum(), [state, logits]
    )
    torch.testing.assert_close(made, expected, rtol=1e-8, atol=1e-9)


def test_gradient_of_an_expectation_is_unbiased():
    (state, logits), runs, scheme = cloud(), 40_000, KernelMixture(0.5)
    states = state.expand(runs, 7, 3).clone().requires_grad_()
    many = logits.expand(runs, 7).clone().requires_grad_()
    drawn, weights = scheme(states, torch.log_softmax(many, -1), uniforms_for(scheme, runs))
    (weights.exp() * (drawn[..., 1] / 3).square()).sum().backward()
    state, logits = state.requires_grad_(), logits.requires_grad_()
    law = mixture(state, torch.log_softmax(logits, -1), 0.5)
    exact = torch.autograd.grad((law.variance[1] + law.mean[1].square()) / 9, [state, logits])
    for sample, wanted in zip((states.grad, many.grad), exact, strict=True):
        assert ((sample.mean(0) - wanted).abs() <= 5 * sample.std(0) / runs**0.5 + 1e-9).all()


def test_units_of_a_dimension_play_no_part():
    (state, log_weight), scheme, unit = cloud(), KernelMixture(), torch.tensor([1.0, 100.0, 1e-3])
    uniforms = uniforms_for(scheme)
    drawn, _ = scheme(state, log_weight, uniforms)
    torch.testing.assert_close(scheme(unit * state + 7, log_weight, uniforms)[0], unit * drawn + 7)


def test_batches_do_not_mix_and_keep_variables_first():
    (state, log_weight), scheme = cloud(2, 3), KernelMixture(0.3, multinomial)
    uniforms = uniforms_for(scheme, 2, 3)
    drawn, weights = scheme(state.movedim(-1, 0).contiguous().movedim(0, -1), log_weight, uniforms)
    assert weights.shape == (2, 3, 7)
    assert drawn.movedim(-1, 0).is_contiguous()
    torch.testing.assert_close(drawn[1, 2], scheme(state[1, 2], log_weight[1, 2], uniforms[1, 2])[0])


def test_float32_survives_one_heavy_particle_a_flat_dimension_and_a_uniform_of_zero():
    state, _ = cloud(3, dtype=torch.float32)
    state[..., 1] = 0.7
    log_weight = torch.full((3, 7), -math.inf, dtype=torch.float32)
    log_weight[:, 4] = 0
    state.requires_grad_()
    log_weight.requires_grad_()
    drawn, weights = KernelMixture()(state, log_weight, torch.zeros(3, 1 + 21, dtype=torch.float32))
    assert drawn.isfinite().all()
    assert (drawn[..., 1] == state[..., 1]).all()
    (weights * torch.randn(3, 7)).sum().backward()
    assert state.grad.isfinite().all()
    assert log_weight.grad.isfinite().all()


def test_spread_is_never_below_a_hundredth_of_that_of_the_particles():
    state, _ = cloud(1)
    weight = torch.zeros(1, 7)
    weight[0, 2] = 1
    centre, spread = centre_and_spread(state, weight)
    torch.testing.assert_close(centre[0, 0], state[0, 2])
    expected = 0.01 * (state[0] - state[0, 2]).square().mean(0).sqrt()
    torch.testing.assert_close(spread[0, 0], expected)


@pytest.mark.parametrize("resample", [KernelMixture(), Adaptive(KernelMixture(0.3, multinomial), 0.6)])
def test_a_filter_learns_through_it(resample):
    particle_filter = ParticleFilter(lehmann2007("CU-LAN"), GaussianPosition(0.3), num_particles=40, resample=resample)
    noise = particle_filter.noise(torch.arange(3))
    belief = particle_filter.spread_around(torch.zeros(3, 2), noise)
    particle_filter.advance(belief, 0.3 * torch.randn(12, 3, 2), 0.1, noise)[0].log_evidence.sum().backward()
    assert all(p.grad.isfinite().all() and (p.grad != 0).all() for p in particle_filter.parameters())
    assert not resample.copies


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_rejects_a_bandwidth_that_is_none(bad):
    with pytest.raises(InputError, match="bandwidth must be finite and positive"):
        KernelMixture(bad)
