"""PeaksAmongClutter: against enumerated hypotheses, and as the equations of S2 and S3 that it contains."""

import math

import pyro
import pytest
import torch
from pyro.distributions.torch_distribution import TorchDistributionMixin
from torch.distributions import Independent, Normal, Uniform

from probtrack.distributions import PeaksAmongClutter, TruncatedNormal, WrappedNormal, equal_priors
from probtrack.errors import InputError, ShapeError

PRIOR = [0.2, 0.5, 0.1, 0.2]


def law_of(prior, loc=0.3, present=None, **options):
    present = present if present is None else torch.tensor(present)
    return PeaksAmongClutter(Normal(loc, 0.2), Normal(-0.1, 0.9), torch.tensor(prior).log(), present, **options)


def enumerated(prior, value, loc=0.3):
    """Density of the peaks in `value`, one hypothesis after the other, in plain numbers."""

    def normal(x, mean, std):
        return math.exp(-((x - mean) ** 2) / (2 * std**2)) / (std * math.sqrt(2 * math.pi))

    total = 0.0
    for hypothesis, q in enumerate(prior):
        factors = [normal(x, loc, 0.2) if i + 1 == hypothesis else normal(x, -0.1, 0.9) for i, x in enumerate(value)]
        total += q * math.prod(factors)
    return torch.tensor(total)


def test_density_is_the_sum_over_hypotheses():
    value = [0.4, -0.7, 0.1]
    torch.testing.assert_close(law_of(PRIOR).log_prob(torch.tensor(value)).exp(), enumerated(PRIOR, value))


@pytest.mark.parametrize("filler", [0.3, 77.0, torch.nan, torch.inf])
def test_absent_peaks_play_no_part(filler):
    law = law_of(PRIOR, present=[True, False, True])
    expected = enumerated([0.2 / 0.9, 0.5 / 0.9, 0.2 / 0.9], [0.4, 0.1])
    torch.testing.assert_close(law.log_prob(torch.tensor([0.4, filler, 0.1])).exp(), expected)


@pytest.mark.parametrize("prior", [PRIOR, [0.0, 0.5, 0.2, 0.3]])
def test_a_frame_without_peaks_says_nothing(prior):
    loc, value = torch.tensor(0.3, requires_grad=True), torch.full((3,), torch.nan, requires_grad=True)
    log_prior = torch.tensor(prior).log().requires_grad_()
    law = PeaksAmongClutter(Normal(loc, 0.2), Uniform(-1.0, 1.0), log_prior, torch.zeros(3, dtype=torch.bool))
    log_prob = law.log_prob(value)
    assert log_prob == 0
    assert all((x == 0).all() for x in torch.autograd.grad(log_prob, [loc, value, log_prior]))


def test_gradients_with_absent_peaks():
    present = torch.tensor([[True, False, True], [False, False, False]])

    def log_prob(loc, scale, log_prior, value):
        return PeaksAmongClutter(Normal(loc, scale), Normal(-0.1, 0.9), log_prior, present).log_prob(value)

    leaves = [torch.tensor(x, requires_grad=True) for x in (0.3, 0.2, PRIOR, [[0.4, -0.7, 0.1], [0.2, 0.1, 0.5]])]
    assert torch.autograd.gradcheck(log_prob, leaves)
    assert torch.autograd.functional.jacobian(log_prob, tuple(leaves))[3][0, 0, 1] == 0


def test_impossible_hypotheses_leave_no_nan():
    """One peak is outside the clutter's reach, one prior is zero, and every term of some values is."""
    leaves = [torch.tensor(x, requires_grad=True) for x in (0.3, 0.2, [-math.inf, 0.0, -1.0], [[1.5, 0.1], [1.5, 1.6]])]
    law = PeaksAmongClutter(Normal(*leaves[:2]), Uniform(-1.0, 1.0), leaves[2], validate_args=False)
    log_prob = law.log_prob(leaves[3])
    expected = Normal(0.3, 0.2).log_prob(torch.tensor(1.5)) - math.log(2) - math.log1p(math.exp(-1))
    torch.testing.assert_close(log_prob, torch.stack([expected, torch.tensor(-math.inf)]))
    assert all(x.isfinite().all() for x in torch.autograd.grad(log_prob.sum(), leaves))


