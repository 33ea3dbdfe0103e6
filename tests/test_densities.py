"""Every density of probtrack through the same checks."""

import math
from typing import NamedTuple

import properties
import pytest
import torch
from torch.distributions import Normal, Uniform

from probtrack.distributions import (
    LinearGaussian,
    PeaksAmongClutter,
    TargetOrClutter,
    TruncatedNormal,
    WrappedGaussian,
    WrappedNormal,
)


class Case(NamedTuple):
    """A law as numbers, since tensors are made in the tests."""

    make: object
    parameters: list
    sides: list  # of a box that holds the mass: low, high, cells
    event: tuple = ()
    values: list = ()  # for a second look, in float32
    extremes: list = ()  # (parameters, value), in float32

    def tensors(self):
        return [torch.tensor(x) for x in self.parameters]

    def law(self):
        return self.make(*self.tensors())


def flat(like, low, high):
    return Uniform(torch.full_like(like, low), torch.full_like(like, high))


def heading(loc, scale, logit):
    return TargetOrClutter(WrappedNormal(loc, scale), flat(loc, -math.pi, math.pi), logit)


def delay(loc, scale, logit):
    normal = Normal(torch.full_like(loc, 0.2), torch.full_like(loc, 1.3))
    return TargetOrClutter(TruncatedNormal(loc, scale, -1.1, 0.9), normal, logit)


def peaks(loc, scale, log_prior):
    return PeaksAmongClutter(TruncatedNormal(loc, scale, -1.1, 0.9), flat(loc, -1.1, 0.9), log_prior)


def heading_and_rate(loc, gain):
    return WrappedGaussian(LinearGaussian(loc, gain), angle=0)


GAIN = [[0.5, 0.1, 0.2], [-0.3, 0.4, 0.0]]

CASES = {
    "linear gaussian": Case(
        LinearGaussian, [[0.4, -0.2], GAIN], [(-4, 5, 200), (-4, 4, 200)], (2,), [[0.1, 0.3]],
        [([[0.4, -0.2], [[1e-4, 0.0], [2.0, 300.0]]], [0.4002, 50.0])],
    ),
    "truncated normal": Case(
        TruncatedNormal, [0.3, 0.7, -1.1, 0.9], [(-1.1, 0.9, 500)], (), [0.1, -1.1, 0.9],
        [([0.3, s, -1.1, 0.9], -0.7) for s in (0.02, 1e2, 1e6)],
    ),
    "truncated below its mean": Case(
        TruncatedNormal, [3.0, 0.7, -1.1, 0.9], [(-1.1, 0.9, 500)], (), [0.1],
        [([loc, s, -1.0, 1.0], 0.96875) for loc, s in ((40.0, 1.0), (1e3, 1.0), (1.0, 1e-2), (1.5, 1e-2))],
    ),
    "truncated above its mean": Case(
        TruncatedNormal, [-2.0, 0.7, -1.1, 0.9], [(-1.1, 0.9, 500)], (), [0.1],
        [([loc, s, -1.0, 1.0], -0.96875) for loc, s in ((-40.0, 1.0), (-1e3, 1.0), (-1.0, 1e-2), (-9.0, 2.0))],
    ),
    "narrow wrapped normal": Case(
        WrappedNormal, [2.7, 0.6], [(-math.pi, math.pi, 500)], (), [2.9, -2.9, -0.4],
        [([0.5, 1e-4], v) for v in (0.5, 3.0, -2.5)],
    ),
    "wide wrapped normal": Case(
        WrappedNormal, [2.7, 2.4], [(-math.pi, math.pi, 500)], (), [2.9, -2.9, -0.4],
        [([0.5, s], 3.0) for s in (5.0, 20.0, 1e4)],
    ),
    "delay or clutter": Case(
        delay, [0.3, 0.2, -0.4], [(-11.1, 12.9, 12_000)], (), [0.1, -1.3],
        [([0.3, 1e-4, x], 0.8) for x in (-90.0, 90.0, 0.0)],
    ),
    "peaks among clutter": Case(
        peaks, [[0.3], [0.2], [-1.0, -0.7, -1.6]], [(-1.1, 0.9, 200)] * 2, (2,), [[0.2, -0.6]],
        [([[0.3], [1e-3], [-90.0, 0.0, -3.0]], [0.31, 0.8]), ([[50.0], [0.2], [-0.1, 0.0, -3.0]], [0.8, 0.1])],
    ),
    "heading and rate": Case(
        heading_and_rate, [[2.9, 0.3], GAIN], [(-math.pi, math.pi, 200), (-3, 4, 200)], (2,),
        [[-2.9, 0.4], [2.0, -0.4]],
        [([[3.0, 0.3], [[1e-3, 0.0], [2e-2, 0.1]]], [-3.0, 0.5])],
    ),
}  # fmt: skip

