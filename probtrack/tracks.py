"""The track of a talker: what a filter believes, frame by frame."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class Track(NamedTuple):
    """Where a talker is and how sure that is, time first.

    Attributes:
        time: (T,) [s], the middle of each frame; from 0 where the filter knows no recording.
        position: Mean of the cloud (T, *batch, A) [m].
        std: Its standard deviation on each axis (T, *batch, A) [m].
        heading: Where the talker looks (T, *batch) [rad]: the direction of the mean velocity unless the
            motion model has a heading.
        ess: Effective sample size (T, *batch), before resampling.
        log_evidence: log p(y_t | y_1:t-1) of each frame (T, *batch).
        lost: Whether no particle was possible (T, *batch) bool: such a frame keeps the prediction and
            adds nothing to the evidence.
        azimuth: Mean direction from the array's centre (T, *batch) [rad], if the filter has an origin.
        std_azimuth: Circular standard deviation of the direction (T, *batch) [rad], likewise.
        speech: P(speech) (T, *batch), where there was audio.
        mode: Probability of each of S motion models (T, *batch, S), if the filter switches between some.
        covariance: Covariance of the position (T, *batch, A, A) [m^2]; its diagonal is `std` squared.
        std_heading: Circular standard deviation of the heading (T, *batch) [rad], of models that have a heading.
    """

    time: Tensor
    position: Tensor
    std: Tensor
    heading: Tensor
    ess: Tensor
    log_evidence: Tensor
    lost: Tensor
    azimuth: Tensor | None = None
    std_azimuth: Tensor | None = None
    speech: Tensor | None = None
    mode: Tensor | None = None
    covariance: Tensor | None = None
    std_heading: Tensor | None = None

    @property
    def num_frames(self) -> int:
        """Number of frames T."""
        return self.time.shape[0]


def join(tracks: Sequence[Track]) -> Track:
    """Return consecutive pieces of one track as one."""

    def joined(*pieces: Tensor | None) -> Tensor | None:
        present = [piece for piece in pieces if piece is not None]
        return torch.cat(present) if present else None

    return Track._make(joined(*column) for column in zip(*tracks, strict=True))
