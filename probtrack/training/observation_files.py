"""Observations that were worked out once, on disk, for every later epoch and run."""

import hashlib
import inspect
import time
import types
import uuid
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

import probtrack
from probtrack.audio import FrontEnd, Observations
from probtrack.errors import InputError

FORMAT = 1
"""Of the files; part of their key, so that files of other formats are not found."""

_STALE = 3600.0  # s, after which what a killed writer left is swept away
_TORCHS_OWN = frozenset(vars(nn.Module()))
_MAX_HALF = torch.finfo(torch.float16).max


def front_end_key(front_end: FrontEnd, fs: int) -> str:
    """Return a hexadecimal name of everything about a front end that determines its observations.

    That is, of each of its modules, the class with the file that defines it, all attributes, parameters and buffers;
    the sampling rate `fs` [Hz]; and the versions of probtrack, torch and of the files' format.

    Raises:
        InputError: for a module with an attribute that is not numbers, text, tensors or collections of these.
    """
    digest = hashlib.sha256()
    for piece in (f"{FORMAT} {probtrack.__version__} {torch.__version__} {fs}".encode(), *_pieces(front_end)):
        digest.update(len(piece).to_bytes(8, "little"))
        digest.update(piece)
    return digest.hexdigest()[:20]


class ObservationFiles:
    """Observations of one front end at one rate, a file a recording, as `FOLDER/<front end>/<recording>.pt`.

    A recording is known by a hash of its file's bytes: unlike its size and date that survives a copy, sees when a
    scene was made anew in its place, and takes a small part of the time of reading the observations. Files come to
    their place whole, by a rename, so that several workers may write at once; one that cannot be read is as one that
    is not there. Correlations are kept in half precision (relative error at most 1/2048) and read as they are
    needed: a crop reads its own frames only.

    Args:
        key: Name of the front end, `front_end_key`.
        folder: Where; None for `observations` in the folder of each recording.
    """

    def __init__(self, key: str, folder: str | Path | None = None) -> None:
        self.key, self.folder = key, None if folder is None else Path(folder).expanduser()

    def path(self, recording: Path) -> Path:
        """Return where the observations of the sound file `recording` are kept."""
        try:
            with recording.open("rb") as file:
                name = hashlib.file_digest(file, "sha256").hexdigest()[:32]
        except OSError as error:
            raise InputError(f"{recording}: cannot read the recording: {error.strerror}") from None
        folder = recording.parent / "observations" if self.folder is None else self.folder
        return folder / self.key / f"{name}.pt"

    def get(self, path: Path) -> Observations | None:
        """Return what is kept at `path`, correlations in half precision; None where nothing can be read."""
        try:
            kept = torch.load(path, mmap=True, weights_only=True, map_location="cpu")
            gcc, speech = kept["gcc"], kept["speech"]
            whole = gcc.ndim == 3 and speech.shape == gcc.shape[:1] and gcc.dtype == torch.float16
        except Exception:  # a damaged file makes torch raise almost anything
            return None
        return Observations(gcc, speech) if whole else None

    def put(self, path: Path, observations: Observations) -> Observations:
        """Keep `observations` of one recording; returns them as `get` will.

        Raises:
            InputError: where they cannot be written, as on a full disk, or are too large for half precision.
        """
        kept = halved(observations)
        unfinished = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            _sweep(path.parent)
            with unfinished.open("wb") as file:
                torch.save(kept._asdict(), file)
            unfinished.replace(path)
        except (OSError, RuntimeError) as error:  # RuntimeError: torch's, of a disk that gets full
            with suppress(OSError):
                unfinished.unlink(missing_ok=True)
            what = (error.strerror if isinstance(error, OSError) else None) or " ".join(str(error).split())[:200]
            raise InputError(f"{path.parent}: cannot keep observations: {what}: name another folder") from None
        return kept


def halved(observations: Observations) -> Observations:
    """Return observations with correlations in half precision, and speech as it is."""
    gcc, speech = observations
    if gcc.numel() and not gcc.abs().amax() <= _MAX_HALF:
        raise InputError(f"front end: correlations must be finite and at most {_MAX_HALF:g} to be kept")
    return Observations(gcc.to(torch.float16), speech)


def _sweep(folder: Path) -> None:
    for left in folder.glob(".*.tmp"):
        with suppress(OSError):  # another process swept it
            if time.time() - left.stat().st_mtime > _STALE:
                left.unlink()


def _pieces(front_end: FrontEnd) -> Iterator[bytes]:
    """Yield what determines a front end, piece by piece, always in the same order."""
    for name, part in front_end.named_modules(remove_duplicate=False):
        yield f"module {name} {type(part).__module__}.{type(part).__qualname__} {_source(type(part))}".encode()
        if isinstance(part, torch.jit.ScriptModule):  # its attributes are compiled; its code tells
            yield str(part.inlined_graph if hasattr(part, "forward") else "").encode()
            continue
        for attribute, value in sorted(vars(part).items()):
            if attribute not in _TORCHS_OWN:
                yield attribute.encode()
                yield from _described(value, f"{name}.{attribute}".lstrip("."))
    tensors: Iterable[tuple[str, Tensor]] = [*front_end.named_parameters(), *front_end.named_buffers()]
    for name, tensor in tensors:
        yield name.encode()
        yield from _described(tensor, name)


def _described(value: Any, name: str) -> Iterator[bytes]:
    if isinstance(value, Tensor):
        yield f"{value.dtype} {tuple(value.shape)}".encode()
        yield value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
    elif isinstance(value, (list, tuple)):
        yield f"{type(value).__name__} {len(value)}".encode()
        for i, item in enumerate(value):
            yield from _described(item, f"{name}[{i}]")
    elif isinstance(value, dict):
        yield f"dict {len(value)}".encode()
        for key, item in value.items():
            yield repr(key).encode()
            yield from _described(item, f"{name}[{key!r}]")
    elif value is None or isinstance(value, (bool, int, float, str, bytes, Path, torch.dtype, torch.device)):
        yield f"{type(value).__name__} {value!r}".encode()
    elif isinstance(value, (type, types.FunctionType, types.BuiltinFunctionType)) and "<" not in value.__qualname__:
        yield f"{value.__module__}.{value.__qualname__}".encode()
    else:
        raise InputError(
            f"front end: {name} is a {type(value).__name__}, by which observations on disk cannot be told apart: keep "
            "numbers, text or tensors on a module"
        )


def _source(kind: type) -> str:
    """Return a hash of the file that defines a class, as far as there is one: of its text as it is now."""
    for where in (inspect.getmodule(kind), kind):
        try:
            return hashlib.sha256(inspect.getsource(where).encode()).hexdigest()  # type: ignore[arg-type]
        except (OSError, TypeError):
            continue
    return ""