NO_MEAN = {"heading or clutter": Case(heading, [2.7, 0.3, -0.4], [(-math.pi, math.pi, 500)], (), [2.9, -2.9, -0.4])}

ON_THE_CIRCLE = (WrappedNormal, heading_and_rate)  # whose moments are circular, or of the law before wrapping

every_case = pytest.mark.parametrize("case", [pytest.param(c, id=name) for name, c in CASES.items()])
every_case_and_circular = pytest.mark.parametrize(
    "case", [pytest.param(c, id=name) for name, c in (CASES | NO_MEAN).items()]
)


def two_of(case):
    """Parameters with a batch of two laws, the second one slightly different."""
    return [torch.stack([x, x + 0.1]) for x in case.tensors()]


@every_case
def test_shapes(case):
    properties.assert_shapes(case.law(), (), case.event)
    properties.assert_shapes(case.make(*two_of(case)), (2,), case.event)


@every_case_and_circular
def test_one_log_prob_for_each_value(case):
    properties.assert_log_prob_shape(case.law())
    properties.assert_log_prob_shape(case.make(*two_of(case)))


@every_case_and_circular
def test_a_batch_of_laws_is_those_laws(case):
    value = case.law().sample()
    both = case.make(*two_of(case)).log_prob(value)
    each = [case.make(*(x[i] for x in two_of(case))).log_prob(value) for i in (0, 1)]
    torch.testing.assert_close(both, torch.stack(each))


@every_case
def test_expand_repeats_the_law(case):
    properties.assert_expands(case.law())
    properties.assert_expands(case.make(*two_of(case)))


@every_case_and_circular
def test_density_integrates_to_one(case):
    properties.assert_normalised(case.law(), *properties.box(*case.sides), tol=1e-4)


@every_case_and_circular
def test_samples_follow_the_density(case):
    properties.assert_samples_follow_density(case.law(), *properties.box(*case.sides))


@pytest.mark.parametrize("case", [pytest.param(c, id=n) for n, c in CASES.items() if c.make not in ON_THE_CIRCLE])
def test_mean_and_variance_are_those_of_the_density(case):
    law, (grid, cell) = case.law(), properties.box(*case.sides)
    weight = (law.log_prob(grid).exp() * cell).reshape(-1, *(1 for _ in case.event))
    mean = (weight * grid).sum(0)
    torch.testing.assert_close(law.mean, mean, rtol=0, atol=1e-4)
    torch.testing.assert_close(law.variance, (weight * (grid - mean).square()).sum(0), rtol=0, atol=1e-4)


@every_case_and_circular
def test_log_prob_gradients(case):
    inside = torch.tensor(case.values[0])
    properties.assert_density_gradients(case.make, case.tensors(), inside)
    properties.assert_density_gradients(case.make, two_of(case), inside)


@pytest.mark.parametrize("case", [pytest.param(c, id=n) for n, c in CASES.items() if "clutter" not in n])
def test_sample_gradients(case):
    properties.assert_sample_gradients(case.make, case.tensors())


@every_case_and_circular
def test_float32_is_close_to_float64(case):
    for value in case.values:
        properties.assert_single_precision(case.make, case.tensors(), torch.tensor(value))


@pytest.mark.parametrize(
    ("make", "parameters", "value"),
    [pytest.param(c.make, *extreme, id=f"{n} {i}") for n, c in CASES.items() for i, extreme in enumerate(c.extremes)],
)
def test_extreme_values_in_float32(make, parameters, value):
    properties.assert_single_precision(make, [torch.tensor(x) for x in parameters], torch.tensor(value))


@every_case_and_circular
def test_parameters_survive_saving(case):
    class Model(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.parts = torch.nn.ParameterList(case.tensors())

    value = torch.tensor(case.values[0])
    properties.assert_survives_saving(Model(), lambda model: case.make(*model.parts).log_prob(value).detach())


@every_case_and_circular
def test_nan_is_refused_unless_told_otherwise(case):
    law = case.law()
    value = torch.full(case.event, torch.nan)
    with pytest.raises(ValueError, match="support"):
        law.log_prob(value)
