"""Clouds of several frames: their evidence and its gradient are those of the logsumexp."""

import torch

from probtrack.dynamics import lehmann2007
from probtrack.filters.cloud import Frames


def frames_of(joint, lost):
    log_weight = [x.log_softmax(-1) for x in joint]
    return Frames([torch.zeros(2, 5, 4)] * 3, log_weight, list(joint), list(lost), [])


def test_evidence_and_its_gradient_are_those_of_the_logsumexp():
    joint = (3 * torch.randn(3, 2, 5)).index_fill(-1, torch.tensor([1]), -torch.inf).requires_grad_()
    pick = torch.randn(3, 2)
    evidence = frames_of(joint.unbind(0), torch.zeros(3, 2, dtype=torch.bool)).together().log_evidence
    assert torch.allclose(evidence, joint.logsumexp(-1))
    (ours,) = torch.autograd.grad((pick * evidence).sum(), joint)
    (exact,) = torch.autograd.grad((pick * joint.logsumexp(-1)).sum(), joint)
    assert torch.allclose(ours, exact)


def test_a_lost_frame_has_no_gradient():
    joint, lost = torch.randn(3, 2, 5, requires_grad=True), torch.zeros(3, 2, dtype=torch.bool)
    lost[1, 0] = True
    frames_of(joint.unbind(0), lost).together().log_evidence.sum().backward()
    assert (joint.grad[1, 0] == 0).all()
    assert (joint.grad[1, 1] > 0).all()


def test_kinematics_are_the_same_with_and_without_gradients():
    model = lehmann2007("CU-LAN")
    state = torch.randn(3, 5, 4)
    plain, traced = model.kinematics(state), model.kinematics(state.clone().requires_grad_())
    assert torch.equal(plain.position, traced.position)
    assert torch.equal(plain.velocity, traced.velocity)
    assert torch.equal(plain.velocity, state[..., 2:])
