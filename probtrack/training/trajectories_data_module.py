"""Trajectories for a Lightning trainer. Imports Lightning, so that it is loaded when it is first named only."""

import math

import torch
from torch.utils.data import DataLoader

from probtrack._checks import as_non_negative, check_int
from probtrack.errors import InputError
from probtrack.training.batches import SceneSampler
from probtrack.training.seeds import seed_of
from probtrack.training.trajectories import Trajectory, TrajectoryBatch, TrajectoryDataset, collate_trajectories
from probtrack.training.trajectories_reading import MAX_SPEED, read_trajectories
from probtrack.training.trajectories_sampled import TrajectorySource

try:
    from lightning import LightningDataModule
except ImportError:
    raise ImportError("TrajectoryDataModule needs Lightning: pip install 'probtrack[train]'") from None

Source = str | list[str] | TrajectorySource


class TrajectoryDataModule(LightningDataModule):
    """Batches of trajectories to train, validate and test with: `TrajectoryBatch`, time first and trajectories second.

    Either `train`, `val` and `test` say where they come from, or `split` parts those of `train` in three: tracks of one
    file stay together.

    Args:
        train: A file or folder, a list of them, or what gives trajectories, such as `SampledTrajectories`.
        val: The same, for validation.
        test: The same, for tests.
        split: Shares of `train` for training, validation and tests, which sum to 1.
        batch_size: Trajectories in a batch, at most.
        axes: Coordinates that are read from files, 2 (x and y) or 3.
        max_speed: Of talkers in files: a faster change of position is refused as a jump [m/s].
        longest_step: Longer steps of time are taken in equal parts without a measurement [s]; None to take all as they
            are. See `TrajectoryDataset`.
        error: Standard deviation of errors that are added to positions from files, on each axis [m]: for paths that are
            known exactly, as the truth of simulated scenes.
        seed: Of the split, the order and the errors.

    Raises:
        ImportError: without Lightning (extra `train`).
        InputError: when it is made, for values that cannot be; and by `setup`, for what is wrong in files.
    """

    def __init__(
        self,
        train: Source | None = None,
        val: Source | None = None,
        test: Source | None = None,
        *,
        split: tuple[float, float, float] | None = None,
        batch_size: int = 32,
        axes: int = 2,
        max_speed: float = MAX_SPEED,
        longest_step: float | None = None,
        error: float = 0.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if split is not None and (train is None or val is not None or test is not None):
            raise InputError("split parts the trajectories of train: give train, and neither val nor test")
        if train is None and val is None and test is None:
            raise InputError("at least one of train, val and test must say where trajectories come from")
        self.sources = {"train": train, "val": val, "test": test}
        self.split = None if split is None else _shares(split)
        self.batch_size = check_int(batch_size, "batch_size", low=1)
        self.axes, self.max_speed, self.longest_step = axes, max_speed, longest_step
        self.error = float(as_non_negative(error, "error"))
        self.seed = check_int(seed, "seed", low=0)
        self.datasets: dict[str, TrajectoryDataset] = {}

    def setup(self, stage: str | None = None) -> None:  # noqa: ARG002
        """Read or draw the trajectories of all stages."""
        if not self.datasets:
            parts = {name: self._found(name, source) for name, source in self.sources.items() if source is not None}
            if self.split is not None:
                parts = _parted(parts["train"], self.split, self.seed)
            self.datasets = {name: TrajectoryDataset(part, self.longest_step) for name, part in parts.items() if part}

    def train_dataloader(self) -> DataLoader[TrajectoryBatch]:
        """Return what gives the batches of an epoch, in an order that `seed` and the epoch determine."""
        self.setup()
        if "train" not in self.datasets:
            raise InputError("data module: there are no trajectories for train: name some, or give split a share")
        sampler = SceneSampler(len(self.datasets["train"]), self.seed)
        if self.trainer is not None:  # a run that goes on begins with the order of its epoch, also in several processes
            sampler.set_epoch(self.trainer.fit_loop.epoch_progress.current.processed)  # type: ignore[attr-defined]
        return self._loader("train", sampler=sampler)

    def val_dataloader(self) -> DataLoader[TrajectoryBatch] | list[DataLoader[TrajectoryBatch]]:
        """Return what gives the validation batches; none where there are no such trajectories."""
        self.setup()
        return self._loader("val") if "val" in self.datasets else []

    def test_dataloader(self) -> DataLoader[TrajectoryBatch] | list[DataLoader[TrajectoryBatch]]:
        """Return what gives the test batches; none where there are no such trajectories."""
        self.setup()
        return self._loader("test") if "test" in self.datasets else []

    def _found(self, name: str, source: Source) -> list[Trajectory]:
        if isinstance(source, TrajectorySource):
            return source.trajectories()
        found = read_trajectories(source, axes=self.axes, max_speed=self.max_speed)
        generator = torch.Generator().manual_seed(seed_of(self.seed, list(self.sources).index(name)))
        return [
            one._replace(position=one.position + self.error * torch.randn(one.position.shape, generator=generator))
            for one in found
        ]

    def _loader(self, name: str, sampler: SceneSampler | None = None) -> DataLoader[TrajectoryBatch]:
        return DataLoader(
            self.datasets[name],  # type: ignore[arg-type]  # what it gives is collated
            batch_size=self.batch_size,
            sampler=sampler,
            collate_fn=collate_trajectories,
            generator=torch.Generator().manual_seed(self.seed),  # not the global one, whose numbers are the model's
        )


def _shares(split: tuple[float, float, float]) -> tuple[float, float, float]:
    if not all(math.isfinite(s) and s >= 0 for s in split) or abs(sum(split) - 1) > 1e-6:
        raise InputError(f"split must be shares of at least 0 with sum 1, got {', '.join(f'{s:g}' for s in split)}")
    return split


def _parted(found: list[Trajectory], shares: tuple[float, float, float], seed: int) -> dict[str, list[Trajectory]]:
    """Return trajectories in three parts, drawn without regard to anything but whole groups."""
    groups = list(dict.fromkeys(one.group for one in found))
    order = torch.randperm(len(groups), generator=torch.Generator().manual_seed(seed_of(seed))).tolist()
    ends = [round(len(groups) * sum(shares[: n + 1])) for n in range(3)]
    parts, begin = {}, 0
    for name, end, share in zip(("train", "val", "test"), ends, shares, strict=True):
        own = {groups[i] for i in order[begin:end]}
        if share > 0 and not own:
            raise InputError(f"split leaves nothing for {name}: there are {len(groups)} files or walks")
        parts[name], begin = [one for one in found if one.group in own], end
    return parts
