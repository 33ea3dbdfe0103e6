"""Losses against sums by hand: two frames, two runs, three particles; what is unknown or padding counts for nothing."""

import math

import pytest
import torch

from probtrack.dynamics import Kinematics
from probtrack.errors import InputError
from probtrack.filters import Cloud
from probtrack.training import CloudLikelihood, NegativeLogEvidence, Outcome, ProposalLoss, SquaredError, WeightedSum

# frame, run, particle
WEIGHT = [[[0.5, 0.3, 0.2], [0.1, 0.1, 0.8]], [[0.25, 0.6, 0.15], [0.7, 0.2, 0.1]]]
PLACE = [
    [[[1.0, 0.2], [1.4, -0.1], [0.7, 0.5]], [[2.0, 1.0], [2.1, 1.3], [1.8, 0.9]]],
    [[[1.1, 0.1], [1.5, 0.0], [0.6, 0.4]], [[2.2, 1.1], [2.0, 1.2], [1.7, 0.8]]],
]
TRUTH = [[[1.05, 0.15], [1.9, 1.05]], [[1.2, 0.05], [2.15, 1.0]]]
EVIDENCE, PROPOSAL = [[-1.2, 0.4], [-0.3, 2.5]], [[[-0.1, -2.0, -0.3], [-1.0, -0.5, -0.2]]] * 2
STD, BACKGROUND = 0.3, 0.02
LOSSES = [
    NegativeLogEvidence(),
    CloudLikelihood(STD, BACKGROUND),
    SquaredError(),
    ProposalLoss(),
    WeightedSum((SquaredError(), CloudLikelihood()), (2.0, -0.3)),
]
WITH_TRUTH = [LOSSES[1], LOSSES[2], LOSSES[4]]


def outcome(*, known=None, inside=None, truth=TRUTH, proposal=PROPOSAL, place=PLACE):
    position, truth = torch.tensor(place), torch.tensor(truth)
    cloud = Cloud(
        torch.cat([position, 0.7 * torch.ones_like(position)], -1),
        torch.tensor(WEIGHT).log(),
        torch.tensor(EVIDENCE),
        torch.zeros(2, 2, dtype=torch.bool),
        None if proposal is None else torch.tensor(proposal),
    )
    known = torch.ones(2, 2, dtype=torch.bool) if known is None else torch.tensor(known)
    kinematics = Kinematics(position, torch.ones_like(position))
    return Outcome(cloud, kinematics, truth, known, None if inside is None else torch.tensor(inside))


def by_hand(loss, t, r):
    """Oracle: the loss of one frame of one run, in plain numbers."""
    weight, place, (x, y) = WEIGHT[t][r], PLACE[t][r], TRUTH[t][r]
    if isinstance(loss, NegativeLogEvidence):
        return -EVIDENCE[t][r]
    if isinstance(loss, ProposalLoss):
        return -sum(w * q for w, q in zip(weight, PROPOSAL[t][r], strict=True))
    if isinstance(loss, SquaredError):
        mean = [sum(w * p[axis] for w, p in zip(weight, place, strict=True)) for axis in (0, 1)]
        return (mean[0] - x) ** 2 + (mean[1] - y) ** 2
    if isinstance(loss, CloudLikelihood):
        peak = 1 / (2 * math.pi * loss.std**2)
        near = [peak * math.exp(-((p[0] - x) ** 2 + (p[1] - y) ** 2) / (2 * loss.std**2)) for p in place]
        return -math.log(loss.background + sum(w * n for w, n in zip(weight, near, strict=True)))
    return sum(w * by_hand(one, t, r) for one, w in zip(loss.losses, loss.weights, strict=True))


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: type(loss).__name__)
def test_loss_of_a_run_is_the_mean_over_its_frames(loss):
    exact = [(by_hand(loss, 0, r) + by_hand(loss, 1, r)) / 2 for r in range(2)]
    torch.testing.assert_close(loss(outcome()), torch.tensor(exact))


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: type(loss).__name__)
def test_padding_counts_for_nothing(loss):
    value = loss(outcome(inside=[[True, True], [True, False]]))
    exact = [(by_hand(loss, 0, 0) + by_hand(loss, 1, 0)) / 2, by_hand(loss, 0, 1)]
    torch.testing.assert_close(value, torch.tensor(exact))


@pytest.mark.parametrize("loss", WITH_TRUTH, ids=lambda loss: type(loss).__name__)
def test_frames_of_unknown_truth_count_for_nothing(loss):
    truth = [[TRUTH[0][0], [math.nan, 9.0]], [[math.inf, -math.inf], [math.nan, math.nan]]]
    made = outcome(known=[[True, False], [False, False]], truth=truth)
    # the second run knows nothing at all
    torch.testing.assert_close(loss(made), torch.tensor([by_hand(loss, 0, 0), 0.0]))


