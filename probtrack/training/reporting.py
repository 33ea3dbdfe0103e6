"""What a fit tells while it runs: a bar or lines on standard error, and a table on disk."""

import csv
import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback, RichProgressBar
from lightning.pytorch.callbacks.progress.rich_progress import RichProgressBarTheme
from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, TextColumn, TimeRemainingColumn

from probtrack.parameters import physical_summary

_TABLE = "metrics.csv"


class FitProgress(RichProgressBar):
    """A bar with the losses and the physical values of the parameters as they are now."""

    def __init__(self) -> None:
        theme = RichProgressBarTheme(metrics_text_delimiter="  ", metrics_format=".4g")
        super().__init__(refresh_rate=4, theme=theme, console_kwargs={"stderr": True})
        self._loss: dict[str, float] = {}

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        self._loss = {"train/loss": float(outputs["loss"])}  # of the batch: the mean comes when the epoch ends
        super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)

    def configure_columns(self, trainer: Trainer) -> list[ProgressColumn]:  # noqa: ARG002
        named = TextColumn("{task.description}")
        return [named, BarColumn(bar_width=20), MofNCompleteColumn(), TimeRemainingColumn(compact=True)]

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict[str, Any]:
        return self._loss | _now(trainer, pl_module) | self._loss


class EpochLines(Callback):
    """One line an epoch, for a standard error that is no terminal."""

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.is_global_zero:
            said = [f"{name} {value:.4g}" for name, value in _now(trainer, pl_module).items()]
            sys.stderr.write(f"epoch {trainer.current_epoch + 1}/{trainer.max_epochs}: {', '.join(said)}\n")
            sys.stderr.flush()


class MetricsTable(Callback):
    """A CSV file with a row an epoch: what was logged, the learning rate and the physical values of the parameters.

    A run that goes on keeps the rows of the epochs before, and writes those anew that it does again.

    Args:
        folder: Where `metrics.csv` is written.
    """

    def __init__(self, folder: str | Path) -> None:
        self.path = Path(folder) / _TABLE
        self.rows: list[dict[str, Any]] = []

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        if trainer.global_step > 0 and self.path.exists():
            with self.path.open(newline="", encoding="utf-8") as file:
                self.rows = [row for row in csv.DictReader(file) if int(row["step"]) <= trainer.global_step]

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not trainer.is_global_zero:
            return
        rate = trainer.optimizers[0].param_groups[0]["lr"]
        logged = {name: float(value) for name, value in sorted(trainer.callback_metrics.items())}
        parameters = {f"parameter/{name}": value for name, value in physical_summary(pl_module.model).items()}  # type: ignore[arg-type]
        row = {"epoch": trainer.current_epoch + 1, "step": trainer.global_step, "learning_rate": rate}
        self.rows.append(row | logged | parameters)
        beside = self.path.with_suffix(".tmp")
        with beside.open("w", newline="", encoding="utf-8") as file:
            names = dict.fromkeys(name for row in self.rows for name in row)
            writer = csv.DictWriter(file, list(names))
            writer.writeheader()
            writer.writerows(self.rows)
        beside.replace(self.path)


def short_names(names: Iterable[str]) -> dict[str, str]:
    """Return each dotted name with as much of its end as tells it from the others.

    >>> short_names(["x.process.rate", "y.process.rate", "y.process.speed"])
    {'x.process.rate': 'x.process.rate', 'y.process.rate': 'y.process.rate', 'y.process.speed': 'speed'}
    """
    parts = {name: name.split(".") for name in names}
    ends = Counter(".".join(words[-count:]) for words in parts.values() for count in range(1, len(words) + 1))
    return {
        name: next((end for end in (".".join(w[-c:]) for c in range(1, len(w) + 1)) if ends[end] == 1), name)
        for name, w in parts.items()
    }


def _now(trainer: Trainer, fit: LightningModule) -> dict[str, float]:
    """Return the losses that are known and the physical values of the parameters, by short names."""
    losses = {name: float(trainer.callback_metrics[name]) for name in _LOSSES if name in trainer.callback_metrics}
    values = physical_summary(fit.model)  # type: ignore[arg-type]
    return losses | {short: values[name] for name, short in short_names(values).items()}


_LOSSES = ("train/loss", "val/loss")
