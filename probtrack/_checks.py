"""Argument checks shared by every room."""

import torch
from torch import Tensor

from probtrack.errors import InputError, ShapeError


def check_event(x: Tensor, shape: tuple[int, ...], name: str) -> None:
    """Raise `ShapeError` unless `x` ends with `shape`."""
    if tuple(x.shape[x.ndim - len(shape) :]) != shape:
        raise ShapeError(f"{name} must have shape (..., {', '.join(map(str, shape))}), got {tuple(x.shape)}")


def as_positive(value: float | Tensor, name: str) -> Tensor:
    """Return `value` as a float tensor, or raise `InputError` unless it is finite and > 0."""
    x = _as_number(value, name)
    if not (torch.isfinite(x) & (x > 0)).all():
        raise InputError(f"{name} must be finite and positive, got {value}")
    return x


def as_non_negative(value: float | Tensor, name: str) -> Tensor:
    """Return `value` as a float tensor, or raise `InputError` unless it is finite and >= 0."""
    x = _as_number(value, name)
    if not (torch.isfinite(x) & (x >= 0)).all():
        raise InputError(f"{name} must be finite and not negative, got {value}")
    return x


def check_int(value: int, name: str, *, low: int) -> int:
    """Return `value`, or raise `InputError` unless it is an integer of at least `low`."""
    if isinstance(value, bool) or not isinstance(value, int) or value < low:
        raise InputError(f"{name} must be an integer of at least {low}, got {value}")
    return value


def _as_number(value: float | Tensor, name: str) -> Tensor:
    try:
        return torch.as_tensor(value, dtype=torch.get_default_dtype())
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"{name} must be a number, got {value!r}") from None
