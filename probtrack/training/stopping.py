"""When to stop: no better validation loss for long."""

from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import EarlyStopping

from probtrack._checks import as_non_negative, check_int


class Patience(EarlyStopping):
    """Ends a fit whose validation loss has not become lower for some epochs; without validation it never does.

    Args:
        patience: Validations without a lower loss, one an epoch unless the trainer is told otherwise.
        min_delta: By how much the loss must be lower to count.
    """

    def __init__(self, patience: int = 20, min_delta: float = 0.0) -> None:
        as_non_negative(min_delta, "min_delta")
        super().__init__("val/loss", min_delta=min_delta, patience=check_int(patience, "patience", low=1), strict=False)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        # what had stopped when it was killed, or is called again, has nothing to go on with
        trainer.should_stop = trainer.should_stop or self.wait_count >= self.patience

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict | {"patience": self.patience})  # that of now, if it was changed
