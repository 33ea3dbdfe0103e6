"""Particles that go where the evidence is: the evidence is that of the model, by quadrature on a line."""

import math
from typing import NamedTuple

import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Normal

from probtrack.dynamics import Dynamics, Kinematics, lehmann2007
from probtrack.errors import InputError, ShapeError
from probtrack.filters import Adaptive, Belief, ParticleFilter, Relocation, StopGradient
from probtrack.filters.relocation import _first_beyond, _near, _within_reach
from probtrack.filters.resampling import systematic
from probtrack.likelihoods import EvidenceMap, GaussianPosition, Likelihood
from probtrack.training import NegativeLogEvidence, Outcome, ProposalLoss

LOW, HIGH, CELLS, STEP, DT = -0.7, 1.9, 26, 0.05, 0.04
# a talker who is where nobody expects, and is heard well in the second frame and the fifth
PEAKS = torch.tensor([0.35, 1.5, 1.45, 0.2, 1.3])
SPEECH = torch.tensor([0.6, 0.95, 0.1, 0.7, 0.9])
SETTINGS = {"rate": 2.0, "rate_silence": 0.4, "spread": 0.5, "share": 0.2, "share_silence": 0.05, "memory": 0.05}


class Heard(NamedTuple):
    peak: Tensor
    speech: Tensor


class Wander(Dynamics):
    """A place on a line that wanders."""

    state_dim, noise_dim, axes = 1, 1, 1

    def forward(self, state, dt):  # noqa: ARG002
        return Independent(Normal(state, STEP), 1)

    def kinematics(self, state):
        return Kinematics(state, torch.zeros_like(state))

    def from_kinematics(self, kinematics):
        return kinematics.position


class Peak(Likelihood):
    """A peak over a floor within the region, nothing outside, and a map that leans to one side."""

    def forward(self, observation, kinematics):
        return log_likelihood(kinematics.position[..., 0], observation.peak[..., None], observation.speech[..., None])

    def evidence_map(self, prepared):
        size = (HIGH - LOW) / CELLS
        centre = LOW + size * (torch.arange(CELLS) + 0.5)
        away = (centre - prepared.peak[..., None] - 0.1) / 0.2
        return EvidenceMap(-0.5 * away.square(), centre[:, None], torch.tensor([size]))


def log_likelihood(x, peak, speech):
    density = (1 - speech) / (HIGH - LOW) + speech * (-0.5 * ((x - peak) / 0.08).square()).exp() / (0.08 * 2.5066)
    return torch.where((x >= LOW) & (x <= HIGH), density.log(), -torch.inf)


def exact_log_evidence(start, relocation, cells=1300):
    """By quadrature on a fine grid; a talker cannot be displaced to outside the region."""
    x = LOW + (HIGH - LOW) * (torch.arange(cells) + 0.5) / cells
    width, spread = (HIGH - LOW) / cells, relocation.log_spread.exp()

    def kernel(std):
        return Normal(x[:, None], std).log_prob(x).exp() * width

    move, displace = kernel(torch.tensor(STEP)), kernel(spread)
    law = Normal(start, 0.1).log_prob(x).exp() * width
    total = 0.0
    for peak, speech in zip(PEAKS, SPEECH, strict=True):
        rate = speech * relocation.log_rate.exp() + (1 - speech) * relocation.log_rate_silence.exp()
        leave = 1 - (-rate * DT).exp()
        law = ((1 - leave) * law + leave * (law @ displace)) @ move * log_likelihood(x, peak, speech).exp()
        total = total + law.sum().log()
        law = law / law.sum()
    return total


def particle_filter(num_particles, resample=None, **changes):
    return ParticleFilter(
        Wander(), Peak(), num_particles=num_particles, resample=resample, relocation=Relocation(**(SETTINGS | changes))
    )


