"""How talkers move: what every trajectory gives, and what rooms, scenes and truth take."""

from typing import NamedTuple

import torch
from torch import Tensor


class Motion(NamedTuple):
    """Motion of talkers, sampled regularly; time is the first axis, and the batch may be empty.

    Attributes:
        position: (T, *batch, 3), of the mouth [m].
        velocity: (T, *batch, 3), of the mouth [m/s].
        body: (T, *batch), where the body faces, counter-clockwise from +x, in [-pi, pi) [rad].
        mouth: (T, *batch), where the mouth points: the head turns apart from the body [rad].
    """

    position: Tensor
    velocity: Tensor
    body: Tensor
    mouth: Tensor

    def talker(self, index: int) -> "Motion":
        """Return the motion of one of several talkers, the last axis of the batch."""
        return Motion(
            self.position[..., index, :], self.velocity[..., index, :], self.body[..., index], self.mouth[..., index]
        )

    def every(self, at: Tensor) -> "Motion":
        """Return the motion at the samples `at` (K,) only."""
        return Motion(*(column[at] for column in self))

    @staticmethod
    def stack(talkers: "list[Motion]") -> "Motion":
        """Return talkers of one length side by side, along a new last axis of the batch."""
        columns = zip(*talkers, strict=True)
        position, velocity, body, mouth = columns
        return Motion(
            torch.stack(position, -2), torch.stack(velocity, -2), torch.stack(body, -1), torch.stack(mouth, -1)
        )
