"""What the tests of switching share: heard positions."""

from typing import NamedTuple

import torch

from probtrack.likelihoods import GaussianPosition


class Heard(NamedTuple):
    """Positions (T, *batch, 2), and the speech (T, *batch) that a chain listens to."""

    position: torch.Tensor
    speech: torch.Tensor


class Measured(GaussianPosition):
    """Likelihood of what is `Heard`."""

    def prepare(self, observations):
        return super().prepare(observations.position)
