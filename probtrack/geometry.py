"""Where the microphones are and where a talker can be: arrays, regions and angles."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from probtrack._checks import check_event, check_int
from probtrack._files import read_yaml
from probtrack.errors import InputError, ShapeError

SPEED_OF_SOUND = 343.0
"""Speed of sound in air at 20 degrees Celsius [m/s]."""

_FARTHEST = 100.0  # m; positions beyond this are taken for another unit
_SPARSEST = 10.0  # m; so are microphones all of which are farther apart: 5 mm written as 5 is missed, 12 mm is not


def wrap_angle(angle: Tensor) -> Tensor:
    """Return `angle` [rad] wrapped to [-pi, pi), any shape.

    >>> bool(torch.isclose(wrap_angle(torch.tensor(7.0)), torch.tensor(7.0 - 2 * math.pi)))
    True
    """
    turns = torch.floor(angle * (0.5 / math.pi) + 0.5)  # a remainder would take ten times as long
    wrapped = torch.sub(angle, turns, alpha=2 * math.pi).clamp_min(-math.pi)
    return torch.where(wrapped >= math.pi, -math.pi, wrapped)  # rounding may miss either end


def azimuth(position: Tensor, origin: Tensor) -> Tensor:
    """Return the angle of `position` (..., A) seen from `origin` (A,), counter-clockwise from +x [rad].

    Shape:
        Returns (...) in [-pi, pi]; with A = 3 the height plays no part.
    """
    offset = position - origin
    return torch.atan2(offset[..., 1], offset[..., 0])


@dataclass(frozen=True, eq=False)
class MicrophoneArray:
    """Microphones of known position, in metres.

    Args:
        positions: (M, A) [m], A = 2 (all in one plane) or 3, at least two microphones, all distinct.
        name: Said in messages and plots.

    Raises:
        InputError: for a wrong shape, values that are not finite, duplicates, or lengths that cannot be
            metres (beyond 100 m, or all microphones more than 10 m apart).

    >>> array = MicrophoneArray([[0.0, 0.1], [0.0, -0.1], [0.2, 0.0]])
    >>> array.pairs.tolist()
    [[0, 1], [0, 2], [1, 2]]
    """

    positions: Tensor
    name: str = "array"

    def __init__(self, positions: Tensor | Sequence[Sequence[float]], name: str = "array") -> None:
        object.__setattr__(self, "positions", _checked_positions(positions, name))
        object.__setattr__(self, "name", name)

    @property
    def num_microphones(self) -> int:
        """Number of microphones M."""
        return len(self.positions)

    @property
    def axes(self) -> int:
        """Number of spatial axes A, 2 or 3."""
        return self.positions.shape[1]

    @property
    def centre(self) -> Tensor:
        """Mean of the microphone positions (A,) [m]: the point azimuths are seen from."""
        centre: Tensor = self.positions.mean(0)
        return centre

    @property
    def pairs(self) -> Tensor:
        """All pairs of microphones, (P, 2) with first < second, P = M (M - 1) / 2."""
        return torch.tensor(list(itertools.combinations(range(self.num_microphones), 2)))

    @property
    def pair_distances(self) -> Tensor:
        """Distance between the two microphones of each pair, (P,) [m]."""
        first, second = self.positions[self.pairs].unbind(1)
        distances: Tensor = torch.linalg.vector_norm(first - second, dim=-1)
        return distances

    @property
    def diameter(self) -> float:
        """Largest distance between two microphones [m]."""
        return float(self.pair_distances.max())

    def delays(self, points: Tensor, speed_of_sound: float = SPEED_OF_SOUND) -> Tensor:
        """Return the time that sound takes from `points` (..., A) to each microphone, (..., M) [s]."""
        if points.shape[-1] != self.axes:
            raise ShapeError(f"points must have shape (..., {self.axes}), got {tuple(points.shape)}")
        positions = self.positions.to(points)
        distances: Tensor = torch.linalg.vector_norm(points[..., None, :] - positions, dim=-1)
        return distances / speed_of_sound

    def select(self, channels: Sequence[int]) -> "MicrophoneArray":
        """Return the array of the microphones `channels` (0-based) in that order."""
        absent = [c for c in channels if not 0 <= c < self.num_microphones]
        if absent:
            raise InputError(f"{self.name}: no microphone {absent[0] + 1}: there are {self.num_microphones}")
        return MicrophoneArray(self.positions[list(channels)], self.name)

    @classmethod
    def from_yaml(cls, path: str | Path) -> "MicrophoneArray":
        """Read an array from a YAML file with `positions: [[x, y, z], ...]` in metres and maybe a `name`."""
        content = _read_yaml(path, "array file")
        if "positions" not in content:
            raise InputError(f"{path}: an array file needs 'positions: [[x, y, z], ...]' in metres")
        try:
            return cls(content["positions"], str(content.get("name", Path(path).stem)))
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    def to_yaml(self, path: str | Path, region: "Region | None" = None) -> None:
        """Write the array, and the region it listens to if given, as YAML that `from_yaml` reads back."""
        content: dict[str, Any] = {"name": self.name, "positions": _decimal(self.positions)}
        if region is not None:
            low, high = _decimal(torch.tensor([region.low, region.high], dtype=torch.float64))
            content["region"] = {"low": low, "high": high}
        Path(path).write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None), encoding="utf-8")


@dataclass(frozen=True)
class Region:
    """Axis-aligned box where a talker can be.

    Args:
        low: Smallest coordinate on each axis [m].
        high: Largest coordinate on each axis [m].

    >>> Region(low=(0.0, 0.0), high=(2.0, 3.0)).contains(torch.tensor([[1.0, 1.0], [1.0, 4.0]])).tolist()
    [True, False]
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.low) != len(self.high) or len(self.low) not in (2, 3):
            raise InputError(f"region: low and high need 2 or 3 values each, got {self.low} and {self.high}")
        for axis, low, high in zip("xyz", self.low, self.high, strict=False):
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise InputError(f"region: low must be below high on axis {axis}, got {low} and {high}")

    @property
    def axes(self) -> int:
        """Number of spatial axes, 2 or 3."""
        return len(self.low)

    @property
    def volume(self) -> float:
        """Area [m^2] or volume [m^3]."""
        return math.prod(high - low for low, high in zip(self.low, self.high, strict=True))

    def contains(self, points: Tensor) -> Tensor:
        """Return whether each of `points` (..., A) lies inside or on the border, (...) bool."""
        check_event(points, (self.axes,), "points")
        inside = (points >= points.new_tensor(self.low)) & (points <= points.new_tensor(self.high))
        return inside.all(-1)

    def from_unit(self, unit: Tensor) -> Tensor:
        """Map `unit` (..., A), uniform in [0, 1)^A, to points uniform in the region."""
        low, high = unit.new_tensor(self.low), unit.new_tensor(self.high)
        return low + (high - low) * unit

    def grid(self, num_points: int) -> Tensor:
        """Return the cell centres (G, A) of a regular grid of about `num_points` nearly cubic cells.

        Every point stands for the same share of the region, so that a mean over them is a mean over it.
        """
        ticks = [(torch.arange(n) + 0.5) / n for n in self._steps(num_points)]
        return self.from_unit(torch.stack(torch.meshgrid(*ticks, indexing="ij"), -1).reshape(-1, self.axes))

    def cell_size(self, num_points: int) -> Tensor:
        """Return the edges (A,) of a cell of that grid [m]."""
        edges = zip(self.low, self.high, self._steps(num_points), strict=True)
        return torch.tensor([(high - low) / steps for low, high, steps in edges])

    def _steps(self, num_points: int) -> list[int]:
        cell = (self.volume / check_int(num_points, "num_points", low=1)) ** (1 / self.axes)
        return [max(1, round((high - low) / cell)) for low, high in zip(self.low, self.high, strict=True)]

    def plane(self) -> "Region":
        """Return the region seen from above: its x and y axes."""
        return Region(self.low[:2], self.high[:2])

    @classmethod
    def around(cls, array: MicrophoneArray, margin: float = 3.0) -> "Region":
        """Return the box that reaches `margin` [m] beyond the array to every side."""
        low, high = array.positions.amin(0) - margin, array.positions.amax(0) + margin
        return cls(tuple(low.tolist()), tuple(high.tolist()))

    @classmethod
    def from_yaml(cls, path: str | Path) -> "Region | None":
        """Read `region: {low: [...], high: [...]}` from an array file; None where it has none."""
        content = _read_yaml(path, "array file").get("region")
        if content is None:
            return None
        try:
            return cls(_numbers(content["low"]), _numbers(content["high"]))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: region must be {{low: [x, y, z], high: [x, y, z]}}: {error}") from None


