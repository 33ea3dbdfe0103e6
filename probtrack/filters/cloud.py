"""What is reported of weighted particle clouds: means, spreads and directions."""

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from probtrack.dynamics import Dynamics
from probtrack.filters.resampling import effective_sample_size
from probtrack.tracks import Track


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
    log_weight, lost = torch.stack(clouds.log_weight), torch.stack(clouds.lost)
    row = log_weight.exp()[..., None, :]  # (T, *batch, 1, N)
    kinematics = dynamics.kinematics(torch.stack(clouds.state))
    mean = row @ kinematics.position
    variance = row @ (kinematics.position - mean).square()
    if kinematics.modelled_heading is None:
        heading = _angle(row @ kinematics.velocity)
    else:
        cosine, sine = kinematics.modelled_heading.cos(), kinematics.modelled_heading.sin()
        heading = _angle(row @ torch.stack([cosine, sine], -1))
    azimuth, std_azimuth = None, None
    if origin is not None:
        direction = row @ normalize(kinematics.position[..., :2] - origin[:2], dim=-1)
        azimuth, std_azimuth = _angle(direction), _circular_std(direction[..., 0, :])
    return Track(
        time=log_weight.new_zeros(len(lost)),
        position=mean[..., 0, :],
        std=variance[..., 0, :].sqrt(),
        heading=heading,
        ess=effective_sample_size(log_weight),
        log_evidence=torch.stack(clouds.joint).logsumexp(-1).masked_fill(lost, 0.0),
        lost=lost,
        azimuth=azimuth,
        std_azimuth=std_azimuth,
    )


def _angle(vector: Tensor) -> Tensor:
    """Return the direction (...) of vectors (..., 1, 2 or more) [rad]."""
    return torch.atan2(vector[..., 0, 1], vector[..., 0, 0])


def _circular_std(direction: Tensor) -> Tensor:
    """Return sqrt(-2 log R) of mean unit vectors (..., 2), at most pi [rad] (Mardia & Jupp 2000, sec. 2.3)."""
    squared = direction.square().sum(-1).clamp(torch.finfo(direction.dtype).tiny, 1.0)
    return (-squared.log()).sqrt().clamp_max(math.pi)