def outcome(tracked, runs):
    noise = tracked.noise(torch.arange(runs))
    state = 0.3 + 0.1 * noise.normal(tracked.num_particles, 1)
    even = torch.full(state.shape[:-1], -math.log(tracked.num_particles))
    belief, cloud = tracked.run(Belief(state, even, torch.zeros(runs)), heard(), DT, noise)
    return belief, Outcome(cloud, tracked.dynamics.kinematics(cloud.state))


def heard():
    return Heard(PEAKS.to(torch.get_default_dtype())[:, None], SPEECH.to(torch.get_default_dtype())[:, None])


@pytest.mark.parametrize(
    "changes",
    [{}, {"share": 0.6, "share_silence": 0.3}, {"sharpness": 1.0, "memory": 0.5}, {"spread": 0.2}, {"rate": 9.0}],
)
def test_evidence_is_that_of_the_model_whatever_the_proposal(changes):
    tracked, runs = particle_filter(40, **changes), 2000
    with torch.no_grad():
        belief, _ = outcome(tracked, runs)
        exact = exact_log_evidence(0.3, tracked.relocation)
    ratio = (belief.log_evidence - exact).exp()
    assert abs(ratio.mean() - 1) < 5 * ratio.std() / math.sqrt(runs)
    assert ratio.std() / math.sqrt(runs) < 0.05  # or the check would be empty


