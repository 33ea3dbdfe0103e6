"""What training makes small: the evidence of a model, or the errors of what a filter says with it."""

import abc
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from probtrack._checks import as_positive
from probtrack.dynamics import Kinematics
from probtrack.errors import InputError
from probtrack.filters import Cloud


class Outcome(NamedTuple):
    """What a filter made of some sequences, and the truth beside it, time first.

    Attributes:
        cloud: Weighted particles of every frame (T, *batch, N, D).
        kinematics: What they mean: positions (T, *batch, N, A) [m].
        truth: True positions (T, *batch, A) [m]; None where nobody knows them.
        known: Whether the truth says anything of a frame (T, *batch) bool; None where there is no truth.
        inside: Whether a frame is one of the run's own, not padding (T, *batch) bool; None where all are.
    """

    cloud: Cloud
    kinematics: Kinematics
    truth: Tensor | None = None
    known: Tensor | None = None
    inside: Tensor | None = None

    @property
    def estimate(self) -> Tensor:
        """Mean position of the weighted cloud (T, *batch, A) [m]."""
        return (self.cloud.log_weight.exp()[..., None] * self.kinematics.position).sum(-2)


class Loss(abc.ABC):
    """What is made small."""

    @abc.abstractmethod
    def __call__(self, outcome: Outcome) -> Tensor:
        """Return the loss of each run (*batch), a mean over its frames.

        Raises:
            InputError: for a loss that wants the truth where there is none.
        """


@dataclass(frozen=True)
class NegativeLogEvidence(Loss):
    r"""Unlikeliness of what was observed, a frame: :math:`-\frac1T \log p(y_{1:T})`.

    The exponential of the estimate has the exact evidence as its mean, so that the loss is above the exact one, by half
    the variance of its logarithm.
    """

    def __call__(self, outcome: Outcome) -> Tensor:
        evidence = outcome.cloud.log_evidence
        return -evidence.mean(0) if outcome.inside is None else _mean(-evidence, outcome.inside)


@dataclass(frozen=True)
class CloudLikelihood(Loss):
    r"""Unlikeliness of the true position under the cloud, taken for a mixture of Gaussian laws and a background:

    .. math:: -\log\Bigl(b + \sum_n w_t^{(n)} \mathcal N(\ell_t; \ell_t^{(n)}, h^2 I)\Bigr)

    Unlike a squared error it rewards a cloud that knows how far it may be wrong. Far from the cloud the loss is flat,
    -log b: a talker who was lost long ago teaches nothing of how not to lose one.

    Args:
        std: h, the width of the law around each particle [m].
        background: b, density that the truth has anywhere [1/m^2, or 1/m^3 in space].

    References:
        A. Younis, E. Sudderth, "Differentiable and stable long-range tracking of multiple posterior modes", NeurIPS
        2023: the negative log likelihood of the truth as the loss of a particle filter.
    """

    std: float = 0.1
    background: float = 0.01

    def __post_init__(self) -> None:
        as_positive(self.std, "std")
        as_positive(self.background, "background")

    def __call__(self, outcome: Outcome) -> Tensor:
        truth, known = _truth(outcome)
        error = (outcome.kinematics.position - truth[..., None, :]) / self.std
        log_kernel = -0.5 * error.square().sum(-1) - truth.shape[-1] * math.log(self.std * math.sqrt(2 * math.pi))
        near = (outcome.cloud.log_weight + log_kernel).logsumexp(-1)
        return _mean(-torch.logaddexp(near, near.new_tensor(self.background).log()), known)


@dataclass(frozen=True)
class SquaredError(Loss):
    r"""Squared distance of the estimate from the truth :math:`\lVert \hat\ell_t - \ell_t \rVert^2` [m^2].

    References:
        S1 eq. 7, whose square root is S1's RMSE, and eq. 33.
    """

    def __call__(self, outcome: Outcome) -> Tensor:
        truth, known = _truth(outcome)
        return _mean((outcome.estimate - truth).square().sum(-1), known)


@dataclass(frozen=True)
class ProposalLoss(Loss):
    r"""Unlikeliness of the weighted cloud under the proposal, :math:`-\sum_n w_t^{(n)} \log q(x_t^{(n)})`.

    Its gradient is that of the divergence of the proposal from the posterior law, which needs no sample of its own;
    the weights count as constants. Only a filter's `relocation` has such a proposal: 0 for all others.

    References:
        S. Gu, Z. Ghahramani, R. E. Turner, "Neural adaptive sequential Monte Carlo", NeurIPS 2015, eq. 6.
    """

    def __call__(self, outcome: Outcome) -> Tensor:
        cloud = outcome.cloud
        if cloud.log_proposal is None:
            return torch.zeros_like(cloud.log_evidence[0])
        unlikeliness = -(cloud.log_weight.detach().exp() * cloud.log_proposal).sum(-1)
        return unlikeliness.mean(0) if outcome.inside is None else _mean(unlikeliness, outcome.inside)


@dataclass(frozen=True)
class WeightedSum(Loss):
    """Several losses at once.

    Args:
        losses: What is summed.
        weights: What each is multiplied by, finite.
    """

    losses: Sequence[Loss]
    weights: Sequence[float]

    def __post_init__(self) -> None:
        if len(self.losses) != len(self.weights) or not self.losses:
            raise InputError(f"weights must be one for each loss, got {len(self.weights)} for {len(self.losses)}")
        if not all(map(math.isfinite, self.weights)):
            raise InputError(f"weights must be finite, got {list(self.weights)}")

    def __call__(self, outcome: Outcome) -> Tensor:
        terms = [weight * loss(outcome) for loss, weight in zip(self.losses, self.weights, strict=True)]
        return torch.stack(terms).sum(0)


def _truth(outcome: Outcome) -> tuple[Tensor, Tensor]:
    """Return the truth (T, *batch, A), 0 where it says nothing, and where it says something (T, *batch)."""
    if outcome.truth is None or outcome.known is None:
        raise InputError("this loss compares with the true position, and the data have none")
    known = outcome.known if outcome.inside is None else outcome.known & outcome.inside
    # taken out before anything is made of it: what is not known may be NaN, and so would be the gradient
    return torch.where(known[..., None], outcome.truth, 0.0), known


def _mean(values: Tensor, known: Tensor) -> Tensor:
    """Return the means (*batch) of `values` (T, *batch) over the frames that are known, 0 where none is."""
    return torch.where(known, values, 0.0).sum(0) / known.sum(0).clamp_min(1)
