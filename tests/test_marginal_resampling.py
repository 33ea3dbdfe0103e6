"""Marginal stop-gradient: the plain scheme in value, the gradient of the mixture that particles came from."""

import math

import pytest
import torch
from torch import nn
from torch.distributions import Independent, Normal, Uniform

from probtrack.dynamics import Dynamics, Kinematics, lehmann2007
from probtrack.errors import InputError, SingularLawError
from probtrack.filters import Adaptive, ParticleFilter, Relocation, StopGradient
from probtrack.filters.resampling import MarginalStopGradient, OptimalTransport, multinomial, systematic
from probtrack.likelihoods import GaussianPosition
from probtrack.switching import MarkovChain, SwitchingDynamics

DT = 0.4


class Walk(Dynamics):
    """A position that is drawn towards the origin, with learnable parameters."""

    state_dim = noise_dim = axes = 2

    def __init__(self):
        super().__init__()
        self.log_scale = nn.Parameter(torch.tensor(0.6).log())
        self.decay = nn.Parameter(torch.tensor(0.8))

    def forward(self, state, dt):
        spread = self.log_scale.exp() * (dt**0.5 if isinstance(dt, float) else dt[..., None].sqrt())
        return Independent(Normal(self.decay * state, spread), 1)

    def kinematics(self, state):
        return Kinematics(state, torch.zeros_like(state))

    def from_kinematics(self, kinematics):
        return kinematics.position


def walk_filter(resample, size=11):
    return ParticleFilter(Walk(), GaussianPosition(0.5), num_particles=size, resample=resample)


def evidence(particle_filter, y, seeds, dt=DT):
    noise = particle_filter.noise(seeds)
    belief = particle_filter.spread_around(torch.zeros(*seeds.shape, 2), noise, std=0.3)
    return particle_filter.advance(belief, y, dt, noise)[0].log_evidence


def gradient(particle_filter, value):
    return torch.autograd.grad(value, [*particle_filter.dynamics.parameters()])


@pytest.mark.parametrize("wrap", [lambda x: x, lambda x: Adaptive(x, 0.8)])
@pytest.mark.parametrize("scheme", [multinomial, systematic])
def test_evidence_is_that_of_the_scheme_number_by_number(wrap, scheme):
    y, seeds = torch.randn(7, 1, 2), torch.arange(5)
    plain = evidence(walk_filter(wrap(scheme)), y, seeds)
    for other in (StopGradient, MarginalStopGradient):
        assert torch.equal(evidence(walk_filter(wrap(other(scheme))), y, seeds), plain)


def by_hand(particle_filter, y, seed):
    """Log evidence of two frames whose second cloud counts as drawn from the mixture of all first particles."""
    dynamics, size = particle_filter.dynamics, particle_filter.num_particles
    noise = particle_filter.noise(seed)
    state = particle_filter.spread_around(torch.zeros(2), noise, std=0.3).state
    total, std = 0.0, particle_filter.likelihood.log_std.exp()
    first, second = noise.frame(), noise.frame()
    state = dynamics(state, DT).mean + dynamics(state, DT).base_dist.scale * first.normal
    joint = Normal(state, std).log_prob(y[0]).sum(-1) - math.log(size)
    total, weight = torch.logsumexp(joint, 0), joint.softmax(0)
    drawn = state[sorted(int((weight.cumsum(0) < u).sum()) for u in first.uniform)]  # in order, like all copies
    moved = (dynamics(drawn, DT).mean + dynamics(drawn, DT).base_dist.scale * second.normal).detach()
    ratio = []
    for x in moved:
        density = sum(w * dynamics(s, DT).log_prob(x).exp() for w, s in zip(weight, state, strict=True))
        ratio.append((density / density.detach()).log())
    seen = Normal(moved, std).log_prob(y[1]).sum(-1) - math.log(size)
    return total + torch.logsumexp(seen + torch.stack(ratio), 0)


def test_gradient_is_that_of_the_mixture_over_all_ancestors():
    particle_filter, y = walk_filter(MarginalStopGradient(multinomial)), torch.randn(2, 2)
    made, expected = evidence(particle_filter, y, torch.tensor(3)), by_hand(particle_filter, y, 3)
    torch.testing.assert_close(made, expected)
    torch.testing.assert_close(gradient(particle_filter, made), gradient(particle_filter, expected))


