"""What is reported of weighted particle clouds: means, spreads and directions."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from probtrack.dynamics import Dynamics
from probtrack.tracks import Track

_NEAREST = 1e-12  # m: a particle nearer to the origin than that has no direction


class Clouds(NamedTuple):
    """Weighted clouds of some frames, kept until their means are taken together.

    Attributes:
        state: Particles (*batch, N, D) of each frame.
        log_weight: Normalised log weights (*batch, N).
        joint: Log weights before they were normalised (*batch, N).
        lost: Whether no particle was possible (*batch).
    """

    state: list[Tensor]
    log_weight: list[Tensor]
    joint: list[Tensor]
    lost: list[Tensor]


def summary(clouds: Clouds, dynamics: Dynamics, origin: Tensor | None) -> Track:
    """Return the track of `clouds`, with azimuths about `origin` (A,) if there is one; its time is zero."""
    log_weight, lost = _stacked(clouds.log_weight), _stacked(clouds.lost)
    weight = log_weight.exp()  # (T, *batch, N)
    # states lie in memory variables first: stacked like that, and turned without a copy
    states = _stacked([state.movedim(-1, 0) for state in clouds.state]).movedim(1, -1)
    kinematics, mode = dynamics.kinematics(states), dynamics.mode(states)
    mean = _mean(weight, kinematics.position)
    variance = _mean(weight, (kinematics.position - mean[..., None, :]).square_())
    if kinematics.modelled_heading is None:
        heading = _angle(_mean(weight, kinematics.velocity))
    else:
        cosine, sine = kinematics.modelled_heading.cos(), kinematics.modelled_heading.sin()
        heading = _angle(_mean(weight, torch.stack([cosine, sine], -1)))
    azimuth, std_azimuth = None, None
    if origin is not None:
        offset = kinematics.position[..., :2] - origin[:2]
        direction = _mean(weight, offset * offset.square().sum(-1, keepdim=True).clamp_min(_NEAREST**2).rsqrt())
        azimuth, std_azimuth = _angle(direction), _circular_std(direction)
    return Track(
        time=log_weight.new_zeros(len(lost)),
        position=mean,
        std=variance.sqrt(),
        heading=heading,
        ess=1 / _mean(weight, weight[..., None])[..., 0],
        log_evidence=_evidence(clouds, log_weight).masked_fill(lost, 0.0),
        lost=lost,
        azimuth=azimuth,
        std_azimuth=std_azimuth,
        mode=None if mode is None else _mean(weight, mode),
    )


def _evidence(clouds: Clouds, log_weight: Tensor) -> Tensor:
    """Return what the log weights (T, *batch, N) were normalised by, read off the largest ones.

    A second logsumexp would cost as much as all the rest of the summary.
    """
    return _stacked(clouds.joint).amax(-1) - log_weight.amax(-1)


def _stacked(frames: list[Tensor]) -> Tensor:
    """Return `frames` with time as the first axis; one frame of a large cloud is not worth a copy."""
    return torch.stack(frames) if len(frames) > 1 else frames[0][None]


def _mean(weight: Tensor, values: Tensor) -> Tensor:
    """Return the means (..., J) of `values` (..., N, J) with `weight` (..., N)."""
    if weight.ndim == 2:
        return (values.mT @ weight[..., None])[..., 0]
    # for a batch a product of matrices would copy: its rows lie in memory variables first
    return (values.movedim(-1, 0) * weight).sum(-1).movedim(0, -1)


def _angle(vector: Tensor) -> Tensor:
    """Return the direction (...) of vectors (..., 2 or more) [rad]."""
    return torch.atan2(vector[..., 1], vector[..., 0])


def _circular_std(direction: Tensor) -> Tensor:
    """Return sqrt(-2 log R) of mean unit vectors (..., 2), at most pi [rad] (Mardia & Jupp 2000, sec. 2.3)."""
    squared = direction.square().sum(-1).clamp(torch.finfo(direction.dtype).tiny, 1.0)
    return (-squared.log()).sqrt().clamp_max(math.pi)