@pytest.mark.parametrize("loss", WITH_TRUTH, ids=lambda loss: type(loss).__name__)
def test_frames_of_unknown_truth_have_no_gradient(loss):
    truth = [[TRUTH[0][0], [math.nan, 9.0]], [[math.inf, -math.inf], TRUTH[1][1]]]
    known = [[True, False], [False, True]]

    def value(place, log_weight):
        made = outcome(known=known, truth=truth)
        cloud = made.cloud._replace(log_weight=log_weight)
        return loss(made._replace(cloud=cloud, kinematics=Kinematics(place, place)))

    leaves = [torch.tensor(PLACE).requires_grad_(), torch.tensor(WEIGHT).log().requires_grad_()]
    gradients = torch.autograd.grad(value(*leaves).sum(), leaves)
    for gradient in gradients:
        assert gradient.isfinite().all()
        assert (gradient.flatten(2).abs().sum(-1) > 0).tolist() == known
    assert torch.autograd.gradcheck(value, leaves)


def test_gradients_by_evidence_weights_and_proposal():
    def evidence(values):
        made = outcome(inside=[[True, False], [True, True]])
        return NegativeLogEvidence()(made._replace(cloud=made.cloud._replace(log_evidence=values)))

    assert torch.autograd.gradcheck(evidence, torch.tensor(EVIDENCE).requires_grad_())

    def proposal(log_proposal):
        made = outcome()
        return ProposalLoss()(made._replace(cloud=made.cloud._replace(log_proposal=log_proposal)))

    assert torch.autograd.gradcheck(proposal, torch.tensor(PROPOSAL).requires_grad_())


def test_weights_count_as_constants_for_the_proposal():
    made, log_weight = outcome(), torch.tensor(WEIGHT).log().requires_grad_()
    log_proposal = torch.tensor(PROPOSAL).requires_grad_()
    cloud = made.cloud._replace(log_weight=log_weight, log_proposal=log_proposal)
    ProposalLoss()(made._replace(cloud=cloud)).sum().backward()
    assert log_weight.grad is None
    torch.testing.assert_close(log_proposal.grad, -torch.tensor(WEIGHT) / 2)


def test_without_a_proposal_its_loss_is_zero():
    assert ProposalLoss()(outcome(proposal=None)).tolist() == [0.0, 0.0]


def test_far_from_the_cloud_the_likelihood_is_the_background_alone():
    far = outcome(truth=[[[90.0, 0.0], [90.0, 0.0]]] * 2)
    torch.testing.assert_close(CloudLikelihood(STD, BACKGROUND)(far), torch.full((2,), -math.log(BACKGROUND)))


def test_likelihood_of_a_cloud_in_space_has_the_constant_of_three_axes():
    place = torch.zeros(1, 1, 4, 3)
    cloud = Cloud(place, torch.full((1, 1, 4), -math.log(4)), torch.zeros(1, 1), torch.zeros(1, 1, dtype=torch.bool))
    made = Outcome(cloud, Kinematics(place, place), torch.zeros(1, 1, 3), torch.ones(1, 1, dtype=torch.bool))
    exact = -math.log(BACKGROUND + (2 * math.pi * STD**2) ** -1.5)
    torch.testing.assert_close(CloudLikelihood(STD, BACKGROUND)(made), torch.tensor([exact]))


def test_estimate_is_the_weighted_mean_position():
    torch.testing.assert_close(outcome().estimate[0, 0], torch.tensor([0.5 + 0.42 + 0.14, 0.1 - 0.03 + 0.1]))


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: type(loss).__name__)
def test_float32_is_close_to_float64(loss):
    exact = loss(outcome())
    torch.set_default_dtype(torch.float32)
    value = loss(outcome())
    assert value.dtype == torch.float32
    torch.testing.assert_close(value.double(), exact, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("missing", ["truth", "known"])
@pytest.mark.parametrize("loss", WITH_TRUTH, ids=lambda loss: type(loss).__name__)
def test_without_truth_what_compares_with_it_says_so(loss, missing):
    with pytest.raises(InputError, match="compares with the true position, and the data have none"):
        loss(outcome()._replace(**{missing: None}))


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: CloudLikelihood(std=0.0), "std must be finite and positive, got 0"),
        (lambda: CloudLikelihood(background=-1.0), "background must be finite and positive, got -1"),
        (lambda: WeightedSum([SquaredError()], [1.0, 2.0]), "weights must be one for each loss, got 2 for 1"),
        (lambda: WeightedSum([], []), "weights must be one for each loss, got 0 for 0"),
        (lambda: WeightedSum([SquaredError()], [math.nan]), r"weights must be finite, got \[nan\]"),
    ],
)
def test_rejects_settings(make, match):
    with pytest.raises(InputError, match=match):
        make()