@pytest.mark.parametrize("name", ["log_rate", "log_rate_silence", "log_spread"])
def test_gradient_of_the_evidence_is_that_of_the_model(name):
    runs = 2000
    tracked = particle_filter(30, Adaptive(StopGradient(systematic), 0.6), rate=6.0)
    parameter = getattr(tracked.relocation, name)
    wanted = torch.autograd.grad(exact_log_evidence(0.3, tracked.relocation), parameter)[0]
    # the mean of gradients of Z / mean of Z, since Z and not its logarithm is without bias
    slopes = []
    belief, _ = outcome(tracked, runs)
    weight = (belief.log_evidence.detach() - belief.log_evidence.detach().logsumexp(0)).exp()
    for part in range(5):
        chosen = slice(part * runs // 5, (part + 1) * runs // 5)
        share = weight[chosen] / weight[chosen].sum()
        slopes.append(torch.autograd.grad((share * belief.log_evidence[chosen]).sum(), parameter, retain_graph=True)[0])
    found = torch.stack(slopes)
    assert abs(found.mean() - wanted) < 5 * found.std() / math.sqrt(5)
    assert found.std() / math.sqrt(5) < 0.3 * abs(wanted)


def test_the_proposal_learns_how_often_a_talker_leaves():
    """In one frame the gradient of the share is the share less the posterior probability that the talker left."""
    tracked, runs = particle_filter(400, rate=10.0), 60
    noise = tracked.noise(torch.arange(runs))
    state = 0.3 + 0.1 * noise.normal(400, 1)
    even = torch.full((runs, 400), -math.log(400))
    first = Heard(torch.tensor([[1.1]]), torch.tensor([[1.0]]))
    _, cloud = tracked.run(Belief(state, even, torch.zeros(runs)), first, DT, noise)
    loss = ProposalLoss()(Outcome(cloud, tracked.dynamics.kinematics(cloud.state))).mean()
    found = torch.autograd.grad(loss, tracked.relocation.logit_share)[0]
    x = torch.linspace(LOW, HIGH, 2001)
    leave = 1 - math.exp(-10.0 * DT)
    seen = log_likelihood(x, torch.tensor(1.1), torch.tensor(1.0)).exp()
    stays = (1 - leave) * (Normal(0.3, math.hypot(0.1, STEP)).log_prob(x).exp() * seen).sum()
    goes = leave * (Normal(0.3, math.sqrt(0.1**2 + 0.5**2 + STEP**2)).log_prob(x).exp() * seen).sum()
    wanted = 0.2 - goes / (goes + stays)
    torch.testing.assert_close(found, wanted, rtol=0.1, atol=0.02)


def test_share_and_sharpness_have_no_other_gradient():
    tracked = particle_filter(20)
    _, result = outcome(tracked, 3)
    loss = NegativeLogEvidence()(result).sum()
    names = ["logit_share", "logit_share_silence", "log_sharpness", "log_memory"]
    parameters = [getattr(tracked.relocation, name) for name in names]
    assert torch.autograd.grad(loss, parameters, allow_unused=True, retain_graph=True) == (None,) * 4
    gradients = torch.autograd.grad(ProposalLoss()(result).sum(), parameters)
    assert all(g.isfinite() and g != 0 for g in gradients)


def test_the_map_learns_where_a_talker_goes():
    """In one frame the gradient of the sharpness is that of the posterior's divergence, by quadrature."""
    tracked, runs = particle_filter(400, rate=10.0, sharpness=0.4), 60
    noise = tracked.noise(torch.arange(runs))
    state = 0.3 + 0.1 * noise.normal(400, 1)
    even = torch.full((runs, 400), -math.log(400))
    first = Heard(torch.tensor([[1.1]]), torch.tensor([[1.0]]))
    _, cloud = tracked.run(Belief(state, even, torch.zeros(runs)), first, DT, noise)
    loss = ProposalLoss()(Outcome(cloud, tracked.dynamics.kinematics(cloud.state))).mean()
    found = torch.autograd.grad(loss, tracked.relocation.log_sharpness)[0]

    place = torch.linspace(LOW, HIGH, 2601)[:-1] + 0.0005
    leave, reach = 1 - math.exp(-10.0 * DT), math.sqrt(0.1**2 + 0.5**2)
    seen = [
        (Normal(x, STEP).log_prob(place) + log_likelihood(place, torch.tensor(1.1), torch.tensor(1.0))).exp().sum()
        for x in place
    ]
    goes = leave * Normal(0.3, reach).log_prob(place).exp() * torch.stack(seen) * 0.001
    stays = (1 - leave) * (
        Normal(0.3, math.hypot(0.1, STEP)).log_prob(place).exp()
        * log_likelihood(place, torch.tensor(1.1), torch.tensor(1.0)).exp()
    ).sum()

    def divergence(sharpness):
        size = (HIGH - LOW) / CELLS
        centre = LOW + size * (torch.arange(CELLS) + 0.5)
        near = -0.5 * ((centre - 0.3) / reach) ** 2
        heard_there = -0.5 * ((centre - 1.2) / 0.2) ** 2
        law = 0.9 * torch.softmax(sharpness * heard_there + near, 0) + 0.1 * torch.softmax(near, 0)
        cell = ((place - LOW) / size).long()
        return -(goes * law[cell].log()).sum() / (goes.sum() + stays)

    wanted = 0.4 * (divergence(0.401) - divergence(0.399)) / 0.002
    torch.testing.assert_close(found, wanted, rtol=0.1, atol=0.01)


def test_cutting_a_sequence_changes_nothing():
    tracked = particle_filter(25)
    noise, again = tracked.noise(torch.tensor([3, 4])), tracked.noise(torch.tensor([3, 4]))
    start = torch.zeros(2, 25, 1), torch.full((2, 25), -math.log(25)), torch.zeros(2)
    whole, _ = tracked.run(Belief(*start), heard(), DT, noise)
    belief = Belief(*start)
    for part in (slice(0, 2), slice(2, 3), slice(3, 5)):
        belief, _ = tracked.run(belief, Heard(*(x[part] for x in heard())), DT, again)
    torch.testing.assert_close(belief.state, whole.state)
    torch.testing.assert_close(belief.heard, whole.heard)


def test_time_steps_of_each_frame_and_run_are_the_same_as_one():
    tracked = particle_filter(25)
    start = Belief(torch.zeros(2, 25, 1), torch.full((2, 25), -math.log(25)), torch.zeros(2))
    beliefs = [
        tracked.run(start, Heard(*(x.expand(5, 2) for x in heard())), dt, tracked.noise(torch.tensor([3, 4])))[0]
        for dt in (DT, torch.full((5,), DT), torch.full((5, 2), DT))
    ]
    for belief in beliefs[1:]:
        torch.testing.assert_close(belief.state, beliefs[0].state)
        torch.testing.assert_close(belief.log_evidence, beliefs[0].log_evidence)


def test_float32_is_finite_far_from_everything():
    torch.set_default_dtype(torch.float32)
    tracked = particle_filter(50, sharpness=300.0, memory=5.0, spread=0.01)
    state = torch.full((2, 50, 1), -0.69)
    start = Belief(state, torch.full((2, 50), -math.log(50)), torch.zeros(2))
    belief, cloud = tracked.run(start, heard(), DT, tracked.noise(torch.tensor([1, 2])))
    assert belief.log_evidence.isfinite().all()
    result = Outcome(cloud, tracked.dynamics.kinematics(cloud.state))
    (ProposalLoss()(result).sum() + belief.log_evidence.sum()).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in tracked.relocation.parameters())


