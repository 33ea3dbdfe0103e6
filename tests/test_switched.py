"""A mode and a vector of its own law: against sums made by hand."""

import math

import properties
import pytest
import torch
from torch.distributions import Exponential, Independent, Normal

from probtrack.distributions import LinearGaussian, Switched
from probtrack.errors import ShapeError, SingularLawError

GAIN = [[0.5, 0.1, 0.2], [-0.3, 0.4, 0.0]]
SHARES = [0.5, 0.2, 0.3]


def law(logit, loc, mean):
    """Mode 0 has one number, mode 1 three, mode 2 two with correlation."""
    laws = [
        Independent(Normal(mean[..., :1], 0.9), 1),
        Independent(Normal(mean, 0.4), 1),
        LinearGaussian(loc, torch.tensor(GAIN).to(loc)),
    ]
    return Switched(logit.log_softmax(-1), laws)


def parameters():
    return [torch.tensor(SHARES).log(), torch.tensor([0.4, -0.2]), torch.tensor([1.1, -0.3, 2.0])]


def values():
    return torch.tensor([[0.7, 0.0, 0.0, 0.0], [0.9, -0.1, 2.2, 1.0], [0.3, -0.6, 0.0, 2.0], [1.5, 0.0, 0.0, 0.0]])


def test_density_is_that_of_the_mode_and_of_its_own_law():
    x = values()
    _, loc, mean = parameters()
    expected = [
        math.log(0.5) + Normal(mean[0], 0.9).log_prob(x[0, 0]),
        math.log(0.2) + Normal(mean, 0.4).log_prob(x[1, :3]).sum(),
        math.log(0.3) + LinearGaussian(loc, torch.tensor(GAIN)).log_prob(x[2, :2]),
        math.log(0.5) + Normal(mean[0], 0.9).log_prob(x[3, 0]),
    ]
    torch.testing.assert_close(law(*parameters()).log_prob(x), torch.stack(expected))


def test_probabilities_of_the_modes_and_their_densities_make_one():
    shares = []
    for mode, sides in enumerate([[(-5, 7, 400)], [(-1, 3, 50), (-3, 2, 50), (0, 4, 50)], [(-4, 5, 200)] * 2]):
        grid, cell = properties.box(*sides)
        grid = grid.reshape(len(grid), -1)
        value = torch.cat([grid, torch.zeros(len(grid), 3 - len(sides)), torch.full((len(grid), 1), mode)], -1)
        shares.append(law(*parameters()).log_prob(value).exp().sum() * cell)
    torch.testing.assert_close(torch.stack(shares), torch.tensor(SHARES), rtol=0, atol=1e-3)


def test_shapes():
    logit, loc, mean = parameters()
    made = law(logit.expand(4, 1, 3), loc, mean.expand(5, 3))
    draws = made.sample(torch.Size([3, 7]))
    assert (made.batch_shape, made.event_shape) == ((4, 5), (4,))
    assert draws.shape == (3, 7, 4, 5, 4)
    assert made.sample().shape == (4, 5, 4)
    assert made.log_prob(draws).shape == (3, 7, 4, 5)


def test_samples_have_the_modes_shares_and_the_moments_of_its_law():
    draws = law(*parameters()).sample(torch.Size([30_000]))
    for mode, (share, mean, std, size) in enumerate([(0.5, 1.1, 0.9, 1), (0.2, 1.1, 0.4, 3), (0.3, 0.4, 0.3**0.5, 2)]):
        drawn = draws[draws[:, -1] == mode]
        assert abs(len(drawn) / 30_000 - share) < 5 * (share * (1 - share) / 30_000) ** 0.5
        assert abs(drawn[:, 0].mean() - mean) < 5 * std / len(drawn) ** 0.5
        assert abs(drawn[:, 0].std() - std) < 5 * std / (2 * len(drawn)) ** 0.5
        assert (drawn[:, :size] != 0).all()
        assert (drawn[:, size:3] == 0).all()


def test_modes_of_a_batch_have_their_own_shares():
    logit = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]).log()
    assert (law(logit, *parameters()[1:]).sample(torch.Size([50]))[..., -1] == torch.tensor([1.0, 0.0])).all()


