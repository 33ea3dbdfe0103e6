"""The training step that all fits share. Imports Lightning, so that it is loaded when it is first named only."""

import abc
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from probtrack._checks import as_positive, check_int
from probtrack.errors import NotFiniteError
from probtrack.training.losses import Loss, Outcome
from probtrack.training.physical import physical_values
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
    """

    def __init__(self, model: nn.Module, loss: Loss, *, learning_rate: float = 0.02, seed: int = 0) -> None:
        super().__init__()
        self.model, self.loss = model, loss
        self.learning_rate = float(as_positive(learning_rate, "learning_rate"))
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
        return self.loss(self.outcome(batch, self.seeds(batch, draw)))

    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        loss = self.run_loss(batch, self.current_epoch).mean()
        if not loss.isfinite():
            self._refuse(f"the loss is {loss.item()}", batch, batch_idx)
        self.log("train/loss", loss.detach(), prog_bar=True)
        self._batch = (batch, batch_idx)
        return loss

    def validation_step(self, batch: Any, batch_idx: int) -> None:  # noqa: ARG002
        runs = self.run_loss(batch, _VALIDATION)
        self.log("val/loss", runs.mean(), prog_bar=True, batch_size=len(runs), sync_dist=True)

    def on_after_backward(self) -> None:
        """Refuse gradients that are not finite before they reach a parameter."""
        for name, parameter in self.model.named_parameters():
            if parameter.grad is not None and not parameter.grad.isfinite().all():
                self._refuse(f"the gradient of {name} is not finite", *self._batch)

    def on_train_batch_end(self, *_: Any) -> None:
        """Log the physical values of all parameters that are single numbers."""
        values = {name: value for name, value in physical_values(self.model).items() if value.ndim == 0}
        self.log_dict({f"parameter/{name}": value for name, value in values.items()})

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.Adam([p for p in self.parameters() if p.requires_grad], lr=self.learning_rate)

    def _refuse(self, what: str, batch: Any, batch_idx: int) -> None:
        broken = [name for name, p in self.model.named_parameters() if not p.isfinite().all()]
        where = f"epoch {self.current_epoch}, batch {batch_idx} (sequences {', '.join(map(str, self.numbers(batch)))})"
        also = f"; parameters that are not finite: {', '.join(broken)}" if broken else ""
        raise NotFiniteError(f"{what} in {where}{also}. Try a smaller learning_rate, or gradient_clip_val")
