"""The training step that all fits share. Imports Lightning, so that it is loaded when it is first named only."""

import abc
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from probtrack._checks import as_positive, check_int
from probtrack.errors import NotFiniteError
from probtrack.parameters import physical_summary
from probtrack.training.losses import Loss, Outcome
from probtrack.training.seeds import seed_of

try:
    from lightning import LightningModule
except ImportError:
    raise ImportError("training needs Lightning: pip install 'probtrack[train]'") from None

_VALIDATION = 2**31  # a draw that no epoch is


class Fit(LightningModule, abc.ABC):
    """A model in training: its loss over a batch, the optimiser, and a guard against what is not finite.

    Random numbers of a run follow from `seed`, the epoch and the number of its sequence: not from the batch it sits
    in, the process that works on it, or when training was interrupted. Validation has the same ones in every epoch.

    Args:
        model: What is trained.
        loss: What is made small.
        learning_rate: Step of Adam, in units of unconstrained parameters: 0.01 changes a rate by about a hundredth.
        seed: Of the filter's random numbers.

    Attributes:
        schedule: What makes a scheduler of the learning rate for the optimiser; None for a rate that stays.
    """

    schedule: Callable[[torch.optim.Optimizer], torch.optim.lr_scheduler.LRScheduler] | None = None

    def __init__(self, model: nn.Module, loss: Loss, *, learning_rate: float = 0.02, seed: int = 0) -> None:
        super().__init__()
        self.model, self.loss = model, loss
        as_positive(learning_rate, "learning_rate")
        self.learning_rate = float(learning_rate)
        self.seed = check_int(seed, "seed", low=0)

    @abc.abstractmethod
    def outcome(self, batch: Any, seeds: Tensor) -> Outcome:
        """Return what the filter makes of `batch` with one seed a run (*batch)."""

    @abc.abstractmethod
    def numbers(self, batch: Any) -> Sequence[int]:
        """Return a number for each sequence of `batch`, its own whatever batch it sits in."""

    def seeds(self, batch: Any, draw: int) -> Tensor:
        """Return the seeds of the runs over `batch` (B,) in the epoch `draw`."""
        return torch.tensor([seed_of(self.seed, draw, number) for number in self.numbers(batch)])

    def run_loss(self, batch: Any, draw: int) -> Tensor:
        """Return the loss of each run over `batch` (B,)."""
        return self.loss_of(self.outcome(batch, self.seeds(batch, draw)))

    def loss_of(self, outcome: Outcome) -> Tensor:
        """Return what is made small for each run (*batch)."""
        return self.loss(outcome)

    def log_outcome(self, outcome: Outcome) -> None:
        """Log more than the loss of a validation batch; nothing unless a fit has something to say."""

    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        runs = self.run_loss(batch, self.current_epoch)
        loss = runs.mean()
        if not loss.isfinite():
            self._refuse(f"the loss is {loss.item()}", batch, batch_idx)
        self.log(
            "train/loss",
            loss.detach(),
            prog_bar=True,
            on_step=False,
            on_epoch=True,
            batch_size=len(runs),
            sync_dist=True,
        )
        self._batch = (batch, batch_idx)
        return loss

    def on_validation_epoch_start(self) -> None:
        self._validated: dict[tuple[int, int], float] = {}

    def validation_step(self, batch: Any, batch_idx: int, dataloader_idx: int = 0) -> None:
        outcome = self.outcome(batch, self.seeds(batch, _VALIDATION))
        runs = self.loss_of(outcome)
        if not runs.isfinite().all():
            self._refuse(f"the validation loss is {runs.mean().item()}", batch, batch_idx)
        keys = [(dataloader_idx, number) for number in self.numbers(batch)]
        self._validated.update(zip(keys, runs.tolist(), strict=True))
        self.log_outcome(outcome)

    def on_validation_epoch_end(self) -> None:
        """Log the mean loss of the validation sequences: each once, though several processes fill up their shares."""
        parts = [self._validated]
        if self.trainer.world_size > 1:
            parts = [{} for _ in range(self.trainer.world_size)]
            torch.distributed.all_gather_object(parts, self._validated)
        losses = {key: loss for part in parts for key, loss in part.items()}
        self.log("val/loss", math.fsum(losses.values()) / len(losses), sync_dist=True)

    def on_after_backward(self) -> None:
        """Refuse gradients that are not finite before they reach a parameter."""
        for name, parameter in self.model.named_parameters():
            if parameter.grad is not None and not parameter.grad.isfinite().all():
                self._refuse(f"the gradient of {name} is not finite", *self._batch)

    def on_train_start(self) -> None:
        """Let schedules that wait for the validation loss hear it at the end of each epoch, before the checkpoint.

        Lightning tells them after it, and a run that goes on would have forgotten one.
        """
        for config in self.trainer.lr_scheduler_configs:
            if config.reduce_on_plateau:
                epochs = self.trainer.check_val_every_n_epoch or 1
                config.interval, config.frequency = "step", epochs * int(self.trainer.num_training_batches)

    def on_train_epoch_end(self) -> None:
        """Log the physical values of all parameters, and of tables their range."""
        values = {f"parameter/{name}": value for name, value in physical_summary(self.model).items()}
        self.log_dict(values, sync_dist=True)

    def configure_optimizers(self) -> Any:
        optimizer = torch.optim.Adam([p for p in self.parameters() if p.requires_grad], lr=self.learning_rate)
        if self.schedule is None:
            return optimizer
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": self.schedule(optimizer), "monitor": "val/loss"}}

    def _refuse(self, what: str, batch: Any, batch_idx: int) -> None:
        # the logarithm of a probability of 0 is a parameter as good as any
        broken = [name for name, p in self.model.named_parameters() if p.isnan().any() or p.isposinf().any()]
        numbers = ", ".join(map(str, self.numbers(batch)))
        where = f"epoch {self.current_epoch + 1}, batch {batch_idx + 1} (sequences {numbers})"
        also = f"; parameters that are not finite: {', '.join(broken)}" if broken else ""
        raise NotFiniteError(f"{what} in {where}{also}. Try a smaller learning_rate, or gradient_clip_val")
