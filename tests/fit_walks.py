"""A small model to fit: steps of a Gaussian random walk, seen as they are; and ways for its data to go wrong."""

import os
import signal

import torch
from lightning import LightningDataModule
from torch import nn
from torch.distributions import Normal
from torch.utils.data import DataLoader, Dataset

from probtrack.training import Fit, Loss, SceneSampler

MEAN, STD = (0.3, -0.2), 2.0


class Walk(nn.Module):
    """Steps N(drift, scale^2) of walks of two kinds."""

    def __init__(self, scale):
        super().__init__()
        self.log_scale = nn.Parameter(torch.tensor(float(scale)).log())
        self.drift = nn.Parameter(torch.zeros(2))
        self.logit_initial = nn.Parameter(torch.zeros(2))


class Given(Loss):
    """The outcome is the loss already."""

    def __call__(self, outcome):
        return outcome


class WalkFit(Fit):
    """Unlikeliness of the steps, with a term of the seeds' own numbers, as a filter has.

    Args:
        scale: Initial standard deviation of a step.
        learning_rate: Step of Adam.
        seed: Of the term.
        width: Coordinates of a step.
        steep: Add |drift|, whose gradient at 0 is not a number.
    """

    def __init__(
        self, scale: float = 1.0, learning_rate: float = 0.05, seed: int = 0, width: int = 2, steep: bool = False
    ) -> None:
        super().__init__(Walk(scale), Given(), learning_rate=learning_rate, seed=seed)
        self.steep = steep
        if width != 2:
            self.model.drift = nn.Parameter(torch.zeros(width))

    def numbers(self, batch):
        return batch[0].tolist()

    def outcome(self, batch, seeds):
        steps = batch[1]
        noise = torch.stack([torch.randn((), generator=torch.Generator().manual_seed(int(s))) for s in seeds])
        log_p = Normal(self.model.drift, self.model.log_scale.exp(), validate_args=False).log_prob(steps)
        log_kind = self.model.logit_initial.log_softmax(-1)[batch[0] % 3 // 2]
        length = self.model.drift.square().sum().sqrt() if self.steep else 0.0
        return length - log_p.mean((1, 2)) - log_kind / 20 + 0.1 * noise * self.model.log_scale


class Steps(Dataset):
    """Recording number and its steps, a little different in every draw; it may kill the process or break."""

    def __init__(self, steps, killed, broken):
        self.steps, self.killed, self.broken = steps, killed, broken

    def __len__(self):
        return len(self.steps)

    def __getitem__(self, index):
        number, draw = index
        if self.killed == draw and number == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        nan = float("nan") if self.broken == draw and number == 0 else 0.0
        return number, self.steps[number] * (1 + 0.01 * draw) + nan


class WalkData(LightningDataModule):
    """Walks of 20 steps.

    Args:
        count: Walks.
        batch_size: Walks in a batch.
        validate: Whether there are walks to validate with.
        killed: Draw in whose midst the process is killed.
        broken: Draw of which a walk is NaN.
    """

    def __init__(
        self,
        count: int = 12,
        batch_size: int = 4,
        validate: bool = True,
        killed: int | None = None,
        broken: int | None = None,
    ) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(1)
        steps = torch.tensor(MEAN) + STD * torch.randn(count + 5, 20, 2, generator=generator)
        self.train, self.val = Steps(steps[5:], killed, broken), Steps(steps[:5], None, None)
        self.batch_size, self.validate = batch_size, validate

    def train_dataloader(self):
        return DataLoader(self.train, self.batch_size, sampler=SceneSampler(len(self.train), 3))

    def val_dataloader(self):
        return DataLoader(self.val, 3, sampler=[(number, 0) for number in range(5)]) if self.validate else []
