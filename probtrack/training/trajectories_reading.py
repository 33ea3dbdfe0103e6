"""Trajectories from tables: tracks that were measured, and the truth of simulated scenes."""

from collections.abc import Sequence
from pathlib import Path

from probtrack._checks import as_positive
from probtrack.errors import InputError
from probtrack.simulation import read_manifest
from probtrack.simulation.data_set import MANIFEST
from probtrack.simulation.scene_folder import TRUTH
from probtrack.track_files import SUFFIXES, TrackTable, read_tracks
from probtrack.training.trajectories import Trajectory, check_trajectory

MAX_SPEED = 12.5
"""Nobody runs faster [m/s]: a quicker change of position is a slip of the measurement."""


def read_trajectories(
    source: str | Path | Sequence[str | Path], *, axes: int = 2, max_speed: float = MAX_SPEED
) -> list[Trajectory]:
    """Read the trajectories of files or folders: every track of every table.

    Tables have the columns time, x, y and perhaps z and track, and any others; an empty cell or a NaN in x, y or z is a
    gap, and rows may be missing. A folder stands for its tables; that of a scene for the truth of its talkers; that
    of a data set, or of scene folders, for the truths of all scenes, once where a scene was recorded at several levels
    of noise. Errors count the rows of each track from 1, without the header.

    Args:
        source: A file or folder, or several.
        axes: Coordinates that are read, 2 (x and y) or 3.
        max_speed: What nobody exceeds from one position to the next [m/s].

    Raises:
        InputError: for what is not there or no table, columns that are missing, times that do not increase, fewer than
            two positions, infinite ones, and jumps, by file and row.
    """
    if axes not in (2, 3):
        raise InputError(f"axes must be 2 or 3, got {axes}")
    limit = float(as_positive(max_speed, "max_speed"))
    sources = [source] if isinstance(source, str | Path) else list(source)
    found = []
    for path in [path for one in sources for path in _files(Path(one))]:
        tables = read_tracks(path)
        for table in tables:
            trajectory = _trajectory(table, axes, several=len(tables) > 1)
            check_trajectory(trajectory, limit)
            found.append(trajectory)
    if not found:
        raise InputError("trajectories must be named: no file was given")
    return found


def _files(path: Path) -> list[Path]:
    """Return the tables that `path` stands for."""
    if not path.is_dir():
        return [path]
    if (path / TRUTH).exists():
        return [path / TRUTH]
    if (path / MANIFEST).exists():
        scenes = {row["scene"]: path / row["folder"] / TRUTH for row in reversed(read_manifest(path))}
        return sorted(scenes.values())
    tables = sorted(file for file in path.iterdir() if file.suffix in SUFFIXES) or sorted(path.glob(f"*/{TRUTH}"))
    if not tables:
        raise InputError(f"{path}: holds no table of trajectories ({', '.join(SUFFIXES)}) and no scene with {TRUTH}")
    return tables


def _trajectory(table: TrackTable, axes: int, *, several: bool) -> Trajectory:
    position = table.position
    if position is None or position.shape[-1] < axes:
        wanted = " and ".join(["x, y", "z"] if axes == 3 else ["x", "y"])
        raise InputError(f"{table.path}: a trajectory needs columns {wanted}, got {', '.join(table.columns)}")
    number = table.get("track")
    name = f"{table.path}, track {number[0]:g}" if several and number is not None else str(table.path)
    return Trajectory(name, str(table.path), table.time, position[:, :axes])