def test_permuted_peaks_have_permuted_priors():
    value, order = torch.tensor([0.4, -0.7, 0.1]), [2, 0, 1]
    permuted = law_of([PRIOR[0], *(PRIOR[1 + i] for i in order)]).log_prob(value[order])
    torch.testing.assert_close(permuted, law_of(PRIOR).log_prob(value))


def test_priors_need_not_sum_to_one():
    value = torch.tensor([0.4, -0.7, 0.1])
    torch.testing.assert_close(law_of([x * 7 for x in PRIOR]).log_prob(value), law_of(PRIOR).log_prob(value))


def test_without_a_talker_all_is_clutter():
    expected = Independent(Normal(torch.full((3,), -0.1), 0.9), 1)
    value = torch.tensor([0.4, -0.7, 0.1])
    torch.testing.assert_close(law_of([1.0, 0.0, 0.0, 0.0]).log_prob(value), expected.log_prob(value))


def ratio(law_at, value):
    """Density at one state over that at another, in which constants cancel."""
    return (law_at(0.31).log_prob(value) - law_at(-0.2).log_prob(value)).exp()


def test_it_is_klaassen_b5_as_a_function_of_the_state():
    """F = q_0 + sum_p q_p N(theta_p; theta, sigma^2), clutter being uniform over a width of 2.5 rad."""
    value, q, width = torch.tensor([0.25, -0.4, 0.1]), torch.tensor(PRIOR), 2.5

    def printed(theta):
        return q[0] + (q[1:] * torch.exp(-((value - theta) ** 2) / 0.02) / math.sqrt(2 * math.pi * 0.01)).sum()

    prior = torch.cat([q[:1], q[1:] / width]).log()
    found = ratio(lambda loc: PeaksAmongClutter(Normal(loc, 0.1), Uniform(-1.25, 1.25), prior), value)
    torch.testing.assert_close(found, printed(0.31) / printed(-0.2))


def test_it_is_klaassen_4_20_as_a_function_of_the_state():
    """Mean over K peaks of a Gaussian of tan(theta_k) - x / y, with the minus and 2 sigma^2 of the errata."""
    tangents = torch.tensor([0.25, -0.4, 0.1]).tan()

    def printed(x_over_y):
        return torch.exp(-((tangents - x_over_y) ** 2) / 0.02).mean()

    found = ratio(lambda loc: PeaksAmongClutter(Normal(loc, 0.1), Uniform(-9.0, 9.0), equal_priors(0.0, 3)), tangents)
    torch.testing.assert_close(found, printed(0.31) / printed(-0.2))


def test_it_is_fallon_14_to_16_for_one_peak():
    """q_0 U + q_1 c N over |tau| <= tau_max, c by the error function."""
    law = PeaksAmongClutter(TruncatedNormal(0.3, 0.2, -0.5, 0.5), Uniform(-0.5, 0.5), torch.tensor([0.4, 0.6]).log())
    inside = 0.5 * (math.erf(0.2 / 0.2 / math.sqrt(2)) + math.erf(0.8 / 0.2 / math.sqrt(2)))
    normal = math.exp(-0.5 * (0.15 / 0.2) ** 2) / (0.2 * math.sqrt(2 * math.pi))
    torch.testing.assert_close(law.log_prob(torch.tensor([0.45])).exp(), torch.tensor(0.4 + 0.6 * normal / inside))


def test_the_talker_has_its_share_of_the_samples():
    law, n = PeaksAmongClutter(Uniform(2.0, 3.0), Uniform(0.0, 1.0), torch.tensor(PRIOR).log()), 20_000
    is_target = law.sample(torch.Size([n])) > 1.5
    expected = torch.tensor(PRIOR[1:])
    assert (is_target.sum(-1) <= 1).all()
    assert ((is_target.double().mean(0) - expected).abs() < 5 * (expected * (1 - expected) / n).sqrt()).all()


def test_absent_slots_are_never_the_talker():
    present = torch.tensor([True, False, True])
    law = PeaksAmongClutter(Uniform(2.0, 3.0), Uniform(0.0, 1.0), torch.tensor(PRIOR).log(), present)
    draws = law.sample(torch.Size([200]))
    assert draws.shape == (200, 3)
    assert (draws[:, 1] < 1).all()
    assert (draws[:, [0, 2]] > 1.5).any(0).all()


