"""`probtrack fit`: parameters of a model from data, as a configuration file says."""

import importlib.metadata
import logging
import sys
import warnings
from argparse import ArgumentError
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml
from jsonargparse import Namespace

from probtrack.cli import flags
from probtrack.cli.config_errors import in_one_line
from probtrack.errors import InputError
from probtrack.training import Fit, write_parameters
from probtrack.training.checkpoints import BEST, LAST, Checkpoints, check_checkpoint, load_weights
from probtrack.training.reporting import EpochLines, FitProgress, MetricsTable
from probtrack.training.stopping import Patience

try:
    from lightning import LightningDataModule, Trainer, seed_everything
    from lightning.fabric.utilities.exceptions import MisconfigurationException
    from lightning.fabric.utilities.rank_zero import rank_zero_only
    from lightning.pytorch.cli import LightningArgumentParser, LRSchedulerCallable
    from lightning.pytorch.loggers import TensorBoardLogger
    from torch.multiprocessing.spawn import ProcessRaisedException
except ImportError:
    raise ImportError("probtrack fit needs Lightning: pip install 'probtrack[train]'") from None

_TRAINER = {
    "max_epochs": 100,
    "gradient_clip_val": 1.0,
    "enable_model_summary": False,
    "num_sanity_val_steps": 0,
    "log_every_n_steps": 1,
}
_CONFIG, _CHECKPOINTS, _RESULT = "config.yaml", "checkpoints", "parameters.yaml"


class FitParser(LightningArgumentParser):
    """Lightning's parser, whose configuration file may come first without `--config`."""

    def parse_args(  # type: ignore[override]  # classes within classes are parsed by parsers of this class too
        self, args: Sequence[str], namespace: Namespace | None = None, env: bool | None = None, defaults: bool = True
    ) -> Namespace:
        with_flag = ["--config", *args] if args and not args[0].startswith("-") else list(args)
        return super().parse_args(with_flag, namespace, env, defaults)


def parser() -> FitParser:
    """Return the command's parser."""
    by = FitParser(
        prog="probtrack fit",
        usage="probtrack fit CONFIG.yaml -o RUN [options]",
        description="Fit the parameters of a model to data (docs: Fitting).",
        exit_on_error=False,
        allow_abbrev=False,
    )
    by.add_argument("-c", "--config", action="config", help="YAML file with any of these settings")
    by.add_argument("-o", "--out", type=str, required=True, help="folder of the run")
    by.add_argument("--ckpt_path", type=str | None, help="go on from: last, best, or the path of a checkpoint")
    by.add_argument("--seed_everything", type=int, default=0, help="seed of torch's own random numbers")
    by.add_argument(
        "--lr_scheduler", type=LRSchedulerCallable | None, help="class of a learning rate schedule and its arguments"
    )
    by.add_argument("--model", type=Fit, required=True, help="class of the fit and its arguments")
    by.add_argument("--data", type=LightningDataModule, required=True, help="class of the data and its arguments")
    by.add_lightning_class_args(Patience, "early_stopping")
    by.add_lightning_class_args(Trainer, "trainer")
    by.set_defaults({f"trainer.{name}": value for name, value in _TRAINER.items()})
    return by


def run(argv: Sequence[str]) -> int:
    """Run the command; returns its exit code."""
    file = Path(argv[0]) if argv and not argv[0].startswith("-") else None
    with _importable(file), _plain_words():
        by = parser()
        config = _parsed(by, argv)
        out = Path(config.out)
        check_run_output(out, config.ckpt_path)
        seed_everything(config.seed_everything, workers=True, verbose=False)
        made = _made(by, config)
        checkpoint = _checkpoint(out, config.ckpt_path)
        step = 0 if checkpoint is None else check_checkpoint(checkpoint, made.model)["global_step"]
        trainer = _trainer(made, out, step)
        _write_config(out, by.dump(config, skip_none=False))
        made.model.schedule = made.lr_scheduler
        _fit(trainer, made.model, made.data, checkpoint)
        if trainer.is_global_zero:
            chosen = yaml.safe_load(by.dump(config, skip_default=True))  # of Lightning's many settings
            _say(_result(out, made.model, yaml.safe_load(by.dump(config)) | {"trainer": chosen.get("trainer", {})}))
    return 0


def _parsed(by: FitParser, argv: Sequence[str]) -> Namespace:
    try:
        return by.parse_args(argv)
    except (ArgumentError, ValueError, OSError) as error:
        raise InputError(in_one_line(str(error))) from None


def _made(by: FitParser, config: Namespace) -> Namespace:
    """Return the objects that a configuration describes; what their constructors refuse is the user's mistake."""
    try:
        made: Namespace = by.instantiate(config)
    except ValueError as error:
        raise InputError(in_one_line(str(error))) from None
    return made


def check_run_output(out: Path, ckpt_path: str | None) -> None:
    """Raise `InputError` where `out` holds a run that is not to be gone on with, or something else."""
    if not _first_process():
        return
    try:
        if out.exists() and not out.is_dir():
            raise InputError(f"{out}: is not a folder")
        if (out / _CHECKPOINTS / LAST).exists() and ckpt_path is None:
            raise InputError(f"{out}: holds a run: name another folder, or go on with it by --ckpt_path last")
        if out.exists() and any(out.iterdir()) and not (out / _CONFIG).exists():
            raise InputError(f"{out}: is not empty and holds no run: name another folder")
    except OSError as error:
        raise InputError(f"{out}: cannot write the run: {error.strerror}") from None


