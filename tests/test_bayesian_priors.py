"""Priors, what they are checked for, and what a posterior gives."""

import re
from pathlib import Path

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import nn

from probtrack import training
from probtrack.dynamics import CoordinateUncoupled, DrivenVelocity, TimeCorrelated
from probtrack.errors import InputError, NotFiniteError, ShapeError
from probtrack.filters import Gaussian, kalman_filter, position_system
from probtrack.switching import MarkovChain
from probtrack.training.bayesian import NUTS, SVI, ParticleMetropolis, Posterior, Target, fit_posterior
from probtrack.training.bayesian.latents import latents_of

QUICK = ParticleMetropolis(20, 5, 2)


class Mixed(nn.Module):
    """A parameter of each kind."""

    def __init__(self):
        super().__init__()
        self.process = TimeCorrelated(2.0, 0.7)
        self.chain = MarkovChain([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]])
        self.logit_share = nn.Parameter(torch.zeros(()))
        self.offset = nn.Parameter(torch.zeros(3))


def square(module, _):
    return -(module.process.log_rate.square())


PRIORS = {"process.rate": dist.LogNormal(0.0, 1.0)}


def test_parameters_are_the_maps_of_physical_values():
    priors = {
        "process.rate": dist.Gamma(2.0, 1.0),
        "chain.transition": dist.Dirichlet(torch.ones(2, 2)),
        "share": dist.Beta(1.0, 3.0),
        "offset": dist.Normal(torch.zeros(3), 1.0),
    }
    latents = {latent.name: latent for latent in latents_of(Mixed(), priors)}
    value = torch.tensor([[0.9, 0.1], [0.2, 0.8]])
    assert latents["process.rate"].parameter == "process.log_rate"
    torch.testing.assert_close(latents["process.rate"].to_parameter(torch.tensor(2.0)).exp(), torch.tensor(2.0))
    torch.testing.assert_close(latents["chain.transition"].to_parameter(value).softmax(-1), value)
    torch.testing.assert_close(latents["share"].to_parameter(torch.tensor(0.3)).sigmoid(), torch.tensor(0.3))
    assert torch.equal(latents["offset"].to_parameter(value), value)
    assert {latent.prior.batch_shape for latent in latents.values()} == {torch.Size()}


@pytest.mark.parametrize(
    ("priors", "error", "match"),
    [
        ({}, InputError, "priors must name at least one of .*process.rate, process.std, chain.initial"),
        (
            {"process.log_rate": dist.Normal(0.0, 1.0)},
            InputError,
            r"priors must be of .*rate.*'process.log_rate'",
        ),
        (
            {"process.rate": torch.distributions.Gamma(1.0, 1.0)},
            InputError,
            "one of pyro.distributions, got Gamma",
        ),
        ({"process.rate": dist.Normal(0.0, 1.0)}, InputError, "process.rate must have a support of positive numbers"),
        ({"process.rate": dist.Uniform(-0.1, 1.0)}, InputError, "support of positive numbers"),
        ({"share": dist.LogNormal(0.0, 1.0)}, InputError, "share must have a support of probabilities, got"),
        ({"chain.initial": dist.Beta(torch.ones(2), 1.0)}, InputError, "support of probabilities that sum to 1"),
        ({"offset": dist.Normal(0.0, 1.0)}, ShapeError, r"offset must have shape \(3,\), got \(\)"),
        ({"chain.transition": dist.Dirichlet(torch.ones(2))}, ShapeError, r"must have shape \(2, 2\), got \(2,\)"),
    ],
)
def test_rejects_priors_that_do_not_go_with_the_module(priors, error, match):
    with pytest.raises(error, match=match):
        fit_posterior(Mixed(), priors, square, QUICK)


METHODS = pytest.mark.parametrize("method", [QUICK, NUTS(5, 2, 1), SVI(3, 0.1, 5)], ids=lambda m: type(m).__name__)


@METHODS
def test_evidence_that_is_not_finite_names_the_values(method):
    with pytest.raises(NotFiniteError, match=r"log_evidence must be finite, got nan at process.rate = \d"):
        fit_posterior(Mixed(), PRIORS, lambda m, _: m.process.log_rate * torch.nan, method)


@METHODS
def test_values_that_the_models_refuse_are_named(method):
    y, rest = torch.randn(2, 2), Gaussian(torch.zeros(4), torch.zeros(4, 4))

    def log_evidence(module, _):
        model = CoordinateUncoupled(DrivenVelocity(module.process))
        return kalman_filter(y, position_system(model, 0.1, 0.1 * module.process.log_rate.abs() * 0), rest).log_evidence

    with pytest.raises(NotFiniteError, match=r"log_evidence failed at process.rate = \d.*: std must be finite"):
        fit_posterior(Mixed(), PRIORS, log_evidence, method)


def test_nuts_refuses_an_estimate():
    with pytest.raises(InputError, match="NUTS must have an exact evidence, this one depends on its seed"):
        fit_posterior(Mixed(), PRIORS, lambda m, seed: square(m, seed) + seed, NUTS(5, 2, 1))


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: NUTS(num_chains=0), "num_chains must be an integer of at least 1, got 0"),
        (lambda: ParticleMetropolis(num_samples=3), "num_samples must be an integer of at least 4, got 3"),
        (lambda: SVI(lr=0.0), "lr must be finite and positive"),
        (lambda: fit_posterior(Mixed(), PRIORS, square, QUICK, seed=-1), "seed must be an integer of at least 0"),
    ],
)
def test_rejects_settings_out_of_range(make, match):
    with pytest.raises(InputError, match=match):
        make()


