"""Parameters as the values that people think in: a rate rather than its logarithm."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor, nn

from probtrack._files import read_yaml
from probtrack.errors import InputError

_SUM = 1e-4  # by which rows of probabilities may miss 1: many numbers of float32, each rounded


def physical(name: str, value: Tensor) -> tuple[str, Tensor]:
    """Return name and value of what the unconstrained parameter `name` stands for.

    A name says its map: `log_` is undone by exp; `logit_` by the logistic function for one number, and by softmax over
    the last axis for rows of them. All others are what they say.

    >>> import torch
    >>> physical("dynamics.axis_model.process.log_rate", torch.tensor(0.0))
    ('dynamics.axis_model.process.rate', tensor(1.))
    """
    path, _, last = name.rpartition(".")
    prefix = f"{path}." if path else ""
    if last.startswith("log_"):
        return prefix + last.removeprefix("log_"), value.exp()
    if last.startswith("logit_"):
        return prefix + last.removeprefix("logit_"), value.sigmoid() if value.ndim == 0 else value.softmax(-1)
    return name, value


def unconstrained(name: str, value: Tensor) -> Tensor:
    """Return the unconstrained parameter `name` that stands for the physical `value`, of rows their logarithms.

    >>> import torch
    >>> unconstrained("log_rate", torch.tensor(1.0))
    tensor(0.)
    """
    last = name.rpartition(".")[2]
    if last.startswith("log_"):
        return value.log()
    if last.startswith("logit_"):
        return value.logit() if value.ndim == 0 else value.log()
    return value


def physical_values(module: nn.Module) -> dict[str, Tensor]:
    """Return the trainable parameters of `module` by their physical names, without gradient."""
    named = [(name, p.detach()) for name, p in module.named_parameters() if p.requires_grad]
    return dict(physical(name, value) for name, value in named)


def physical_summary(module: nn.Module) -> dict[str, float]:
    """Return a number for each trainable parameter: its physical value, or how far the values of a table range.

    Tables, such as weights of frequencies, are named with `_range` after them.
    """
    values = physical_values(module).items()
    return {
        name if value.ndim == 0 else f"{name}_range": float(value if value.ndim == 0 else value.max() - value.min())
        for name, value in values
    }


def write_parameters(path: str | Path, module: nn.Module, made_by: Mapping[str, Any]) -> None:
    """Write the trainable parameters of `module` to a YAML file, in physical values.

    Args:
        path: Of the file.
        module: Whose parameters are written.
        made_by: What made them, plain values: kept beside them for people to read.
    """
    values = {name: _shortest(value.cpu().numpy()) for name, value in physical_values(module).items()}
    text = yaml.safe_dump({"parameters": values, "made_by": dict(made_by)}, sort_keys=False, allow_unicode=True)
    Path(path).write_text(text, encoding="utf-8")


def read_parameters(path: str | Path, module: nn.Module, *, partly: bool = False) -> None:
    """Set the parameters of `module` to the physical values in a file of `write_parameters`.

    Args:
        path: Of the file.
        module: Whose parameters are set.
        partly: Whether the file may leave out some of them, which stay as they are.

    Raises:
        InputError: for a file that cannot be read, names that the module does not have, trainable parameters that the
            file does not have (unless `partly`), and values that cannot be. The module is then as it was.
    """
    values, named = _values(path), dict(module.named_parameters())
    of = {physical(name, parameter.detach())[0]: name for name, parameter in named.items()}
    wanted = physical_values(module)
    missing = set() if partly else wanted.keys() - values.keys()
    unknown = values.keys() - of.keys()
    if missing or unknown:
        differ = {"missing": missing, "unknown": unknown}
        said = [f"{what} {', '.join(sorted(map(str, names)))}" for what, names in differ.items() if names]
        raise InputError(f"{path}: parameters of another model: {'; '.join(said)}")
    new = {of[name]: _parameter(f"{path}: {name}", of[name], value, named[of[name]]) for name, value in values.items()}
    with torch.no_grad():
        for name, value in new.items():
            named[name].copy_(value)


def parameter_names(path: str | Path) -> list[str]:
    """Return the physical names of the parameters in a file of `write_parameters`, or raise `InputError`."""
    return [str(name) for name in _values(path)]


def _values(path: str | Path) -> dict[Any, Any]:
    content = read_yaml(path, "parameter file")
    if not isinstance(content, dict) or not isinstance(content.get("parameters"), dict):
        raise InputError(f"{path}: a parameter file must have 'parameters', names with their values")
    values: dict[Any, Any] = content["parameters"]
    return values


def _parameter(what: str, name: str, value: object, like: Tensor) -> Tensor:
    """Return the unconstrained parameter for a `value` of a file, or raise `InputError`."""
    try:
        if isinstance(value, bool):
            raise TypeError
        given = torch.tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"{what} must be a number, or rows of as many numbers each, got {value!r}") from None
    if given.shape != like.shape:
        raise InputError(f"{what} must have shape {tuple(like.shape)}, got {tuple(given.shape)}")
    must = _requirement(name, given, unconstrained(name, given).to(like.dtype))
    if must:
        raise InputError(f"{what} must be {must}, got {value}")
    return unconstrained(name, given).to(like.dtype)


def _requirement(name: str, given: Tensor, parameter: Tensor) -> str | None:
    """Return what physical values must be that these are not."""
    last = name.rpartition(".")[2]
    if last.startswith("logit_") and given.ndim > 0:  # a probability of 0 is one that stays 0
        law = (given >= 0).all() and ((given.sum(-1) - 1).abs() <= _SUM).all()
        return None if law else "probabilities with sum 1 in each row"
    if parameter.isfinite().all():
        return None
    return {"log": "finite and positive", "logit": "between 0 and 1"}.get(last.partition("_")[0], "finite")


def _shortest(values: "np.ndarray[Any, Any]") -> Any:
    """Return numbers, in lists for each axis, that have no more digits than they need: 0.1, not 0.10000000149."""
    return float(str(values[()])) if values.ndim == 0 else [_shortest(row) for row in values]
