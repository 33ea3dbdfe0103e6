"""Independent vectors side by side: against their parts."""

import properties
import pytest
import torch
from torch.distributions import Independent, Normal, Poisson

from probtrack.distributions import Concatenated, LinearGaussian, Pushforward, WrappedGaussian
from probtrack.errors import ShapeError, SingularLawError

GAIN = [[0.5, 0.1, 0.2], [-0.3, 0.4, 0.0]]


def law(loc, gain, mean):
    """A vector of two with correlation, then three independent numbers."""
    return Concatenated([LinearGaussian(loc, gain), Independent(Normal(mean, 0.7), 1)])


def parameters():
    return [torch.tensor([0.4, -0.2]), torch.tensor(GAIN), torch.tensor([1.1, -0.3, 2.0])]


def singular():
    return LinearGaussian(torch.tensor([0.4, -0.2]), torch.tensor([[0.5], [1.0]]))


def test_density_is_the_product_of_its_parts():
    loc, gain, mean = parameters()
    x = torch.randn(7, 5)
    parts = LinearGaussian(loc, gain).log_prob(x[:, :2]) + Normal(mean, 0.7).log_prob(x[:, 2:]).sum(-1)
    torch.testing.assert_close(law(loc, gain, mean).log_prob(x), parts)


def test_shapes():
    loc, gain, mean = parameters()
    properties.assert_shapes(law(loc, gain, mean), (), (5,))
    wide = law(loc.expand(4, 1, 2), gain, mean.expand(3, 3))
    properties.assert_shapes(wide, (4, 3), (5,))
    properties.assert_log_prob_shape(wide)


def test_moments_are_those_of_the_parts():
    made = law(*parameters())
    gain = torch.tensor(GAIN)
    covariance = torch.block_diag(gain @ gain.mT, 0.49 * torch.eye(3))
    torch.testing.assert_close(made.mean, torch.tensor([0.4, -0.2, 1.1, -0.3, 2.0]))
    torch.testing.assert_close(made.variance, covariance.diagonal())
    properties.assert_moments(made, made.mean, covariance)


def test_expands():
    loc, gain, mean = parameters()
    properties.assert_expands(law(loc, gain, mean))
    properties.assert_expands(law(loc.expand(2, 2), gain, mean))


def test_gradients():
    properties.assert_density_gradients(law, parameters(), torch.randn(4, 5))
    properties.assert_sample_gradients(law, parameters())


def test_single_precision():
    properties.assert_single_precision(law, parameters(), torch.tensor([[0.1, 0.3, 1.0, -2.0, 1.5]]))


def test_one_part_is_that_part():
    loc, gain, _ = parameters()
    x = torch.randn(7, 2)
    alone = LinearGaussian(loc, gain)
    torch.testing.assert_close(Concatenated([alone]).log_prob(x), alone.log_prob(x))


def test_an_angle_among_the_parts_is_wrapped():
    turned = WrappedGaussian(LinearGaussian(torch.tensor([3.1, 0.5]), torch.tensor(GAIN)), angle=0)
    made = Concatenated([Independent(Normal(torch.tensor([9.0]), 0.1), 1), turned])
    draws = made.sample(torch.Size([500]))
    assert (draws[:, 1].abs() <= torch.pi).all()
    assert (draws[:, 0] > 7).all()
    torch.testing.assert_close(made.log_prob(draws + torch.tensor([0, 2 * torch.pi, 0])), made.log_prob(draws))


def test_a_part_without_density_can_be_drawn_but_not_asked():
    made = Concatenated([Independent(Normal(torch.zeros(1), 0.1), 1), singular()])
    assert made.rsample().shape == (3,)
    with pytest.raises(SingularLawError, match="1 noise numbers drive 2 variables"):
        made.log_prob(torch.zeros(3))


def test_samples_carry_gradients_only_where_all_parts_do():
    counted = Concatenated([singular(), Independent(Poisson(torch.tensor([3.0])), 1)])
    assert not counted.has_rsample
    assert counted.sample(torch.Size([4])).shape == (4, 3)
    with pytest.raises(NotImplementedError):
        counted.rsample()
    assert Concatenated([singular(), Pushforward(torch.exp, 2, torch.Size(), 2)]).has_rsample


def test_rejects_values_of_another_size():
    with pytest.raises(ShapeError, match=r"value must have shape \(\.\.\., 5\), got \(3, 4\)"):
        law(*parameters()).log_prob(torch.zeros(3, 4))


@pytest.mark.parametrize("laws", [[], [Normal(0.0, 1.0)], [Normal(0.0, 1.0).expand([2])]])
def test_rejects_laws_that_are_not_of_vectors(laws):
    with pytest.raises(ShapeError, match=r"parts must be laws of vectors with events \(D,\), got"):
        Concatenated(laws)
