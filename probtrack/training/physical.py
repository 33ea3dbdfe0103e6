"""Parameters as the values that people think in: a rate rather than its logarithm."""

from torch import Tensor, nn


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


def physical_values(module: nn.Module) -> dict[str, Tensor]:
    """Return the trainable parameters of `module` by their physical names, without gradient."""
    named = [(name, p.detach()) for name, p in module.named_parameters() if p.requires_grad]
    return dict(physical(name, value) for name, value in named)