def _first_process() -> bool:
    """Return whether this is the process, of several that Lightning or a cluster starts, which writes."""
    return bool(getattr(rank_zero_only, "rank", 0) == 0)


def _checkpoint(out: Path, ckpt_path: str | None) -> Path | None:
    """Return the file that a user means by `last`, `best` or a path; None to begin."""
    if ckpt_path not in ("last", "best"):
        return None if ckpt_path is None else Path(ckpt_path)
    path = out / _CHECKPOINTS / {"last": LAST, "best": BEST}[ckpt_path]
    if path.exists():
        return path
    if ckpt_path == "best":
        raise InputError(f"{path}: there is none: the run has no validation, or no epoch")
    flags.warn("fit", f"{path}: there is none: the run begins with its first epoch")
    return None


def _trainer(made: Namespace, out: Path, step: int) -> Trainer:
    settings = made.trainer.as_dict() if isinstance(made.trainer, Namespace) else dict(made.trainer)
    progress = FitProgress() if sys.stderr.isatty() else EpochLines()
    own = [made.early_stopping, MetricsTable(out), Checkpoints(out / _CHECKPOINTS), progress]
    settings["callbacks"] = [*(settings["callbacks"] or []), *own]
    settings["default_root_dir"] = settings["default_root_dir"] or str(out)
    settings["enable_progress_bar"] = isinstance(progress, FitProgress)
    if settings["logger"] is None:
        settings["logger"] = TensorBoardLogger(
            out, name="", version="tensorboard", default_hp_metric=False, purge_step=step or None
        )
    try:
        return Trainer(**settings)
    except (MisconfigurationException, ValueError, TypeError) as error:
        raise InputError(f"trainer: {error}") from None


def _fit(trainer: Trainer, model: Fit, data: LightningDataModule, checkpoint: Path | None) -> None:
    try:
        trainer.fit(model, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    except MisconfigurationException as error:
        raise InputError(f"trainer: {error}") from None
    except ProcessRaisedException as error:  # of one process of several
        kind, _, said = str(error).strip().splitlines()[-1].partition(": ")
        if not kind.startswith("probtrack.errors."):
            raise
        raise InputError(said) from None
    except SystemExit:
        if trainer.interrupted:
            raise KeyboardInterrupt from None
        raise


def _write_config(out: Path, text: str) -> None:
    if not _first_process():
        return
    try:
        (out / _CHECKPOINTS).mkdir(parents=True, exist_ok=True)
        (out / _CONFIG).write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{out}: cannot write the run: {error.strerror}") from None


def _result(out: Path, model: Fit, config: dict[str, Any]) -> str:
    """Write the parameters of the best epoch, or without validation of the last; returns a line that says so."""
    folder = out / _CHECKPOINTS
    if not (folder / LAST).exists():
        raise InputError(f"{out}: no epoch was finished, so that there is nothing to write")
    last = check_checkpoint(folder / LAST, model)
    chosen = folder / BEST if (folder / BEST).exists() else folder / LAST
    content = load_weights(chosen, model)
    loss = content["callbacks"]["Checkpoints"]["best"]
    made_by = {
        "probtrack": importlib.metadata.version("probtrack"),
        "epochs": last["epoch"] + 1,
        "epoch": content["epoch"] + 1,
        "val_loss": loss if chosen.name == BEST else None,
        "config": config,
    }
    write_parameters(out / _RESULT, model.model, made_by)
    of = f"validation loss {loss:.4g} of epoch {content['epoch'] + 1}" if chosen.name == BEST else "no validation"
    return f"{out / _RESULT}: {last['epoch'] + 1} epochs, {of}"


@contextmanager
def _importable(file: Path | None) -> Iterator[None]:
    """Let a configuration name classes of modules beside it, or in the working directory."""
    before, folders = list(sys.path), [Path.cwd()] if file is None else [file.resolve().parent, Path.cwd()]
    sys.path += [str(folder) for folder in folders if str(folder) not in sys.path]
    try:
        yield
    finally:
        sys.path[:] = before


@contextmanager
def _plain_words() -> Iterator[None]:
    """Say Lightning's warnings in a line each, and its advice not at all."""
    logs = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric")]
    before = [log.level for log in logs]
    for log in logs:
        log.setLevel(logging.WARNING)
    try:
        with warnings.catch_warnings():
            for what in ("does not have many workers", "across ranks is zero"):  # both are as they should be
                warnings.filterwarnings("ignore", f".*{what}.*")
            for kind in (DeprecationWarning, FutureWarning):  # of libraries among each other
                warnings.simplefilter("ignore", kind)
            warnings.showwarning = lambda message, *_: flags.warn("fit", " ".join(str(message).split()))
            yield
    finally:
        for log, level in zip(logs, before, strict=True):
            log.setLevel(level)


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