def test_clouds_of_a_batch_have_the_gradients_of_each_alone():
    y, seeds = torch.full((4, 2, 2), 0.1), torch.tensor([4, 9])
    y[:, 1] += torch.tensor([[1.3, -0.4], [1.1, 0.4], [0.2, 1.0], [1.5, 0.0]])  # poor in other frames than the first
    particle_filter = walk_filter(Adaptive(MarginalStopGradient(systematic), 0.5))
    for row in (0, 1):
        together = gradient(particle_filter, evidence(particle_filter, y, seeds)[row])
        alone = gradient(particle_filter, evidence(particle_filter, y[:, row], seeds[row]))
        torch.testing.assert_close(together, alone)


def test_clouds_that_were_left_alone_keep_their_gradient():
    y, seeds = torch.randn(4, 1, 2), torch.arange(3)
    state, log_weight = torch.randn(2, 9, 2, requires_grad=True), torch.zeros(2, 9)
    log_weight[1, 0] = 5
    log_weight = torch.log_softmax(log_weight, -1).requires_grad_()
    scheme, model = Adaptive(MarginalStopGradient(systematic), 0.5), Walk()
    moved, new = state + 0.1, log_weight + 0.0
    followed, weighed = scheme.after_move((state, log_weight), moved, new, lambda x: model(x, DT))
    assert torch.equal(followed, moved)
    assert torch.equal(weighed, new)
    made = torch.autograd.grad((followed.sum() + 2 * weighed.sum()), [state, log_weight], retain_graph=True)
    torch.testing.assert_close(made[0][0], torch.ones(9, 2))
    torch.testing.assert_close(made[1][0], torch.full((9,), 2.0))
    (of_model,) = torch.autograd.grad(weighed[0].sum(), model.decay, allow_unused=True, retain_graph=True)
    assert of_model is None or of_model == 0
    assert torch.autograd.grad(weighed[1, 3], model.decay)[0] != 0
    never = walk_filter(Adaptive(MarginalStopGradient(systematic), 0.0))
    plain = walk_filter(Adaptive(systematic, 0.0))
    left, kept = (gradient(f, evidence(f, y, seeds).sum()) for f in (never, plain))
    torch.testing.assert_close(left, kept)


def test_gradient_does_not_depend_on_how_many_frames_are_summed_at_once(monkeypatch):
    particle_filter, y = walk_filter(MarginalStopGradient(systematic)), torch.randn(9, 1, 2)
    whole = gradient(particle_filter, evidence(particle_filter, y, torch.arange(3)).sum())
    monkeypatch.setattr("probtrack.filters.particle._CHUNK", 2 * 33)
    cut = gradient(particle_filter, evidence(particle_filter, y, torch.arange(3)).sum())
    torch.testing.assert_close(whole, cut)


def test_time_steps_of_each_run_are_those_of_the_run_alone():
    particle_filter, y, dt = walk_filter(MarginalStopGradient(systematic)), torch.randn(5, 3, 2), 0.2 + torch.rand(5, 3)
    seeds = torch.arange(3)
    together = gradient(particle_filter, evidence(particle_filter, y, seeds, dt)[1])
    alone = gradient(particle_filter, evidence(particle_filter, y[:, 1], seeds[1], dt[:, 1]))
    torch.testing.assert_close(together, alone)


def test_gradient_has_the_mean_of_that_of_one_ancestor():
    y, runs, found = 0.4 * torch.randn(4, 2), 3000, {}
    for name, scheme in (("one", StopGradient(multinomial)), ("all", MarginalStopGradient(multinomial))):
        particle_filter = walk_filter(scheme, size=8)
        decay = nn.Parameter(particle_filter.dynamics.decay.detach().expand(runs, 1, 1).clone())
        del particle_filter.dynamics.decay
        particle_filter.dynamics.decay = _Both(decay)
        # of the evidence itself, whose estimate is unbiased
        total = evidence(particle_filter, y[:, None], torch.arange(runs)).exp().sum()
        found[name] = torch.autograd.grad(total, decay)[0].flatten()
    spread = [x.std() / x.mean().abs() for x in found.values()]
    assert max(spread) < 5, spread  # or the standard error would say nothing
    difference = found["one"].mean() - found["all"].mean()
    assert difference.abs() < 5 * (sum(x.var() for x in found.values()) / runs) ** 0.5