def test_a_likelihood_without_a_map_is_refused():
    tracked = ParticleFilter(lehmann2007("CU-LAN"), GaussianPosition(0.1), num_particles=5, relocation=Relocation())
    belief = Belief(torch.zeros(5, 4), torch.full((5,), -math.log(5)), torch.zeros(()))
    with pytest.raises(InputError, match="relocation needs a likelihood with an evidence_map, GaussianPosition"):
        tracked.run(belief, torch.zeros(3, 2), DT, tracked.noise(0))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rate": 0.0}, "rate must be finite and positive"),
        ({"share": 1.0}, r"share must be in \(0, 1\), got 1.0"),
        ({"share_silence": 0.0}, r"share_silence must be in \(0, 1\)"),
        ({"spread": math.nan}, "spread must be finite"),
        ({"memory": -1.0}, "memory must be finite"),
    ],
)
def test_rejects(changes, words):
    with pytest.raises(InputError, match=words):
        Relocation(**changes)


def test_rejects_speech_of_another_shape():
    tracked = particle_filter(5)
    belief = Belief(torch.zeros(5, 1), torch.full((5,), -math.log(5)), torch.zeros(()))
    with pytest.raises(ShapeError, match="speech must have shape"):
        tracked.run(belief, Heard(PEAKS.double(), SPEECH[:, None].double()), DT, tracked.noise(0))


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-4)])
def test_cells_are_drawn_by_the_normal_law_about_the_cloud(dtype, tolerance):
    position = torch.randn(3, 7, 2, dtype=dtype) + torch.tensor([4.0, -2.0], dtype=dtype)
    log_weight, centre = torch.randn(3, 7, dtype=dtype).log_softmax(-1), torch.rand(11, 2, dtype=dtype) * 3 + 1
    weight = log_weight.exp()[..., None]
    mean = (weight * position).sum(-2)
    variance = (weight * position.square()).sum(-2) - mean.square() + 0.16
    heard = 2 * torch.randn(1, 11, dtype=dtype)
    density = Independent(Normal(mean[:, None], variance.sqrt()[:, None]), 1).log_prob(centre)
    expected = 0.9 * (heard + density).softmax(-1) + 0.1 * density.softmax(-1)
    near = _near(position, log_weight, torch.tensor(0.16, dtype=dtype), centre)
    assert torch.allclose(_within_reach(heard, near), expected, atol=tolerance)


@pytest.mark.parametrize("batch", [(), (3,), (0,), (2, 3)])
@pytest.mark.parametrize("chance", [0.0, 0.4, 1.0])
def test_who_goes_finds_its_cell(batch, chance):
    ends, uniform = torch.rand(*batch, 11).cumsum(-1), 5 * torch.rand(*batch, 7)
    goes = (torch.rand(*batch, 7) < chance).double()
    counted = (ends[..., None, :] <= uniform[..., None]).sum(-1).clamp_max(10)
    cell = _first_beyond(ends, uniform, goes)
    assert cell.shape == goes.shape
    assert torch.equal(cell[goes > 0], counted[goes > 0])
