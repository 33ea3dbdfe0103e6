"""Integrals of decaying motion: against quadrature, their limits, and across the change of method."""

import numpy as np
import pytest
import torch
from scipy.integrate import fixed_quad

from probtrack.dynamics.integrals import covariances, means
from probtrack.errors import InputError

MODERATE = [0.0, 1e-300, 1e-12, 1e-4, 0.03, 0.5, 0.999999, 1.0, 1.000001, 1.7, 6.0, 25.0]
QUADRATURE = 3e-13  # errors of 1e-14 in the weights of the nodes, times what decays fastest


def integral(function):
    """Over 0 to 1, by 60 Gauss nodes: exact to rounding for exponentials that decay by less than e^-50."""
    return fixed_quad(function, 0.0, 1.0, n=60)[0]


def answers(x):
    """phi_2, phi_1 and phi_0 of x (...) as integrals of e^{-xs}."""
    x = np.asarray(x)[..., None]
    return [integral(lambda s: (1 - s) * np.exp(-x * s)), integral(lambda s: np.exp(-x * s)), np.exp(-x[..., 0])]


def spreads(x):
    """C_ij (3, 3) as integrals of products of the answers to a unit change, s^i phi_i(xs)."""

    def products(s):
        p = np.stack([s**i * phi for i, phi in zip((2, 1, 0), answers(x * s), strict=True)])
        return p[:, None] * p

    return integral(products)


@pytest.mark.parametrize("x", MODERATE)
def test_means_are_the_answers_to_a_unit_change(x):
    expected = torch.as_tensor(np.array(answers(x)))
    torch.testing.assert_close(means(torch.tensor(x), 3), expected, rtol=QUADRATURE, atol=0)
    torch.testing.assert_close(means(torch.tensor(x), 2), expected[1:], rtol=QUADRATURE, atol=0)


@pytest.mark.parametrize("x", MODERATE)
def test_covariances_are_the_integrals_of_their_products(x):
    expected = torch.as_tensor(spreads(x))
    torch.testing.assert_close(covariances(torch.tensor(x), 3), expected, rtol=QUADRATURE, atol=0)
    torch.testing.assert_close(covariances(torch.tensor(x), 2), expected[1:, 1:], rtol=QUADRATURE, atol=0)


@pytest.mark.parametrize("x", [1e5, 1e9, 1e30])
def test_fast_decay_leaves_the_powers_of_1_over_x(x):
    y = 1 / x
    decayed = torch.tensor(
        [[y * y / 3, y * y / 2, y**3 / 2], [y * y / 2, y * y, y * y / 2], [y**3 / 2, y * y / 2, y / 2]]
    )
    torch.testing.assert_close(covariances(torch.tensor(x), 3), decayed, rtol=4 / x + 1e-14, atol=0)
    torch.testing.assert_close(means(torch.tensor(x), 3), torch.tensor([y, y, 0.0]), rtol=2 / x + 1e-14, atol=0)


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("function", [means, covariances])
def test_series_and_closed_form_meet(function, order):
    x = torch.tensor([1 - 1e-9, 1 + 1e-9], requires_grad=True)
    below, above = function(x, order)
    torch.testing.assert_close(below, above, rtol=1e-8, atol=0)
    for component in function(x, order).flatten(1).unbind(1):
        (slope,) = torch.autograd.grad(component.sum(), x, retain_graph=True)
        torch.testing.assert_close(slope[0], slope[1], rtol=1e-8, atol=0)


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("function", [means, covariances])
def test_gradients_are_finite_differences(function, order):
    x = torch.tensor([1e-3, 0.4, 0.99, 1.01, 3.0, 30.0], requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: function(x, order), x)


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("function", [means, covariances])
def test_values_and_gradients_are_finite_from_0_to_1e30(function, order):
    x = torch.tensor([0.0, 1e-320, 1e-30, 1.0, 800.0, 1e30], requires_grad=True)
    values = function(x, order)
    (slope,) = torch.autograd.grad(values.sum(), x)
    assert values.isfinite().all()
    assert slope.isfinite().all()


@pytest.mark.parametrize("order", [2, 3])
def test_covariances_have_a_factor_at_every_decay(order):
    x = torch.cat([torch.zeros(1), torch.logspace(-30, 30, 601), torch.linspace(0.9, 1.1, 101)])
    c = covariances(x, order)
    factor = torch.linalg.cholesky(c)
    torch.testing.assert_close(factor @ factor.mT, c)


def test_shape_is_that_of_x_and_numbers_are_double():
    x = torch.rand(3, 5, dtype=torch.float32)
    assert means(x, 2).shape == (3, 5, 2)
    assert covariances(x, 3).shape == (3, 5, 3, 3)
    assert means(x, 2).dtype == covariances(x, 3).dtype == torch.float64


@pytest.mark.parametrize("function", [means, covariances])
@pytest.mark.parametrize("order", [1, 4, 2.5])
def test_another_order_is_refused(function, order):
    with pytest.raises(InputError, match=rf"order must be 2 .* or 3 .*, got {order}"):
        function(torch.tensor(0.5), order)