@METHODS
def test_nothing_but_the_posterior_remains(method):
    pyro.get_param_store().clear()
    pyro.param("mine", torch.tensor(2.0))
    module, state = Mixed(), torch.random.get_rng_state()
    before = {name: value.clone() for name, value in module.state_dict().items()}
    fit_posterior(module, PRIORS, square, method)
    assert list(pyro.get_param_store()) == ["mine"]
    pyro.get_param_store().clear()
    assert torch.equal(torch.random.get_rng_state(), state)
    assert all(torch.equal(value, before[name]) for name, value in module.state_dict().items())
    assert all(p.grad is None and p.requires_grad for p in module.parameters())


@METHODS
def test_a_seed_gives_the_same_draws_and_another_others(method):
    first, again, other = (fit_posterior(Mixed(), PRIORS, square, method, seed=s) for s in (3, 3, 4))
    assert torch.equal(first.values["process.rate"], again.values["process.rate"])
    assert not torch.equal(first.values["process.rate"], other.values["process.rate"])


def test_a_sampler_goes_on_where_there_is_no_evidence():
    """A rate below 1 is impossible: the posterior is the prior above 1."""

    def log_evidence(module, _):
        return torch.zeros(()) if module.process.log_rate > 0 else torch.full((), torch.nan)

    prior = {"process.rate": dist.Gamma(8.0, 4.0)}
    posterior = fit_posterior(Mixed(), prior, log_evidence, ParticleMetropolis(60, 20, 1), seed=1)
    assert (posterior.values["process.rate"] > 1).all()


def test_single_precision_modules_are_evaluated_in_single_precision():
    seen = []

    def log_evidence(module, _):
        seen.append(module.process.log_rate.dtype)
        return square(module, 0)

    prior = {"process.rate": dist.LogNormal(torch.tensor(0.0, dtype=torch.float64), 1.0)}
    fit_posterior(Mixed().float(), prior, log_evidence, QUICK)
    assert set(seen) == {torch.float32}


@METHODS
def test_draws_stand_by_chain(method):
    prior = {"process.rate": PRIORS["process.rate"], "offset": dist.Normal(torch.zeros(3), 1.0).to_event(1)}
    values = fit_posterior(Mixed(), prior, square, method).values
    chains = getattr(method, "num_chains", 1)
    assert values["process.rate"].shape == (chains, method.num_samples)
    assert values["offset"].shape == (chains, method.num_samples, 3)


def drawn():
    """A posterior of two chains of 50 draws, known numbers."""
    priors = {"process.rate": dist.LogNormal(0.0, 1.0), "chain.initial": dist.Dirichlet(torch.ones(2))}
    target = Target(Mixed(), priors, square)
    share = torch.rand(2, 50)
    values = {"process.rate": torch.rand(2, 50) + 1, "chain.initial": torch.stack([share, 1 - share], -1)}
    return Posterior(target.module, target.latents, values, {})


def test_means_and_intervals_are_those_of_all_draws():
    posterior = drawn()
    rate = posterior.values["process.rate"].flatten()
    torch.testing.assert_close(posterior.mean()["process.rate"], rate.mean())
    torch.testing.assert_close(posterior.std()["process.rate"], rate.std())
    torch.testing.assert_close(posterior.interval(0.8)["process.rate"], rate.quantile(torch.tensor([0.1, 0.9])))
    assert posterior.interval()["chain.initial"].shape == (2, 2)
    with pytest.raises(InputError, match=r"probability must be in \(0, 1\), got 90"):
        posterior.interval(90)


def test_modules_have_the_physical_values_of_the_draws():
    posterior = drawn()
    mean = posterior.mean_module()
    torch.testing.assert_close(mean.process.log_rate.exp(), posterior.mean()["process.rate"])
    torch.testing.assert_close(mean.chain.logit_initial.softmax(-1), posterior.mean()["chain.initial"])
    assert mean.process.log_std == posterior.module.process.log_std
    rates = torch.stack([m.process.log_rate.exp() for m in posterior.modules(4)])
    torch.testing.assert_close(rates, posterior.values["process.rate"].flatten()[[12, 37, 62, 87]])
    assert posterior.module.process.log_rate.exp().item() == pytest.approx(2.0)


def test_chains_that_disagree_are_seen():
    posterior = drawn()
    assert posterior.r_hat()["process.rate"] < 1.1
    assert posterior.effective_sample_size()["process.rate"] > 50
    posterior.values["process.rate"][1] += 1
    assert posterior.r_hat()["process.rate"] > 2


def test_table_has_a_line_a_number():
    lines = drawn().table().splitlines()
    assert lines[0].split() == ["mean", "std", "5", "%", "95", "%", "r-hat", "ESS"]
    assert [line.split()[0] for line in lines[1:]] == ["process.rate", "chain.initial[0]", "chain.initial[1]"]
    assert len({len(line) for line in lines}) == 1


def test_training_does_not_load_pyro_before_it_is_asked_to():
    room = Path(__file__).parents[1] / "probtrack"
    files = [file for file in room.rglob("*.py") if file.parent.name != "bayesian"]
    lines = [line for file in files for line in file.read_text(encoding="utf-8").splitlines()]
    assert [line for line in lines if re.match(r"(from|import) (pyro|probtrack.training.bayesian)", line)] == []
    assert training.bayesian.NUTS is NUTS
