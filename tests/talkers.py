"""Talkers made by hand for tests of metrics."""

import torch

from probtrack.metrics import Talkers


def at(position=None, *, dt=0.1, **columns):
    """Talkers of frames `dt` [s] apart; columns as lists or tensors, with the axis of talkers."""
    columns = {name: torch.as_tensor(value, dtype=torch.get_default_dtype()) for name, value in columns.items()}
    if position is not None:
        columns["position"] = torch.as_tensor(position, dtype=torch.get_default_dtype())
    frames = len(next(iter(columns.values())))
    return Talkers(torch.arange(frames) * dt, **columns)


def one(position, **more):
    """One talker at `position` (T, *batch, A)."""
    return at(
        torch.as_tensor(position)[..., None, :], **{name: torch.as_tensor(x)[..., None] for name, x in more.items()}
    )


def off(error, axes=2):
    """A track of `error` (T, *batch) [m] beside a talker who stands still, and the truth."""
    error = torch.as_tensor(error, dtype=torch.get_default_dtype())
    place = torch.tensor([1.3, -0.4, 0.9])[:axes].repeat(*error.shape, 1)
    direction = torch.tensor([2.0, -1.0, 2.0])[:axes]
    return one(place + error[..., None] * direction / direction.norm()), one(place)