class _Both:
    """A parameter (B, 1, 1) that also multiplies states one axis deeper, (B, 1, N, D)."""

    def __init__(self, value):
        self.value = value

    def __mul__(self, state):
        return (self.value if state.ndim == 3 else self.value[:, None]) * state


def test_float32_gradients_are_finite_when_particles_are_far_apart():
    torch.set_default_dtype(torch.float32)
    particle_filter = walk_filter(MarginalStopGradient(systematic), size=40)
    y = 20 * torch.randn(6, 1, 2)
    made = gradient(particle_filter, evidence(particle_filter, y, torch.arange(4)).sum())
    assert all(x.isfinite() for x in made)


def test_modes_are_summed_over_too():
    dynamics = SwitchingDynamics(
        [lehmann2007("CU-LAN", printed=False), lehmann2007("CU-TCVE", printed=False)], _chain()
    )
    for resample in (Adaptive(MarginalStopGradient(systematic), 0.9), MarginalStopGradient(systematic)):
        particle_filter = ParticleFilter(dynamics, GaussianPosition(0.3), num_particles=12, resample=resample)
        value = evidence(particle_filter, 0.4 * torch.randn(6, 1, 2), torch.arange(3)).sum()
        made = torch.autograd.grad(value, [*dynamics.chain.parameters()], allow_unused=True)
        assert all(x is None or x.isfinite().all() for x in made)
        assert any(x is not None and (x != 0).any() for x in made)


def test_motion_without_a_density_is_an_error_that_says_so():
    particle_filter = ParticleFilter(
        lehmann2007("CU-TCVE"), GaussianPosition(0.3), num_particles=9, resample=MarginalStopGradient(systematic)
    )
    with pytest.raises(SingularLawError, match="no density"):
        evidence(particle_filter, torch.randn(3, 2), torch.tensor(0))


def test_rejects_relocation():
    with pytest.raises(InputError, match="resample must not follow moves with relocation"):
        ParticleFilter(
            Walk(), GaussianPosition(0.5), resample=Adaptive(MarginalStopGradient(systematic)), relocation=Relocation()
        )


def _chain():
    return MarkovChain([0.3, 0.7], [[0.9, 0.1], [0.2, 0.8]], dt=0.1)


@pytest.mark.parametrize("wrap", [lambda x: x, Adaptive])
def test_rejects_blends_of_modes(wrap):
    dynamics = SwitchingDynamics([lehmann2007("CU-LAN"), lehmann2007("CU-TCVE")], _chain())
    with pytest.raises(InputError, match="resample must copy particles, SwitchingDynamics has modes"):
        ParticleFilter(dynamics, GaussianPosition(0.5), resample=wrap(OptimalTransport()))


def test_a_particle_that_none_could_have_become_hurts_no_gradient_of_a_cloud_left_alone():
    state, moved = 5.0 * torch.arange(6.0)[:, None].repeat(2, 1, 2), 5.0 * torch.arange(6.0)[:, None].repeat(2, 1, 2)
    leaf = torch.zeros(2, 6)
    leaf[0, 0] = -math.inf  # rich, but for one particle of weight zero that all others are too far from
    leaf[1, 0] = 9.0
    leaf.requires_grad_()
    log_weight = torch.log_softmax(leaf, -1)
    moved[1] = 0.0  # the poor cloud came from its heavy particle

    def law(state):
        return Independent(Uniform(state - 1, state + 1, validate_args=False), 1, validate_args=False)

    scheme = Adaptive(MarginalStopGradient(systematic), 0.5)
    _, weighed = scheme.after_move((state, log_weight), moved, log_weight, law)
    torch.logsumexp(weighed, -1).sum().backward()
    assert leaf.grad.isfinite().all()