def shipped_arrays() -> dict[str, Path]:
    """Return the array files that ship with probtrack, by name."""
    folder = Path(str(resources.files("probtrack") / "arrays"))
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def _numbers(values: Any) -> tuple[float, ...]:
    if not isinstance(values, list):  # the text "12" is not the numbers 1 and 2
        raise TypeError(f"{values!r} is not a list")
    return tuple(map(float, values))


def _decimal(positions: Tensor) -> list[list[float]]:
    """Return positions as decimals of a micrometre, so that float32 does not print its binary tail."""
    return [[round(value, 6) for value in row] for row in positions.tolist()]


def _read_yaml(path: str | Path, what: str) -> dict[str, Any]:
    content = read_yaml(path, what)
    if not isinstance(content, dict):
        raise InputError(f"{path}: {what} must be a YAML mapping, got {type(content).__name__}")
    return content


def _checked_positions(positions: Tensor | Sequence[Sequence[float]], name: str) -> Tensor:
    try:
        x = torch.as_tensor(positions, dtype=torch.get_default_dtype()).detach().clone()
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise InputError(f"{name}: positions must be a list of [x, y] or [x, y, z] numbers") from None
    if x.ndim != 2 or x.shape[0] < 2 or x.shape[1] not in (2, 3):
        raise InputError(f"{name}: positions must have shape (M, 2) or (M, 3) with M >= 2, got {tuple(x.shape)}")
    if not x.isfinite().all():
        raise InputError(f"{name}: positions must be finite")
    # not by matrix products, which lose a close pair far from the origin
    distances = torch.cdist(x, x, compute_mode="donot_use_mm_for_euclid_dist").fill_diagonal_(math.inf)
    if distances.min() < 1e-4:
        first, second = divmod(int(distances.argmin()), x.shape[0])
        raise InputError(f"{name}: microphones {first + 1} and {second + 1} have the same position")
    if x.abs().max() > _FARTHEST:
        raise InputError(
            f"{name}: a position of {float(x.abs().max()):g} m is beyond {_FARTHEST:g} m: positions are in "
            "metres (were they millimetres?)"
        )
    if distances.min() > _SPARSEST:
        raise InputError(
            f"{name}: no two microphones are within {_SPARSEST:g} m, the nearest are {float(distances.min()):g} m "
            "apart: positions are in metres (were they millimetres?)"
        )
    return x
