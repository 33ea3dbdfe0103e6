"""What a run writes after each epoch, so that it can go on after any end. Nothing in a file is ever executed."""

import pickle
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from probtrack.errors import InputError

try:
    from lightning import LightningModule, Trainer
    from lightning.pytorch.callbacks import Checkpoint
except ImportError:
    raise ImportError("training needs Lightning: pip install 'probtrack[train]'") from None

LAST, BEST = "last.ckpt", "best.ckpt"


class Checkpoints(Checkpoint):
    """Writes `last.ckpt` after every epoch, and `best.ckpt` after those whose validation loss is the lowest so far.

    Files hold tensors and plain values only: parameters, the optimiser's state, and how far training is. Each is
    written beside its place and moved there, so that a killed run leaves the one before.

    Args:
        folder: Of the files.

    Attributes:
        best: Lowest validation loss so far; infinite before there is one.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.best = float("inf")
        self._latest = float("inf")

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        if not trainer.sanity_checking and "val/loss" in trainer.callback_metrics:
            self._latest = float(trainer.callback_metrics["val/loss"])

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: ARG002
        improved = self._latest < self.best
        if improved:
            self.best = self._latest
        for name in (BEST, LAST) if improved else (LAST,):
            beside = self.folder / f"{name}.tmp"  # Lightning's own move is a copy if the folder is on another disk
            trainer.save_checkpoint(beside, weights_only=False)  # all that a run goes on with
            if trainer.is_global_zero:
                beside.replace(self.folder / name)

    def state_dict(self) -> dict[str, Any]:
        return {"best": self.best}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.best = state_dict["best"]


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Return the content of a checkpoint: tensors and plain values, without running anything that it says.

    Raises:
        InputError: for a file that cannot be read, is empty, truncated or no checkpoint, or wants to run code.
    """
    path = Path(path)
    if path.is_file() and path.stat().st_size == 0:
        raise InputError(f"{path}: the checkpoint is empty")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of protocols of files that are refused
            content = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise InputError(f"{path}: cannot read the checkpoint: {error.strerror}") from None
    except pickle.UnpicklingError as error:
        why = str(error).partition("WeightsUnpickler error: ")[2].partition("\n")[0]
        raise InputError(
            f"{path}: is no checkpoint of tensors and plain values, and nothing else is loaded ({why or 'no pickle'})"
        ) from None
    except (RuntimeError, EOFError, ValueError, KeyError, IndexError):
        raise InputError(f"{path}: the checkpoint is truncated, or it is no checkpoint") from None
    if not isinstance(content, dict) or not isinstance(content.get("state_dict"), dict):
        raise InputError(f"{path}: is no checkpoint of a fit: it has no state_dict")
    missing = [name for name in ("epoch", "global_step") if not isinstance(content.get(name), int)]
    if missing:
        raise InputError(f"{path}: is no checkpoint of a fit: it has no {' and no '.join(missing)}")
    strange = [str(name) for name, value in content["state_dict"].items() if not isinstance(value, torch.Tensor)]
    if strange:
        raise InputError(f"{path}: is no checkpoint of a fit: no tensors are {', '.join(strange)}")
    return content


def check_checkpoint(path: str | Path, module: nn.Module) -> dict[str, Any]:
    """Return the content of a checkpoint of this very `module`.

    Raises:
        InputError: as `read_checkpoint`, and for one of another module: it names the parameters that differ.
    """
    content = read_checkpoint(path)
    there, here = content["state_dict"], module.state_dict()
    shapes = [
        f"{name} {tuple(there[name].shape)} instead of {tuple(here[name].shape)}"
        for name in here.keys() & there.keys()
        if there[name].shape != here[name].shape
    ]
    differ = {"missing": here.keys() - there.keys(), "unexpected": there.keys() - here.keys(), "other shape": shapes}
    said = [f"{what} {', '.join(sorted(names))}" for what, names in differ.items() if names]
    if said:
        raise InputError(f"{path}: is the checkpoint of another model: {'; '.join(said)}")
    trained = [len(group["params"]) for state in content.get("optimizer_states", ()) for group in state["param_groups"]]
    wanted = sum(parameter.requires_grad for parameter in module.parameters())
    if trained and sum(trained) != wanted:
        raise InputError(f"{path}: is of a model with {sum(trained)} trained parameters, this one has {wanted}")
    return content


def load_weights(path: str | Path, module: nn.Module) -> dict[str, Any]:
    """Set the parameters of `module` to those of a checkpoint, and return its content."""
    content = check_checkpoint(path, module)
    state: dict[str, Tensor] = content["state_dict"]
    module.load_state_dict(state)
    return content
