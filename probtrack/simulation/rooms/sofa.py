"""Impulse responses in SOFA files: HDF5 as AES69 lays it out."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from probtrack.errors import InputError
from probtrack.simulation.rooms.responses import Responses

_EAR = 0.09  # m, from the middle of a head to either ear


def load_sofa(path: str | Path, *, clockwise: bool = False) -> Responses:
    """Return the impulse responses of a SOFA file with one listener who stays, and one source a measurement.

    Positions are Cartesian, in the coordinates of the source positions: those of the receivers are turned and moved
    with the listener. Two receivers without a place are taken for ears, 0.09 m to the left and right of the middle.

    Args:
        path: The file.
        clockwise: The azimuths of the sources are counted clockwise, against the standard, as in some files.

    Raises:
        ImportError: without h5py.
        InputError: for a file that cannot be read, or another layout.

    References:
        AES69-2020, "AES standard for file exchange - Spatial acoustic data file format". All
        conventions of data type FIR, such as SimpleFreeFieldHRIR and SingleRoomSRIR, where sources are not emitters.
    """
    try:
        import h5py
    except ImportError:
        raise ImportError("SOFA files need h5py: pip install 'probtrack[simulation]'") from None
    try:
        with h5py.File(str(path), "r") as file:
            return _responses(file, clockwise)
    except (OSError, KeyError) as error:
        raise InputError(f"{path}: cannot read SOFA file: {' '.join(str(error).split())}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _responses(file: Any, clockwise: bool) -> Responses:
    samples = _values(file, "Data.IR")
    if samples.ndim != 3:
        raise InputError(f"Data.IR must have shape (measurements, receivers, samples), got {tuple(samples.shape)}")
    rate = _values(file, "Data.SamplingRate").reshape(-1)
    if (rate != rate[0]).any():
        raise InputError("Data.SamplingRate must be the same for all measurements")
    count, receivers, _ = samples.shape
    sources = _cartesian(file, "SourcePosition").expand(count, 3)
    if clockwise:
        sources = sources * sources.new_tensor([1.0, -1.0, 1.0])
    return Responses(
        samples=_delayed(samples, file),
        positions=sources,
        microphones=_receivers(file, receivers),
        fs=round(float(rate[0])),
    )


def _values(file: Any, name: str) -> Tensor:
    if name not in file:
        raise InputError(f"{name} is missing")
    return torch.from_numpy(file[name][()].astype("float64"))


def _cartesian(file: Any, name: str) -> Tensor:
    """Return (rows, 3) [m] of a variable whose attribute `Type` says how it is written; angles are in degrees."""
    values = _values(file, name)
    values = values.reshape(len(values), 3, -1)[..., 0]  # receivers have a third axis: the measurement
    kind = file[name].attrs.get("Type", b"cartesian")
    kind = (kind.decode() if isinstance(kind, bytes) else str(kind)).lower()
    if kind == "cartesian":
        return values
    if kind != "spherical":
        raise InputError(f"{name} must be cartesian or spherical, got {kind}")
    azimuth, elevation, radius = values[:, 0].deg2rad(), values[:, 1].deg2rad(), values[:, 2]
    level = radius * elevation.cos()
    return torch.stack([level * azimuth.cos(), level * azimuth.sin(), radius * elevation.sin()], -1)


def _receivers(file: Any, count: int) -> Tensor:
    """Return the places (R, 3) of the receivers in the room: theirs are said relative to the listener."""
    places = _cartesian(file, "ReceiverPosition") if "ReceiverPosition" in file else torch.zeros(count, 3).double()
    if len(places) != count:
        raise InputError(f"ReceiverPosition must have {count} rows, got {len(places)}")
    if count == 2 and not (places[0] != places[1]).any():
        places = torch.tensor([[0.0, _EAR, 0.0], [0.0, -_EAR, 0.0]], dtype=torch.float64)
    ahead = _constant(file, "ListenerView", (1.0, 0.0, 0.0))
    up = _constant(file, "ListenerUp", (0.0, 0.0, 1.0))
    ahead = ahead / torch.linalg.vector_norm(ahead)
    left = torch.linalg.cross(up, ahead)
    left = left / torch.linalg.vector_norm(left)
    axes = torch.stack([ahead, left, torch.linalg.cross(ahead, left)])  # rows: the listener's x, y and z
    return places @ axes + _constant(file, "ListenerPosition", (0.0, 0.0, 0.0))


def _constant(file: Any, name: str, default: tuple[float, float, float]) -> Tensor:
    if name not in file:
        return torch.tensor(default, dtype=torch.float64)
    rows = _cartesian(file, name)
    if (rows - rows[0]).abs().max() > 1e-6:
        raise InputError(f"{name} must be the same for all measurements: the microphones stay where they are")
    return rows[0]


def _delayed(samples: Tensor, file: Any) -> Tensor:
    """Return the responses (M, R, N), later by `Data.Delay` [samples], which some files leave out of them."""
    if "Data.Delay" not in file:
        return samples
    delay = _values(file, "Data.Delay").expand(samples.shape[:2])
    if not delay.any():
        return samples
    size = samples.shape[-1] + int(delay.max().ceil()) + 1
    cycles = torch.fft.rfftfreq(size, dtype=torch.float64) * delay[..., None]
    shift = torch.polar(torch.ones_like(cycles), -2 * torch.pi * cycles)
    shifted: Tensor = torch.fft.irfft(torch.fft.rfft(samples, size) * shift, size)
    return shifted
