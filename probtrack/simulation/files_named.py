"""Files that a scene file names: found from its own folder, wherever the command is run."""

from pathlib import Path
from typing import Any

from probtrack.geometry import shipped_arrays

_FIELDS = ("array", "array_file", "file", "folder", "path")  # of the parts of a scene


def with_files_found(content: Any, folder: Path) -> Any:
    """Return what a file in `folder` says, its relative paths made absolute where there is such a file.

    A path is taken from the folder of the file first, then from the working directory. An array that ships goes by its
    name.
    """
    if isinstance(content, list):
        return [with_files_found(item, folder) for item in content]
    if not isinstance(content, dict):
        return content
    return {key: _found(key, value, folder) for key, value in content.items()}


def _found(key: Any, value: Any, folder: Path) -> Any:
    if key not in _FIELDS or not isinstance(value, str):
        return with_files_found(value, folder)
    if key == "array" and value in shipped_arrays():
        return value
    for path in (folder / value, Path(value)):
        if path.is_file() or (key != "array" and path.is_dir()):
            return str(path.resolve())
    return value
