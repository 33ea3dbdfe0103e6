"""Scenes for a Lightning trainer. Imports Lightning, so that it is loaded when it is first named only."""

from pathlib import Path

import torch
from torch.utils.data import DataLoader

from probtrack._checks import check_int
from probtrack.audio import FrontEnd
from probtrack.errors import InputError
from probtrack.simulation import SceneFolder
from probtrack.training.batches import BatchesOfOneLength, SceneBatch, SceneSampler, collate
from probtrack.training.scene_data import SceneDataset, arrays_of, scene_folders
from probtrack.training.settings import FrontEndSettings
from probtrack.training.splitting import split_by_scene

try:
    from lightning import LightningDataModule
except ImportError:
    raise ImportError("SceneDataModule needs Lightning: pip install 'probtrack[train]'") from None

Scenes = str | list[str]

_SAME_PLACE = 1e-5  # m by which arrays of scenes may differ: files say a micrometre


class SceneDataModule(LightningDataModule):
    """Batches of scenes to train, validate and test with: `SceneBatch`, time first and recordings second.

    Either `train`, `val` and `test` name what is on disk, or `split` parts the scenes of `train` in three: recordings
    of one scene at several signal-to-noise ratios stay together. Training recordings come in an order, and with
    crops, that `seed` and the epoch determine; those of validation and test come whole, in batches of one length.
    The numbers do not depend on how many workers make them.

    Args:
        train: Folder of a data set, or a list of scene folders.
        val: The same, for validation.
        test: The same, for tests.
        split: Shares of the scenes of `train` for training, validation and tests, which sum to 1.
        front_end: A front end, or the settings of one for the array of the scenes, such as `Lehmann2007FrontEnd`;
            None for sound.
        fs: Rate that recordings are brought to [Hz].
        audio: Give sound, on the frames of the front end, rather than observations: for front ends that learn.
        batch_size: Recordings in a batch, at most.
        crop: Consecutive frames cut from each training recording; None for whole ones, cropped to the shortest of
            their batch.
        workers: Processes that read ahead; 0 to read when it is needed.
        seed: Of the split, the order and the crops.
        cache: Folder that keeps observations; None for `observations` in each scene's own folder.
        require_truth: Refuse scenes without truth.

    Raises:
        ImportError: without Lightning (extra `train`).
        InputError: when it is made, for values that cannot be; and by `setup`, for what is wrong on disk.
    """

    def __init__(
        self,
        train: Scenes | None = None,
        val: Scenes | None = None,
        test: Scenes | None = None,
        *,
        split: tuple[float, float, float] | None = None,
        front_end: FrontEnd | FrontEndSettings | None = None,
        fs: int = 16_000,
        audio: bool = False,
        batch_size: int = 8,
        crop: int | None = None,
        workers: int = 0,
        seed: int = 0,
        cache: str | None = None,
        require_truth: bool = True,
    ) -> None:
        super().__init__()
        if split is not None and (train is None or val is not None or test is not None):
            raise InputError("split parts the scenes of train: give train, and neither val nor test")
        if train is None and val is None and test is None:
            raise InputError("at least one of train, val and test must name scenes")
        self.scenes = {"train": train, "val": val, "test": test}
        self.split, self.front_end, self.audio, self.cache = split, front_end, audio, cache
        self.fs = check_int(fs, "fs", low=1)
        self.batch_size = check_int(batch_size, "batch_size", low=1)
        self.crop = None if crop is None else check_int(crop, "crop", low=1)
        self.workers = check_int(workers, "workers", low=0)
        self.seed = check_int(seed, "seed", low=0)
        self.require_truth = require_truth
        self.datasets: dict[str, SceneDataset] = {}

    def setup(self, stage: str | None = None) -> None:  # noqa: ARG002
        """Find the scenes of all stages, and say what is wrong with them."""
        if self.datasets:
            return
        parts = self._parts()
        _check_apart(parts)
        front_end = self._front_end([path for paths in parts.values() for path in paths])
        self.datasets = {
            name: SceneDataset(
                paths,
                None if self.audio else front_end,
                fs=self.fs,
                stft=front_end.stft if self.audio and front_end is not None else None,
                crop=self.crop if name == "train" else None,
                seed=self.seed,
                cache=self.cache,
                require_truth=self.require_truth,
            )
            for name, paths in parts.items()
        }

    def train_dataloader(self) -> DataLoader[SceneBatch]:
        """Return what gives the batches of an epoch, in another order each time."""
        dataset = self._dataset("train")
        sampler = SceneSampler(len(dataset), self.seed)
        if self.trainer is not None:  # Lightning says it only after workers have begun to read
            sampler.set_epoch(self.trainer.fit_loop.epoch_progress.current.processed)  # type: ignore[attr-defined]
        return self._loader(dataset, batch_size=self.batch_size, sampler=sampler)

    def val_dataloader(self) -> DataLoader[SceneBatch] | list[DataLoader[SceneBatch]]:
        """Return what gives the validation batches; none where there are no such scenes."""
        return self._whole("val")

    def test_dataloader(self) -> DataLoader[SceneBatch] | list[DataLoader[SceneBatch]]:
        """Return what gives the test batches; none where there are no such scenes."""
        return self._whole("test")

    def _parts(self) -> dict[str, list[Path]]:
        if self.split is not None and isinstance(self.scenes["train"], str):
            parts = split_by_scene(self.scenes["train"], self.split, self.seed)
            return {name: paths for name, paths in zip(self.scenes, parts, strict=True) if paths}
        if self.split is not None:
            raise InputError("split needs train to be the folder of one data set, got a list of scene folders")
        named = {name: scenes for name, scenes in self.scenes.items() if scenes is not None}
        return {name: [folder.path for folder in scene_folders(scenes)] for name, scenes in named.items()}

    def _front_end(self, paths: list[Path]) -> FrontEnd | None:
        """Return the front end, made for the one array that all scenes must have."""
        if self.front_end is None:
            return None
        arrays = arrays_of([SceneFolder(path) for path in paths])
        for path, array in zip(paths, arrays, strict=True):
            alike = array.positions.shape == arrays[0].positions.shape
            if not alike or (array.positions - arrays[0].positions).abs().max() > _SAME_PLACE:
                raise InputError(f"{path}: has another array than {paths[0]}, and a front end is for one")
        given = self.front_end
        return given.make(arrays[0], self.fs) if isinstance(given, FrontEndSettings) else given

    def _dataset(self, name: str) -> SceneDataset:
        self.setup()
        if name not in self.datasets:
            raise InputError(f"data module: there are no scenes for {name}: name some, or give split a share")
        return self.datasets[name]

    def _whole(self, name: str) -> DataLoader[SceneBatch] | list[DataLoader[SceneBatch]]:
        self.setup()
        if name not in self.datasets:
            return []
        dataset = self.datasets[name]
        lengths = [dataset.num_frames(number) for number in range(len(dataset))]
        batches = BatchesOfOneLength(range(len(dataset)), self.batch_size, drop_last=False, lengths=lengths)
        return self._loader(dataset, batch_sampler=batches)

    def _loader(
        self,
        dataset: SceneDataset,
        *,
        batch_size: int = 1,
        sampler: SceneSampler | None = None,
        batch_sampler: BatchesOfOneLength | None = None,
    ) -> DataLoader[SceneBatch]:
        return DataLoader(
            dataset,  # type: ignore[arg-type]  # what it gives is collated
            batch_size=batch_size,
            sampler=sampler,
            batch_sampler=batch_sampler,
            num_workers=self.workers,
            collate_fn=collate,
            persistent_workers=self.workers > 0,
            generator=torch.Generator().manual_seed(self.seed),  # not the global one, whose numbers are the model's
        )


def _check_apart(parts: dict[str, list[Path]]) -> None:
    """Raise `InputError` if a scene folder is in two parts."""
    seen: dict[Path, str] = {}
    for name, paths in parts.items():
        for path in paths:
            other = seen.setdefault(path.resolve(), name)
            if other != name:
                raise InputError(f"{path}: is both for {other} and for {name}")