def test_expands():
    made = law(*parameters())
    wide = made.expand(torch.Size([5, 4]))
    assert type(wide) is Switched
    assert wide.sample(torch.Size([3])).shape == (3, 5, 4, 4)
    torch.testing.assert_close(wide.log_prob(values()), made.log_prob(values()).expand(5, 4))
    again = law(torch.randn(2, 3), *parameters()[1:]).expand(torch.Size([3, 2]))
    assert again.log_prob(values()[:2]).shape == (3, 2)


def test_gradients():
    x = values()

    def log_prob(logit, loc, mean, vector):
        return law(logit, loc, mean).log_prob(torch.cat([vector, x[:, 3:]], -1))

    leaves = [leaf.requires_grad_() for leaf in (*parameters(), x[:, :3].clone())]
    assert torch.autograd.gradcheck(log_prob, leaves)


def test_samples_carry_no_gradient():
    logit, loc, mean = (x.requires_grad_() for x in parameters())
    made = law(logit, loc, mean)
    assert not made.has_rsample
    assert not made.sample().requires_grad
    with pytest.raises(NotImplementedError):
        made.rsample()


def test_what_is_no_mode_is_impossible():
    x = torch.tensor([[0.7, 0.0, 0.0, 3.0], [0.7, 0.0, 0.0, -1.0], [0.7, 0.0, 0.0, 0.5]])
    assert (law(*parameters()).log_prob(x) == -math.inf).all()


def test_an_impossible_mode_is_never_drawn_and_leaves_gradients_finite():
    logit, loc, mean = parameters()
    logit = torch.tensor([0.7, 0.3, 0.0]).log().requires_grad_()
    made = law(logit, loc, mean)
    assert (made.sample(torch.Size([2000]))[:, -1] < 2).all()
    total = made.log_prob(values())
    assert total.isneginf().tolist() == [False, False, True, False]
    total[[0, 1, 3]].sum().backward()
    assert logit.grad[:2].isfinite().all()


def test_only_a_singular_law_that_is_asked_is_an_error():
    singular = LinearGaussian(torch.zeros(2), torch.tensor([[0.5], [1.0]]))
    made = Switched(torch.tensor([0.6, 0.4]).log(), [singular, Independent(Normal(torch.zeros(2), 0.3), 1)])
    assert made.sample(torch.Size([9])).shape == (9, 3)
    assert made.log_prob(torch.tensor([0.1, 0.2, 1.0])).isfinite()
    with pytest.raises(SingularLawError, match="1 noise numbers drive 2 variables"):
        made.log_prob(torch.tensor([[0.1, 0.2, 1.0], [0.1, 0.2, 0.0]]))


def test_a_law_is_not_asked_of_values_of_other_modes():
    positive = Independent(Exponential(torch.tensor([2.0]), validate_args=True), 1)
    made = Switched(torch.tensor([0.6, 0.4]).log(), [positive, Independent(Normal(torch.zeros(1), 0.3), 1)])
    value = torch.tensor([[0.5, 0.0], [-0.5, 1.0], [math.inf, 2.0]], requires_grad=True)
    total = made.log_prob(value)
    total[:2].sum().backward()
    normal = Normal(0.0, 0.3).log_prob(torch.tensor(-0.5)).item()
    expected = torch.tensor([math.log(0.6) + math.log(2) - 1, math.log(0.4) + normal])
    torch.testing.assert_close(total[:2], expected)
    assert value.grad.isfinite().all()


def test_single_precision():
    made = law(*(x.float() for x in parameters()))
    total = made.log_prob(values().float())
    assert total.dtype == made.sample().dtype == torch.float32
    torch.testing.assert_close(total.double(), law(*parameters()).log_prob(values()), rtol=2e-5, atol=2e-5)


def test_rejects_values_of_another_size():
    with pytest.raises(ShapeError, match=r"value must have shape \(\.\.\., 4\), got \(2, 3\)"):
        law(*parameters()).log_prob(torch.zeros(2, 3))


def test_rejects_as_many_probabilities_as_there_are_no_laws():
    with pytest.raises(ShapeError, match=r"log_prob_of_mode must have shape \(\.\.\., 1\), got \(2,\)"):
        Switched(torch.zeros(2), [Independent(Normal(torch.zeros(1), 0.3), 1)])


def test_rejects_laws_that_are_not_of_vectors():
    with pytest.raises(ShapeError, match=r"laws must be of vectors with events \(D,\), got \(\)"):
        Switched(torch.zeros(1), [Normal(0.0, 1.0)])
    with pytest.raises(ShapeError, match=r"laws must be of vectors with events \(D,\), got none"):
        Switched(torch.zeros(0), [])
