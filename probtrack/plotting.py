"""Pictures of tracks: position and direction against time, and the room from above (extra `report`)."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from probtrack._files import check_suffix, check_writable
from probtrack.geometry import MicrophoneArray, Region
from probtrack.track_files import TrackTable

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PICTURE_SUFFIXES = (".png", ".pdf", ".svg")
_COLOURS = ("#1764ab", "#d9572b", "#2e8b57", "#7b4aa0", "#b8860b", "#444444")
_TRUTH: dict[str, Any] = {"color": "black", "lw": 1.2, "ls": (0, (4, 2)), "label": "truth", "zorder": 5}


def check_picture(path: str | Path) -> None:
    """Raise `InputError` unless a picture can be written to `path`."""
    check_suffix(Path(path), "a picture", PICTURE_SUFFIXES)
    check_writable(Path(path))


def plot_tracks(
    tracks: Sequence[TrackTable],
    output: str | Path,
    *,
    truth: TrackTable | None = None,
    array: MicrophoneArray | None = None,
    region: Region | None = None,
) -> None:
    """Draw `tracks` to a picture: x, y and azimuth with bands of one standard deviation, speech, and the room.

    Args:
        tracks: One or more, named by their files.
        output: Picture file: .png, .pdf or .svg.
        truth: Drawn dashed.
        array: Its microphones are drawn in the room.
        region: The room's outline.

    Raises:
        ImportError: without matplotlib, with the line that installs it.
        InputError: for a picture that cannot be written.
    """
    check_picture(output)
    figure, by_time, room = _canvas()
    for table, colour in zip(tracks, _COLOURS * (1 + len(tracks) // len(_COLOURS)), strict=False):
        _draw_track(table, by_time, room, colour)
    if truth is not None:
        _draw_truth(truth, by_time, room)
    if array is not None:
        x, y = array.positions[:, 0], array.positions[:, 1]
        room.plot(x, y, "o", mfc="white", mec="black", ms=5, label="microphones")
    if region is not None:
        (x0, y0), (x1, y1) = region.low[:2], region.high[:2]
        room.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], color="0.6", lw=1)
    _finish(by_time, room)
    figure.savefig(output, dpi=120)


def _canvas() -> tuple[Any, dict[str, "Axes"], "Axes"]:
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError("plots need matplotlib: pip install 'probtrack[report]'") from None
    # Figure alone, without pyplot: nothing is registered globally and no display is asked for
    figure = Figure(figsize=(14, 8), layout="constrained")
    panels: Any = figure.subfigures(1, 2, width_ratios=(1.35, 1))
    left, right = panels
    axes = left.subplots(4, 1, sharex=True, height_ratios=(3, 3, 3, 1.4))
    names = ("x", "y", "azimuth", "speech")
    labels = ("x [m]", "y [m]", "azimuth [°]", "P(speech)")
    for axis, label in zip(axes, labels, strict=True):
        axis.set_ylabel(label)
        axis.grid(color="0.9")
    axes[-1].set_xlabel("time [s]")
    return figure, dict(zip(names, axes, strict=True)), right.subplots()


def _draw_track(table: TrackTable, by_time: dict[str, "Axes"], room: "Axes", colour: str) -> None:
    for axis in "xy":
        if axis in table.columns:
            _draw_band(by_time[axis], table.time, table.columns[axis], table.get(f"std_{axis}"), colour)
    azimuth = table.get("azimuth")
    if azimuth is not None:
        spread = table.get("std_azimuth")
        time, degrees, *std = _cut(table.time, azimuth.rad2deg(), *([] if spread is None else [spread.rad2deg()]))
        _draw_band(by_time["azimuth"], time, degrees, std[0] if std else None, colour, label=table.path.stem)
    speech = table.get("speech")
    if speech is not None:
        by_time["speech"].fill_between(table.time, speech, color=colour, alpha=0.35, lw=0)
    if table.position is not None:
        x, y = table.position[:, 0], table.position[:, 1]
        room.plot(x, y, color=colour, lw=1.3, label=table.path.stem)
        room.plot(x[-1:], y[-1:], "s", color=colour, ms=5)


def _draw_truth(truth: TrackTable, by_time: dict[str, "Axes"], room: "Axes") -> None:
    for axis in "xy":
        if axis in truth.columns:
            by_time[axis].plot(truth.time, truth.columns[axis], **_TRUTH)
    azimuth, speech = truth.get("azimuth"), truth.get("speech")
    if azimuth is not None:
        by_time["azimuth"].plot(*_cut(truth.time, azimuth.rad2deg()), **_TRUTH)
    if speech is not None:
        by_time["speech"].plot(truth.time, speech, **_TRUTH)
    if truth.position is not None:
        room.plot(truth.position[:, 0], truth.position[:, 1], **_TRUTH)


def _draw_band(
    axis: "Axes", time: Tensor, value: Tensor, std: Tensor | None, colour: str, label: str | None = None
) -> None:
    axis.plot(time, value, color=colour, lw=1.2, label=label)
    if std is not None:
        axis.fill_between(time, value - std, value + std, color=colour, alpha=0.2, lw=0)


def _cut(time: Tensor, degrees: Tensor, *more: Tensor) -> Tensor:
    """Return the columns with a gap between the two rows where the angle wraps around."""
    columns = torch.stack([time, degrees, *more])
    wraps = (degrees.diff().abs() > 180).nonzero()[:, 0] + 1
    gap = columns.new_full((len(columns), 1), math.nan)
    return torch.cat([torch.cat([piece, gap], 1) for piece in columns.tensor_split(wraps, dim=1)], 1)


def _finish(by_time: dict[str, "Axes"], room: "Axes") -> None:
    by_time["speech"].set_ylim(0, 1.05)
    low, high = by_time["azimuth"].get_ylim()
    by_time["azimuth"].set_ylim(max(low, -185), min(high, 185))
    if high - low > 180:
        by_time["azimuth"].set_yticks(range(-180, 181, 90))
    room.set_aspect("equal", adjustable="datalim")
    room.set(xlabel="x [m]", ylabel="y [m]", title="from above")
    room.grid(color="0.9")
    room.set_axisbelow(True)
    # files of azimuth alone have nothing in the room, but a name there
    shown = {
        label: handle
        for axis in (by_time["azimuth"], room)
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    if shown:
        room.legend(shown.values(), shown.keys(), loc="upper right", framealpha=0.9)
