"""Responses that were computed once, on disk, for every later scene in the same room."""

import hashlib
import json
import os
import time
import uuid
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor

from probtrack.errors import InputError

FORMAT = 1
"""Of the files; a folder of another format is refused."""

_SCALE = 256.0  # keeps the tail of a response out of the half precision's coarse end
_STALE = 3600.0  # s, after which what a killed writer left is swept away

Node = tuple[int, int, int]


def default_cache() -> Path:
    """Return where responses are kept unless said otherwise: $PROBTRACK_CACHE, or the user's cache folder."""
    named = os.environ.get("PROBTRACK_CACHE")
    if named:
        return Path(named).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "probtrack" / "responses"


class ResponseCache:
    """Folder of responses, one sub-folder for everything that determines them, one file a place.

    Files come to their place whole, by a rename, so that several processes may write at once and one that is killed
    leaves nothing half done. Values are kept in half precision (66 dB below each sample).

    Args:
        folder: Made where it does not exist.

    Raises:
        InputError: where it cannot be written, or was written in another format.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        mark = self.folder / "FORMAT"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if not mark.exists():
                _write(mark, f"{FORMAT}\n".encode())
            written = mark.read_text(encoding="utf-8", errors="replace").strip()
            _sweep(self.folder)
        except OSError as error:
            raise InputError(f"{self.folder}: cannot use the cache of responses: {error.strerror or error}") from None
        if written != str(FORMAT):
            raise InputError(
                f"{self.folder}: the cache of responses has format {written[:20]!r}, this version of probtrack "
                f"reads {FORMAT}: delete the folder or name another"
            )

    def store(self, key: dict[str, Any]) -> "ResponseStore":
        """Return the responses of everything that `key` (plain values) determines."""
        text = json.dumps(key, sort_keys=True)
        folder = self.folder / hashlib.sha256(text.encode()).hexdigest()[:20]
        try:
            folder.mkdir(exist_ok=True)
            if not (folder / "key.yaml").exists():  # for people who wonder what a folder is
                _write(folder / "key.yaml", yaml.safe_dump(key, sort_keys=False).encode())
            _sweep(folder)
        except OSError as error:
            raise InputError(f"{folder}: cannot write the cache of responses: {error.strerror or error}") from None
        return ResponseStore(folder)


class ResponseStore:
    """Responses (C, M, L) of one room, by the place's index on its grid."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(self, node: Node) -> Tensor | None:
        """Return the responses of a place; None where there are none, or no longer any that can be read."""
        try:
            with self._path(node).open("rb") as file:
                return _unpacked(np.load(file, allow_pickle=False))
        except Exception:  # a damaged file makes numpy raise almost anything
            return None

    def has(self, node: Node) -> bool:
        """Return whether there is a file of a place's responses."""
        return self._path(node).exists()

    def put(self, node: Node, responses: Tensor) -> Tensor:
        """Keep the responses of a place; returns them as `get` will, in the precision of the file.

        Raises:
            InputError: where they cannot be written, as on a full disk.
        """
        packed = _packed(responses)
        path = self._path(node)
        unfinished = _unfinished(path)
        try:
            with unfinished.open("wb") as file:
                np.save(file, packed)
            unfinished.replace(path)
        except OSError as error:
            unfinished.unlink(missing_ok=True)
            raise InputError(f"{path}: cannot write the cache of responses: {error.strerror or error}") from None
        return _unpacked(packed)

    def _path(self, node: Node) -> Path:
        return self.folder / ("_".join(map(str, node)) + ".npy")


def rounded(responses: Tensor) -> Tensor:
    """Return responses in the precision of the cache, so that scenes are the same with and without one."""
    return _unpacked(_packed(responses))


def _packed(responses: Tensor) -> "np.ndarray[Any, np.dtype[np.float16]]":
    packed = (responses * _SCALE).to(torch.float16)
    if not packed.isfinite().all():
        raise AssertionError("a response is not finite, or too loud for its file")
    return packed.numpy()


def _unpacked(packed: "np.ndarray[Any, np.dtype[np.float16]]") -> Tensor:
    if packed.dtype != np.float16 or packed.ndim != 3 or not np.isfinite(packed).all():
        raise ValueError("not a file of responses")
    return torch.from_numpy(packed).float() / _SCALE


def _write(path: Path, content: bytes) -> None:
    unfinished = _unfinished(path)
    unfinished.write_bytes(content)
    unfinished.replace(path)


def _unfinished(path: Path) -> Path:
    """Return where a file is written before it comes to its place: for one thread of one process only."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")


def _sweep(folder: Path) -> None:
    for left in folder.glob(".*.tmp"):
        try:
            if time.time() - left.stat().st_mtime > _STALE:
                left.unlink()
        except OSError:
            continue  # another process swept it
