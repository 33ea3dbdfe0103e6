"""What is reported of weighted particle clouds: means, spreads and directions."""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from probtrack.dynamics import Dynamics
from probtrack.tracks import Track

_NEAREST = 1e-12  # m: a particle nearer to the origin than that has no direction


class Cloud(NamedTuple):
    """Weighted particles of a sequence of frames, time first: what losses are taken of.

    Attributes:
        state: Particles (T, *batch, N, D), before they are resampled.
        log_weight: Normalised log weights (T, *batch, N).
        log_evidence: log p(y_t | y_1:t-1) (T, *batch), 0 for lost frames.
        lost: Whether no particle was possible (T, *batch) bool.
        log_proposal: Log probability with which a proposal drew each particle as it did (T, *batch, N), with the
            gradient of the proposal; None without one, or where gradients are not asked for.
    """

    state: Tensor
    log_weight: Tensor
    log_evidence: Tensor
    lost: Tensor
    log_proposal: Tensor | None = None


class Frames(NamedTuple):
    """Clouds frame by frame, as a filter makes them, kept until they are worked on together.

    Attributes:
        state: Particles (*batch, N, D) of each frame.
        log_weight: Normalised log weights (*batch, N).
        joint: Log weights before they were normalised (*batch, N).
        lost: Whether no particle was possible (*batch).
        log_proposal: As in `Cloud`, empty where there is none.
    """

    state: list[Tensor]
    log_weight: list[Tensor]
    joint: list[Tensor]
    lost: list[Tensor]
    log_proposal: list[Tensor]

    def together(self) -> Cloud:
        """Return the frames with time as the first axis."""
        log_weight, lost = _stacked(self.log_weight), _stacked(self.lost)
        evidence = _Evidence.apply(_stacked(self.joint), log_weight.detach())
        # states lie in memory variables first: stacked like that, and turned without a copy
        state = _stacked([state.movedim(-1, 0) for state in self.state]).movedim(1, -1)
        proposal = _stacked(self.log_proposal) if self.log_proposal else None
        return Cloud(state, log_weight, evidence.masked_fill(lost, 0.0), lost, proposal)


class _Evidence(torch.autograd.Function):
    """What log weights were normalised by (...), given those before (..., N) and after (..., N).

    Read off the largest ones: a second logsumexp would cost as much as all the rest. Its gradient is that of a
    logsumexp all the same, the weights.
    """

    @staticmethod
    def forward(ctx: Any, joint: Tensor, log_weight: Tensor) -> Tensor:
        evidence = joint.amax(-1) - log_weight.amax(-1)
        ctx.save_for_backward(joint, evidence)
        return evidence

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        joint, evidence = ctx.saved_tensors
        return gradient[..., None] * (joint - evidence[..., None]).exp(), None


def track_of(cloud: Cloud, dynamics: Dynamics, origin: Tensor | None) -> Track:
    """Return the track of `cloud`, with azimuths about `origin` (A,) if there is one; its time is zero."""
    weight = cloud.log_weight.exp()  # (T, *batch, N)
    kinematics, mode = dynamics.kinematics(cloud.state), dynamics.mode(cloud.state)
    mean = weighted_mean(weight, kinematics.position)
    covariance = _covariance(weight, kinematics.position - mean[..., None, :])
    std_heading = None
    if kinematics.modelled_heading is None:
        heading = _angle(weighted_mean(weight, kinematics.velocity))
    else:
        cosine, sine = kinematics.modelled_heading.cos(), kinematics.modelled_heading.sin()
        looks = weighted_mean(weight, torch.stack([cosine, sine], -1))
        heading, std_heading = _angle(looks), _circular_std(looks)
    azimuth, std_azimuth = None, None
    if origin is not None:
        offset = kinematics.position[..., :2] - origin[:2]
        unit = offset * offset.square().sum(-1, keepdim=True).clamp_min(_NEAREST**2).rsqrt()
        direction = weighted_mean(weight, unit)
        azimuth, std_azimuth = _angle(direction), _circular_std(direction)
    return Track(
        time=weight.new_zeros(len(weight)),
        position=mean,
        std=covariance.diagonal(dim1=-2, dim2=-1).sqrt(),
        heading=heading,
        ess=1 / weighted_mean(weight, weight[..., None])[..., 0],
        log_evidence=cloud.log_evidence,
        lost=cloud.lost,
        azimuth=azimuth,
        std_azimuth=std_azimuth,
        mode=None if mode is None else weighted_mean(weight, mode),
        covariance=covariance,
        std_heading=std_heading,
    )


def _stacked(frames: list[Tensor]) -> Tensor:
    """Return `frames` with time as the first axis; one frame of a large cloud is not worth a copy."""
    return torch.stack(frames) if len(frames) > 1 else frames[0][None]


def weighted_mean(weight: Tensor, values: Tensor) -> Tensor:
    """Return the means (..., J) of `values` (..., N, J) with `weight` (..., N)."""
    if weight.ndim == 2:
        return (values.mT @ weight[..., None])[..., 0]
    # for a batch a product of matrices would copy: its rows lie in memory variables first
    return (values.movedim(-1, 0) * weight).sum(-1).movedim(0, -1)


def _covariance(weight: Tensor, deviation: Tensor) -> Tensor:
    """Return the covariances (..., A, A) of `deviation` (..., N, A) from the mean, with `weight` (..., N)."""
    axes = range(deviation.shape[-1])
    row, column = zip(*((i, j) for i in axes for j in axes if i <= j), strict=True)
    products = torch.stack([deviation[..., i] * deviation[..., j] for i, j in zip(row, column, strict=True)])
    moments = weighted_mean(weight, products.movedim(0, -1))
    place = {pair: n for n, pair in enumerate(zip(row, column, strict=True))}
    order = [place[min(i, j), max(i, j)] for i in axes for j in axes]
    covariance: Tensor = moments[..., order].unflatten(-1, (len(axes), len(axes)))
    return covariance


def _angle(vector: Tensor) -> Tensor:
    """Return the direction (...) of vectors (..., 2 or more) [rad]."""
    return torch.atan2(vector[..., 1], vector[..., 0])


def _circular_std(direction: Tensor) -> Tensor:
    """Return sqrt(-2 log R) of mean unit vectors (..., 2), at most pi [rad] (Mardia & Jupp 2000, sec. 2.3)."""
    squared = direction.square().sum(-1).clamp(torch.finfo(direction.dtype).tiny, 1.0)
    return (-squared.log()).sqrt().clamp_max(math.pi)
