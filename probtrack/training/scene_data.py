"""Scenes on disk as items of a data set: sound or observations, and the truth at the same frames."""

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.data import Dataset

from probtrack import audio
from probtrack._checks import check_int
from probtrack._threads import one_thread
from probtrack.audio import FrontEnd, Observations, ShortTimeSpectrum
from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray
from probtrack.simulation import SceneFolder, read_manifest
from probtrack.simulation.scene_folder import ARRAY, TRUTH
from probtrack.training.observation_files import ObservationFiles, front_end_key, halved
from probtrack.training.seeds import seed_of
from probtrack.training.truth_at import TruthFrames, truth_at

_BLOCK = 1.0  # s heard at a time: what is not kept of a front end's work is large


class FrameGrid(NamedTuple):
    """Where frames lie: frame t covers samples tH to tH + L - 1.

    Attributes:
        frame_length: L, samples.
        hop: H, samples.
        fs: Sampling rate [Hz].
    """

    frame_length: int
    hop: int
    fs: int

    def count(self, num_samples: int) -> int:
        """Return how many whole frames `num_samples` hold."""
        return max(0, (num_samples - self.frame_length) // self.hop + 1)

    def span(self, frames: int) -> int:
        """Return how many samples `frames` frames cover, from the first of the first to the last of the last."""
        return (frames - 1) * self.hop + self.frame_length

    def time(self, frame: Tensor) -> Tensor:
        """Return the times of the centres of frames, of integers of any shape, float64 [s]."""
        return (frame.double() * self.hop + self.frame_length / 2) / self.fs


class SceneItem(NamedTuple):
    """A recording, or some consecutive frames of one.

    Attributes:
        name: Of its folder.
        array: Microphone positions (M, A) [m].
        grid: Where the frames of the recording lie.
        start: Number of the first frame that is here, 0 for a whole recording.
        audio: (M, S), full scale 1; None where there are observations.
        observations: T first; None where there is sound.
        truth: T first; None for a folder without truth.
    """

    name: str
    array: Tensor
    grid: FrameGrid
    start: int
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
        """Centres of the frames (T,) float64 [s]."""
        return self.grid.time(self.start + torch.arange(self.num_frames))


class SceneDataset(Dataset[SceneItem]):
    """Recordings of a data set, or of scene folders, with their truth.

    Without a front end an item is sound, and its frames are those of `stft`. With one, an item is what the front end
    observes, as it is now (a copy: training it later changes nothing here), worked out once and kept on disk: see
    `ObservationFiles`. On disk a second of sound takes 2 P K fs / hop bytes (P pairs, K lags): 3.5 MB for S1's eight
    microphones along the walls of a room, 0.3 MB for eight on a circle of 20 cm.

    An index is the number of a recording, or that with the number of a draw: with `crop`, another draw cuts another
    piece out of the recording, always the same one for one seed, recording and draw.

    Args:
        scenes: Folder of a data set (with its manifest), or scene folders.
        front_end: Makes the observations of a recording.
        fs: Rate that recordings are brought to [Hz].
        stft: Frames of items with sound: 32 ms every 16 ms, as in the truth of scenes, if not given.
        crop: Consecutive frames that are cut from each recording; None for whole recordings.
        seed: Of the crops.
        cache: Folder that keeps observations; None for `observations` in each scene's own folder.
        require_truth: Refuse folders without truth.

    Shape:
        Items in float32, those with observations in the precision of the front end.

    Raises:
        InputError: for a folder without a manifest, folders that are missing or hold no scene, without the truth or
            the microphones that are wanted, or a recording that is shorter than the crop.
    """

    def __init__(
        self,
        scenes: str | Path | Sequence[str | Path],
        front_end: FrontEnd | None = None,
        *,
        fs: int = 16_000,
        stft: ShortTimeSpectrum | None = None,
        crop: int | None = None,
        seed: int = 0,
        cache: str | Path | None = None,
        require_truth: bool = False,
    ) -> None:
        check_int(fs, "fs", low=1)
        if front_end is not None and stft is not None:
            raise InputError("stft must not be given with a front_end, which has frames of its own")
        self.folders = scene_folders(scenes)
        self.front_end = None if front_end is None else copy.deepcopy(front_end).cpu().eval().requires_grad_(False)
        frames = stft if self.front_end is None else self.front_end.stft
        length, hop = (round(0.032 * fs), round(0.016 * fs)) if frames is None else (frames.frame_length, frames.hop)
        self.grid = FrameGrid(length, hop, fs)
        self.crop = None if crop is None else check_int(crop, "crop", low=1)
        self.seed = check_int(seed, "seed", low=0)
        self.files = None if self.front_end is None else ObservationFiles(front_end_key(self.front_end, fs), cache)
        self.arrays = arrays_of(self.folders)
        self._names = _own_names([folder.path for folder in self.folders])
        for number in range(len(self.folders)):
            self._check(number, require_truth)

    def __len__(self) -> int:
        return len(self.folders)

    def __getitem__(self, index: int | tuple[int, int]) -> SceneItem:
        number, draw = index if isinstance(index, tuple) else (index, 0)
        if not -len(self) <= number < len(self):
            raise IndexError(f"no recording {number}: there are {len(self)}")
        number %= len(self)
        folder, recording = self.folders[number], self._recording(number)
        total = self.grid.count(recording.num_output_samples)
        start, count = (0, total) if self.crop is None else (self._start(number, draw, total), self.crop)
        sound = observations = None
        if self.front_end is None:
            sound = recording.read()
            if self.crop is not None:
                sound = sound[:, start * self.grid.hop :][:, : self.grid.span(count)].clone()
        else:
            observations = self._observations(recording, slice(start, start + count))
        dtype = torch.float32 if observations is None else observations.speech.dtype
        truth, time = folder.truth, self.grid.time(start + torch.arange(count))
        return SceneItem(
            name=self._names[number],
            array=self.arrays[number].positions.to(dtype),
            grid=self.grid,
            start=start,
            audio=sound,
            observations=observations,
            truth=None if truth is None else truth_at(truth, time, dtype),
        )

    def num_frames(self, number: int) -> int:
        """Return how many frames item `number` has, without reading it."""
        return self.crop or self.grid.count(self._recording(number).num_output_samples)

    def _recording(self, number: int) -> audio.Recording:
        return audio.Recording.open(self.folders[number].audio_path, self.grid.fs)

    def _start(self, number: int, draw: int, total: int) -> int:
        assert self.crop is not None
        # one generator for each item and draw: which worker makes it must not matter
        generator = torch.Generator().manual_seed(seed_of(self.seed, number, draw))
        return int(torch.randint(total - self.crop + 1, (), generator=generator))

    def _observations(self, recording: audio.Recording, part: slice) -> Observations:
        assert self.files is not None
        path = self.files.path(recording.path)
        kept = self.files.get(path)
        if kept is None:
            kept = self.files.put(path, self._observe(recording))
        gcc, speech = kept
        return Observations(gcc[part].to(speech.dtype), speech[part].clone())

    def _observe(self, recording: audio.Recording) -> Observations:
        """Hear a whole recording; on one thread, so that it is the same in every worker, bit for bit."""
        assert self.front_end is not None
        dtype, state = self.front_end.stft.window.dtype, None
        pieces: list[Observations] = []
        with one_thread(), torch.no_grad():
            for block in recording.blocks(_BLOCK):
                state, heard = self.front_end.step(state, block.to(dtype))
                pieces.append(halved(heard))
        gcc, speech = zip(*pieces, strict=True)
        return Observations(torch.cat(gcc), torch.cat(speech))

    def _check(self, number: int, require_truth: bool) -> None:
        """Say what is wrong with a folder before training begins, without reading its sound."""
        path, recording, array = self.folders[number].path, self._recording(number), self.arrays[number]
        channels = len(recording.channels)
        if channels != array.num_microphones:
            raise InputError(f"{path}: the recording has {channels} channels, the array {array.num_microphones}")
        wanted = channels if self.front_end is None else self.front_end.gcc.num_microphones
        if channels != wanted:
            raise InputError(f"{path}: the front end is for {wanted} microphones, the scene has {channels}")
        total = self.grid.count(recording.num_output_samples)
        if total < (self.crop or 1):
            raise InputError(f"{path}: the recording has {total} frames, wanted are at least {self.crop or 1}")
        if require_truth and not (path / TRUTH).exists():
            raise InputError(f"{path}: has no {TRUTH}, and truth is wanted here")


def _own_names(paths: list[Path]) -> list[str]:
    """Return the names of folders, with those of the folders that hold them where two would have one name."""
    names = [path.name for path in paths]
    return names if len(set(names)) == len(names) else [f"{path.resolve().parent.name}/{path.name}" for path in paths]


def scene_folders(scenes: str | Path | Sequence[str | Path]) -> list[SceneFolder]:
    """Return the scene folders of a data set, in the order of its manifest, or those that are listed."""
    if isinstance(scenes, (str, Path)):
        paths = [Path(scenes) / row["folder"] for row in read_manifest(scenes)]
    else:
        paths = [Path(path) for path in scenes]
    if not paths:
        raise InputError("scenes must be the folder of a data set or at least one scene folder, got none")
    missing = next((path for path in paths if not path.is_dir()), None)
    if missing is not None:
        raise InputError(f"{missing}: there is no such scene folder")
    return [SceneFolder(path) for path in paths]


def arrays_of(folders: Sequence[SceneFolder]) -> list[MicrophoneArray]:
    """Return the array of each folder; files with the same text, of which a data set has many, are read once."""
    seen: dict[bytes, MicrophoneArray] = {}
    arrays = []
    for folder in folders:
        path = folder.path / ARRAY
        content = path.read_bytes() if path.is_file() else b""
        if content not in seen:
            seen[content] = folder.array
        arrays.append(seen[content])
    return arrays
