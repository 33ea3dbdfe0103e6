"""Steered power at 75 points that change every frame: 10 s of 8 channels at 16 kHz, samples to power.

Everybody makes the same frames with `ShortTimeSpectrum` first, and uses 300 to 3000 Hz but where said.
pyroomacoustics: `doa.SRP` with a grid of the frame's points, its mode vectors for near sources and
`locate_sources` each frame. speechbrain: `SrpPhat` with the frame's points as its directions and their
delays, covariances of all frames beforehand; it always uses the whole band to 8 kHz. "Same band" cuts its
arrays down to ours by hand between its own functions, which it does not offer.
"""

import math
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks import sounds
from benchmarks.pairs import Row, missing_row, peer, ratio_row, spread
from probtrack.audio import Frames, GeneralisedCrossCorrelation, ShortTimeSpectrum, SteeredResponsePower
from probtrack.geometry import SPEED_OF_SOUND, Region

_POINTS = 75
_TARGETS = {512: (10.0, 35.0), 1024: (15.0, 60.0)}  # times faster than pyroomacoustics, speechbrain


class Scene:
    """The recording, its points and our front end for one frame length.

    Attributes:
        samples: (8, S).
        points: (T, 75, 3) [m].
    """

    def __init__(self, frame_length: int, seconds: float) -> None:
        self.array, self.frame_length = sounds.array(), frame_length
        self.samples = sounds.talker(seconds)
        self.stft = ShortTimeSpectrum(frame_length, frame_length // 2)
        self.gcc = GeneralisedCrossCorrelation(self.array, fs=sounds.FS, frame_length=frame_length)
        self.power = SteeredResponsePower(self.array, lag_rate=self.gcc.lag_rate, num_lags=self.gcc.num_lags)
        self.bins = torch.arange(self.gcc.low_bin, self.gcc.high_bin + 1)
        region = Region.from_yaml(sounds.ARRAY)
        if region is None:
            raise RuntimeError("the array file has no region")
        frames = self.stft.num_frames(self.samples.shape[-1])
        unit = torch.rand(frames, _POINTS, 2, generator=torch.Generator().manual_seed(1))
        height = torch.full((frames, _POINTS, 1), sounds.PLACE[2])
        self.points = torch.cat([region.plane().from_unit(unit), height], -1)

    @torch.no_grad()
    def ours(self) -> Tensor:
        """Return the power (T, 75), a second of sound at a time as the tracker has it."""
        pieces, start = [], 0
        at_once = max(1, sounds.FS // self.stft.hop)
        for points in self.points.split(at_once):
            end = start + (len(points) - 1) * self.stft.hop + self.frame_length
            spectrum = self.stft(self.samples[:, start:end]).spectrum
            pieces.append(self.power(self.gcc(spectrum), points))
            start += len(points) * self.stft.hop
        return torch.cat(pieces)

    @torch.no_grad()
    def spectrum(self) -> Tensor:
        """Return the spectra (T, 8, F)."""
        frames: Frames = self.stft(self.samples)
        return frames.spectrum

    def delays(self, points: Tensor) -> Tensor:
        """Return the time from `points` (..., N, 3) to each microphone (..., N, 8) [s]."""
        return torch.cdist(points, self.array.positions.to(points)) / SPEED_OF_SOUND


def run(quick: bool = False) -> list[Row]:
    """Compare speed at both frame lengths, then accuracy."""
    rows = []
    for frame_length, (pyroom_target, speechbrain_target) in _TARGETS.items():
        scene = Scene(frame_length, 2.0 if quick else 10.0)
        pairs = 3 if quick else 5
        what = f"frames of {frame_length}"
        pyroom = peer("pyroomacoustics")
        name = "pyroomacoustics SRP"
        if pyroom is None:
            rows.append(missing_row(what, name, pyroom_target))
        else:
            work = pyroomacoustics_srp(pyroom, scene)
            _check_same(scene, work())
            rows.append(ratio_row(what, scene.ours, name, work, pairs=pairs, target=pyroom_target, faster=True))
        module, name = peer("speechbrain.processing.multi_mic"), "speechbrain SrpPhat"
        if module is None:
            rows.append(missing_row(what, name, speechbrain_target))
            continue
        for band, title, target in ((False, name, speechbrain_target), (True, f"{name}, same band", None)):
            theirs = speechbrain_srp(module, scene, band=band)
            rows.append(ratio_row(what, scene.ours, title, theirs, pairs=min(pairs, 3), target=target, faster=True))
    return [*rows, accuracy()]


def accuracy() -> Row:
    """Return how far the power is from steering every frequency in float64, as a share of its largest [%].

    At all points of the frames of speech and silence of two seconds; the worst point counts.
    """
    scene = Scene(512, 2.0)
    steered = direct(scene, scene.points)
    error = (scene.ours().double() - steered).abs() / steered.max()
    worst = [100 * float(frames.max()) for frames in error.split(10)]
    figure = spread([max(worst), *worst])._replace(median=max(worst))
    return Row("largest error, of the largest power", figure, 0.5, unit="%", against="direct steering in float64")


@torch.no_grad()
def direct(scene: Scene, points: Tensor) -> Tensor:
    """Return the power (T, N) of a delay-and-sum beamformer on the whitened spectra, frequency by frequency."""
    band = scene.spectrum()[..., scene.bins].to(torch.complex128)
    white = band / band.abs()  # (T, M, F)
    frequency = scene.bins.double() * sounds.FS / scene.frame_length
    phase = 2 * math.pi * frequency * scene.delays(points.double())[..., None]  # (T, N, M, F)
    beam = (white[:, None] * torch.polar(torch.ones_like(phase), phase)).sum(2)
    return beam.abs().square().sum(-1) / (white.shape[1] ** 2 * white.shape[2])


def pyroomacoustics_srp(pyroom: ModuleType, scene: Scene) -> Callable[[], np.ndarray]:
    """Return a run of pyroomacoustics' SRP over the frames, giving its values (T, 75)."""
    doa = pyroom.doa
    microphones = scene.array.positions.numpy().T.astype(float)
    points = scene.points.double().numpy()
    bins = scene.bins.tolist()
    srp = doa.SRP(microphones, sounds.FS, scene.frame_length, c=SPEED_OF_SOUND, azimuth=np.zeros(1))

    class Points(doa.grid.Grid):  # type: ignore[misc, name-defined]
        """A grid of any points."""

        def __init__(self, where: np.ndarray) -> None:
            super().__init__(len(where))
            self.x, self.y, self.z = where.T

        def find_peaks(self, k: int = 1) -> np.ndarray:
            return np.argsort(self.values)[-k:]

    def work() -> np.ndarray:
        # its vectors for near sources have the sign of an advance: conjugate spectra match them
        spectrum = scene.spectrum().conj().resolve_conj().numpy()
        values = []
        for frame, where in zip(spectrum, points, strict=True):
            srp.grid = Points(where)
            srp.mode_vec = doa.doa.ModeVector(
                microphones, sounds.FS, scene.frame_length, SPEED_OF_SOUND, srp.grid, mode="near"
            )
            srp.locate_sources(frame[:, :, None], freq_bins=bins)
            values.append(srp.grid.values)
        return np.array(values)

    return work


def _check_same(scene: Scene, values: np.ndarray) -> None:
    """Raise unless the peer's values are our power on another scale: the work compared is the same."""
    microphones = scene.array.num_microphones
    power = torch.from_numpy(values) * (microphones * (microphones - 1) / 2) / microphones**2
    if not torch.allclose(power, scene.ours().double(), atol=0.01):
        raise RuntimeError("pyroomacoustics and probtrack do not compute the same power")


def speechbrain_srp(module: Any, scene: Scene, *, band: bool) -> Callable[[], Tensor]:
    """Return a run of speechbrain's SrpPhat over the frames, giving its best points (T, 3)."""
    covariance = module.Covariance(average=False)
    srp = module.SrpPhat(scene.array.positions, sample_rate=sounds.FS, speed_sound=SPEED_OF_SOUND)
    bins = scene.frame_length // 2 + 1

    @torch.no_grad()
    def work() -> Tensor:
        spectrum = scene.spectrum().movedim(1, 2)  # (T, F, 8)
        covariances = covariance(torch.stack([spectrum.real, spectrum.imag], 2)[None])
        taus = -scene.delays(scene.points) * sounds.FS
        best = []
        for t, points in enumerate(scene.points):
            frame = covariances[:, t : t + 1]
            if band:
                steering = module.steering(taus[t], bins)[:, scene.bins]
                best.append(srp._srp_phat(frame[:, :, scene.bins], steering, points))
            else:
                srp.doas, srp.taus = points, taus[t]
                best.append(srp(frame))
        return torch.cat(best, 1)[0]

    return work