def test_moments_are_those_of_each_slot():
    law = PeaksAmongClutter(Uniform(2.0, 3.0), Uniform(0.0, 1.0), torch.tensor(PRIOR).log())
    q = torch.tensor(PRIOR[1:])
    torch.testing.assert_close(law.mean, 0.5 + 2 * q)
    torch.testing.assert_close(law.variance, 1 / 12 + 4 * q * (1 - q))


def test_moments_do_not_exist_on_the_circle():
    law = PeaksAmongClutter(WrappedNormal(0.3, 0.1), Uniform(-math.pi, math.pi), torch.zeros(4))
    with pytest.raises(NotImplementedError, match="on the circle"):
        _ = law.mean


def test_particles_share_the_peaks_of_a_pair():
    target = Normal(torch.randn(7, 1, 1), torch.tensor([0.1, 0.2, 0.4]))  # particles, then peaks of their own spread
    present = torch.rand(5, 3) < 0.7
    law = PeaksAmongClutter(target, Uniform(-9.0, 9.0), torch.randn(5, 4), present)
    value = torch.randn(5, 3)
    assert law.batch_shape == (7, 5)
    one = PeaksAmongClutter(
        Normal(target.loc[4, 0], target.scale[0, 0]), Uniform(-9.0, 9.0), law.log_prior[4, 2], present[2]
    )
    torch.testing.assert_close(law.log_prob(value)[4, 2], one.log_prob(value[2]))
    torch.testing.assert_close(law.expand([2, 7, 5]).log_prob(value)[1], law.log_prob(value))


@pytest.mark.parametrize("q", [0.0, 0.3, 1.0])
def test_equal_priors_share_what_clutter_leaves(q):
    torch.testing.assert_close(equal_priors(q, 4).exp(), torch.tensor([q, *4 * [(1 - q) / 4]]))
    assert equal_priors(torch.full((2, 5), q), 4).shape == (2, 5, 5)


def test_works_in_a_pyro_model():
    class PyroLaw(PeaksAmongClutter, TorchDistributionMixin):
        """How a pyro user takes a torch law in."""

    def model():
        with pyro.plate("pairs", 6):
            return pyro.sample("x", PyroLaw(Normal(0.0, 1.0), Uniform(-9.0, 9.0), torch.zeros(4)))

    trace = pyro.poutine.trace(model).get_trace()
    assert trace.nodes["x"]["value"].shape == (6, 3)
    assert trace.log_prob_sum().isfinite()


@pytest.mark.parametrize(("target", "prior", "present", "match"), [
    ((), (), None, r"log_prior must have shape \(\.\.\., C \+ 1\) with C >= 1, got \(\)"),
    ((), (1,), None, r"log_prior must have shape \(\.\.\., C \+ 1\) with C >= 1, got \(1,\)"),
    ((5,), (4,), None, r"target must have batch \(\.\.\., 3\) or \(\.\.\., 1\), got \(5,\)"),
    ((), (4,), (7, 4), r"present must have batch \(\.\.\., 3\) or \(\.\.\., 1\), got \(7, 4\)"),
])  # fmt: skip
def test_rejects_wrong_shapes(target, prior, present, match):
    present = present if present is None else torch.ones(present, dtype=torch.bool)
    with pytest.raises(ShapeError, match=match):
        PeaksAmongClutter(Normal(torch.zeros(target), 1.0), Uniform(-1.0, 1.0), torch.zeros(prior), present)


def test_rejects_vectors_and_priors_that_leave_nothing():
    with pytest.raises(ShapeError, match=r"clutter must have a scalar event, got event shape \(2,\)"):
        PeaksAmongClutter(Normal(0.0, 1.0), Independent(Normal(torch.zeros(2), 1.0), 1), torch.zeros(3))
    with pytest.raises(InputError, match="log_prior must allow some hypothesis on the peaks present"):
        law_of([0.0, 1.0, 0.0, 0.0], present=[False, True, True])
    with pytest.raises(InputError, match=r"clutter_probability must be in \[0, 1\], got 1.2"):
        equal_priors(1.2, 3)


@pytest.mark.parametrize("peaks", [0, -1, 1.5])
def test_equal_priors_want_at_least_one_peak(peaks):
    with pytest.raises(InputError, match="peaks must be an integer of at least 1"):
        equal_priors(0.3, peaks)
