"""Law of a map of standard normal noise."""

import pytest
import torch
from properties import assert_sample_gradients

from probtrack.distributions import Pushforward
from probtrack.errors import SingularLawError


def polar(radius, angle, **kwargs):
    """Law of a point at a noisy radius (...), and of its doubled height."""

    def transport(noise):
        far = radius + 0.3 * noise[..., 0]
        x, y = far * angle.cos(), far * angle.sin() + 0.1 * noise[..., 1]
        return torch.stack([x, y, 2 * y], -1)

    return Pushforward(transport, 2, radius.shape, 3, like=radius, **kwargs)


def one():
    return polar(torch.tensor(1.3), torch.tensor(0.4))


def batch():
    return polar(torch.tensor([[1.3], [2.0]]).expand(2, 5), torch.linspace(0.1, 0.9, 5))


def test_value_is_the_map_of_the_noise():
    value = one().at_noise(torch.tensor([2.0, -1.0]))
    x, y = 1.9 * torch.tensor(0.4).cos(), 1.9 * torch.tensor(0.4).sin() - 0.1
    torch.testing.assert_close(value, torch.stack([x, y, 2 * y]))


def test_shapes():
    law = batch()
    assert (law.batch_shape, law.event_shape) == ((2, 5), (3,))
    assert law.sample().shape == (2, 5, 3)
    assert law.rsample(torch.Size([3, 7])).shape == (3, 7, 2, 5, 3)


def test_samples_are_maps_of_standard_normal_noise():
    draws = one().sample(torch.Size([20_000]))
    along = draws[:, 0] / torch.tensor(0.4).cos()
    across = draws[:, 1] - along * torch.tensor(0.4).sin()
    for values, mean, std in [(along, 1.3, 0.3), (across, 0.0, 0.1)]:
        assert abs(values.mean() - mean) < 5 * std / 20_000**0.5
        assert abs(values.std() - std) < 5 * std / 40_000**0.5
    assert torch.equal(draws[:, 2], 2 * draws[:, 1])


def test_every_member_of_the_batch_has_noise_of_its_own():
    draws = polar(torch.ones(4), torch.zeros(4)).sample()
    assert len(draws[:, 0].unique()) == 4


def test_expands():
    law = polar(torch.tensor([1.3, 2.0]), torch.tensor([0.4, 0.1]), validate_args=True)
    wide = law.expand(torch.Size([5, 2]))
    noise = torch.randn(5, 2, 2)
    assert type(wide) is Pushforward
    assert wide._validate_args
    assert (wide.batch_shape, wide.event_shape, wide.noise_dim) == ((5, 2), (3,), 2)
    assert wide.sample(torch.Size([3])).shape == (3, 5, 2, 3)
    torch.testing.assert_close(wide.at_noise(noise), law.at_noise(noise))


def test_an_expanded_law_draws_anew_for_each_member():
    assert len(one().expand(torch.Size([6])).sample()[:, 0].unique()) == 6


def test_samples_carry_gradients():
    assert Pushforward.has_rsample
    assert_sample_gradients(polar, [torch.tensor([1.3, 2.0]), torch.tensor([0.4, 0.1])])


def test_plain_samples_carry_none():
    assert not polar(torch.tensor(1.3, requires_grad=True), torch.tensor(0.4)).sample().requires_grad


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_samples_have_the_type_of_the_state(dtype):
    law = polar(torch.tensor([1.3, 2.0], dtype=dtype), torch.tensor(0.4, dtype=dtype))
    assert law.sample().dtype == law.expand(torch.Size([3, 2])).sample().dtype == dtype


def test_without_a_state_samples_have_the_default_type():
    assert Pushforward(torch.exp, 2, torch.Size(), 2).sample().dtype == torch.float64


def test_has_no_density():
    with pytest.raises(SingularLawError, match="no density: 2 noise numbers drive 3 variables"):
        one().log_prob(torch.zeros(3))
