"""Batches of recordings, and the order in which they come."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.data import BatchSampler, Sampler

from probtrack._checks import check_int
from probtrack.audio import Observations
from probtrack.errors import InputError
from probtrack.training.scene_data import FrameGrid, SceneItem
from probtrack.training.seeds import seed_of
from probtrack.training.truth_at import TruthFrames


class SceneBatch(NamedTuple):
    """B recordings, or as many consecutive frames of each.

    Attributes:
        names: Of their folders.
        array: Microphone positions (B, M, A) [m].
        grid: Where the frames of the recordings lie.
        start: Number of the first frame that is here (B,).
        audio: (B, M, S); None where there are observations.
        observations: (T, B, ...); None where there is sound.
        truth: (T, B, ...); None for recordings without truth.
    """

    names: tuple[str, ...]
    array: Tensor
    grid: FrameGrid
    start: Tensor
    audio: Tensor | None
    observations: Observations | None
    truth: TruthFrames | None

    @property
    def num_frames(self) -> int:
        """Number of frames T."""
        if self.observations is not None:
            return len(self.observations.speech)
        assert self.audio is not None
        return self.grid.count(self.audio.shape[-1])

    @property
    def time(self) -> Tensor:
        """Centres of the frames (T, B) float64 on the CPU [s]."""
        return self.grid.time(self.start.cpu() + torch.arange(self.num_frames)[:, None])


def collate(items: Sequence[SceneItem]) -> SceneBatch:
    """Return items side by side, cropped to the shortest of them.

    Raises:
        InputError: for items of different sampling rates, frames, microphones, numbers of talkers or columns of truth.
    """
    for what, of in _ALIKE.items():
        _check_alike(items, what, [of(item) for item in items])
    frames = min(item.num_frames for item in items)
    first = items[0]
    sound = observations = truth = None
    if first.audio is not None:
        sounds = [item.audio for item in items if item.audio is not None]
        length = min(sound.shape[-1] for sound in sounds)
        sound = torch.stack([sound[:, :length] for sound in sounds])
    if first.observations is not None:
        columns = zip(*(item.observations for item in items if item.observations is not None), strict=True)
        observations = Observations(*(_side_by_side(column, frames) for column in columns))
    if first.truth is not None:
        columns = zip(*(item.truth for item in items if item.truth is not None), strict=True)
        truth = TruthFrames._make(None if c[0] is None else _side_by_side(c, frames) for c in columns)
    return SceneBatch(
        names=tuple(item.name for item in items),
        array=torch.stack([item.array for item in items]),
        grid=first.grid,
        start=torch.tensor([item.start for item in items]),
        audio=sound,
        observations=observations,
        truth=truth,
    )


class SceneSampler(Sampler[tuple[int, int]]):
    """Indices (recording, draw) of a `SceneDataset`: an epoch in an order of its own, determined by seed and epoch.

    Args:
        count: Number of recordings.
        seed: Of the orders.

    Attributes:
        epoch: Of the next pass, which is also its draw; goes up with each, and `set_epoch` sets it, as Lightning
            does when training is gone on with.
    """

    def __init__(self, count: int, seed: int = 0) -> None:
        self.count, self.seed = check_int(count, "count", low=1), check_int(seed, "seed", low=0)
        self.epoch = 0

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[tuple[int, int]]:
        epoch, self.epoch = self.epoch, self.epoch + 1
        generator = torch.Generator().manual_seed(seed_of(self.seed, epoch))
        return iter([(number, epoch) for number in torch.randperm(self.count, generator=generator).tolist()])

    def set_epoch(self, epoch: int) -> None:
        """Say which epoch comes next."""
        self.epoch = epoch


class BatchesOfOneLength(BatchSampler):
    """Recordings in batches of equal numbers of frames, so that they can be tested whole, and many at a time.

    Args:
        sampler: Recordings that are wanted: of several processes each has its own, which Lightning puts here.
        batch_size: Recordings in a batch, at most.
        drop_last: Must be False: Lightning's manner of making such samplers anew.
        lengths: Number of frames of every recording.
    """

    def __init__(self, sampler: Iterable[int], batch_size: int, drop_last: bool, lengths: Sequence[int]) -> None:
        self.sampler, self.batch_size, self.drop_last, self.lengths = sampler, batch_size, drop_last, lengths

    def __iter__(self) -> Iterator[list[int]]:
        groups: dict[int, list[int]] = {}
        for number in self.sampler:
            groups.setdefault(self.lengths[number], []).append(number)
        size = self.batch_size
        return iter([group[i : i + size] for group in groups.values() for i in range(0, len(group), size)])

    def __len__(self) -> int:
        return sum(1 for _ in self)


def _talkers(item: SceneItem) -> int | None:
    return None if item.truth is None else item.truth.known.shape[-1]


def _columns(item: SceneItem) -> str:
    if item.truth is None:
        return "none"
    names = [name for name, column in item.truth._asdict().items() if column is not None]
    axes = "" if item.truth.position is None else f" in {item.truth.position.shape[-1]} axes"
    return ", ".join(names) + axes


_ALIKE: dict[str, Callable[[SceneItem], object]] = {
    "sampling rates [Hz]": lambda item: item.grid.fs,
    "frame lengths and hops": lambda item: item.grid[:2],
    "numbers of microphones and axes": lambda item: tuple(item.array.shape),
    "contents": lambda item: "observations" if item.audio is None else "sound",
    "numbers of talkers": _talkers,
    "columns of truth": _columns,
}


def _check_alike(items: Sequence[SceneItem], what: str, values: list[object]) -> None:
    for item, value in zip(items, values, strict=True):
        if value != values[0]:
            raise InputError(
                f"batch: {what} must be equal, got {values[0]} of {items[0].name} and {value} of {item.name}"
            )


def _side_by_side(columns: Sequence[Tensor], frames: int) -> Tensor:
    return torch.stack([column[:frames] for column in columns], 1)
