"""Stop-gradient resampling: the plain scheme in value, the gradient of the weights beside it."""

import pytest
import torch

from probtrack.errors import InputError
from probtrack.filters import Adaptive, StopGradient, resampling
from probtrack.filters.resampling import Soft, systematic

SCHEMES = [resampling.systematic, resampling.stratified, resampling.multinomial, resampling.residual]


def cloud(*batch, size=9):
    log_weight = torch.randn(*batch, size, requires_grad=True)
    return torch.randn(*batch, size, 4), log_weight, torch.log_softmax(log_weight, -1)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_values_are_those_of_the_scheme(scheme, batch):
    state, _, log_weight = cloud(*batch)
    uniforms = torch.rand(*batch, scheme.num_uniforms(9, 4))
    drawn, weights = StopGradient(scheme)(state, log_weight, uniforms)
    plain, equal = scheme(state, log_weight, uniforms)
    assert torch.equal(drawn, plain)
    assert torch.equal(weights, equal)
    assert StopGradient(scheme).num_uniforms(9, 4) == scheme.num_uniforms(9, 4)


def test_every_copy_keeps_the_gradient_of_the_weight_it_was_drawn_by():
    state, leaf, log_weight = cloud()
    state[:, 0] = torch.arange(9.0)  # tells who was drawn
    drawn, weights = StopGradient(resampling.systematic)(state, log_weight, torch.rand(1))
    value = torch.randn(9)
    (gradient,) = torch.autograd.grad((weights * value).sum(), leaf, retain_graph=True)
    (expected,) = torch.autograd.grad((log_weight[drawn[:, 0].long()] * value).sum(), leaf)
    torch.testing.assert_close(gradient, expected)


def test_clouds_that_are_not_resampled_keep_their_weights_and_gradients():
    state, leaf, log_weight = cloud(3)
    even = torch.log_softmax(0 * leaf[1], -1)
    mixed = torch.stack([log_weight[0], even, log_weight[2]])
    resample = Adaptive(StopGradient(resampling.systematic), 0.9)
    drawn, weights = resample(state, mixed, torch.rand(3, 1))
    assert torch.equal(drawn[1], state[1])
    assert torch.equal(weights[1], even)
    weights[0, 0].backward()
    assert (leaf.grad[0] != 0).any()


def test_variables_come_first_in_memory():
    state, _, log_weight = cloud(3)
    drawn, _ = StopGradient(resampling.systematic)(
        state.movedim(-1, 0).contiguous().movedim(0, -1), log_weight, torch.rand(3, 1)
    )
    assert drawn.movedim(-1, 0)[0].is_contiguous()


def test_without_gradients_nothing_is_added():
    state, _, log_weight = cloud()
    drawn, weights = StopGradient(resampling.systematic)(state, log_weight.detach(), torch.rand(1))
    assert not weights.requires_grad
    assert drawn.shape == state.shape


def test_weights_that_a_scheme_has_drawn_by_cannot_count_twice():
    with pytest.raises(InputError, match=r"write Soft\(StopGradient\(scheme\)\)"):
        StopGradient(Soft(systematic))
