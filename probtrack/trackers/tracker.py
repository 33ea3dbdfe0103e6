"""A front end and a filter: audio in, track out, whole or as it arrives."""

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor, nn

from probtrack.audio import FrontEnd, FrontEndState, Observations
from probtrack.errors import InputError
from probtrack.filters import Belief, NoiseStream, ParticleFilter
from probtrack.geometry import Region
from probtrack.tracks import Track, join


class TrackerState(NamedTuple):
    """What a tracker remembers between blocks of samples.

    Attributes:
        belief: Particle cloud after the last frame.
        noise: The random numbers still to come.
        front_end: Samples and detector state of the front end; None before the first block.
        frames: How many frames have been tracked.
    """

    belief: Belief
    noise: NoiseStream
    front_end: FrontEndState | None
    frames: int


class Tracker(nn.Module):
    """Tracks one talker in the sound of a microphone array.

    Args:
        front_end: Makes observations of samples.
        filter: Makes a track of observations.
        region: Where the talker can be, with the axes of the tracked position.
        fs: Sampling rate of the samples [Hz].

    Shape:
        samples (*batch, M, n): no batch, or recordings of equal length. `seeds` (*batch, *runs) gives every
        Monte-Carlo run of every recording its own random numbers; the track has their shape.
    """

    def __init__(self, front_end: FrontEnd, filter: ParticleFilter, region: Region, *, fs: int = 16_000) -> None:
        super().__init__()
        self.front_end, self.filter, self.region, self.fs = front_end, filter, region, fs

    @property
    def dt(self) -> float:
        """Time between frames, hop / fs [s]."""
        return self.front_end.stft.hop / self.fs

    def begin(self, seeds: Tensor | int = 0, start: Tensor | None = None, start_std: float = 0.1) -> TrackerState:
        """Return the state before the first sample.

        Args:
            seeds: (*batch, *runs) integers: one run each.
            start: Where the talker is at first (A,) or (*seeds' shape, A) [m]. None spreads the cloud
                over the whole region.
            start_std: Standard deviation of the cloud around `start` [m].

        Raises:
            InputError: for a start point outside the region, within keep_out of a microphone, or of another shape.
        """
        if not 0 <= start_std < math.inf:
            raise InputError(f"start_std must be finite and not negative, got {start_std}")
        noise = self.filter.noise(seeds)
        if start is None:
            belief = self.filter.spread_over(self.region, noise)
        else:
            if start.shape[-1] != self.region.axes or not self.region.contains(start).all():
                raise InputError(f"start {start.tolist()} is not inside the region {_described(self.region)}")
            if not self.filter.likelihood.possible(start).all():
                raise InputError(f"start {start.tolist()} is where no talker can be: within keep_out of a microphone")
            if start.ndim > 1 and start.shape[:-1] != noise.batch:
                raise InputError(f"start must be one point or one for each of seeds {noise.batch}, got {start.shape}")
            point = start.expand(*noise.batch, self.region.axes)
            belief = self.filter.spread_around(point, noise, std=start_std)
        return TrackerState(belief, noise, None, 0)

    def step(self, state: TrackerState, samples: Tensor) -> tuple[TrackerState, Track | None]:
        """Hear the next `samples` (*batch, M, n), of any length n; the track is None if no frame got full."""
        recordings, seeds = tuple(samples.shape[:-2]), state.noise.batch
        if seeds[: len(recordings)] != recordings:
            sizes = "".join(f"{n}, " for n in recordings)
            raise InputError(f"seeds must have shape ({sizes}*runs) for these recordings, got {seeds}")
        heard, observations = self.front_end.step(state.front_end, samples)
        new = observations.speech.shape[0]
        if new == 0:
            return state._replace(front_end=heard), None
        runs = len(seeds) - len(recordings)
        belief, track = self.filter.advance(state.belief, _for_runs(observations, runs), self.dt, state.noise)
        frame = state.frames + torch.arange(new, dtype=torch.float64)
        middle = (frame * self.front_end.stft.hop + self.front_end.stft.frame_length / 2) / self.fs
        speech = observations.speech.reshape(*observations.speech.shape, *[1] * runs).expand(track.ess.shape)
        track = track._replace(time=middle, speech=speech)
        return TrackerState(belief, state.noise, heard, state.frames + new), track

    def stream(self, blocks: Iterable[Tensor], state: TrackerState) -> Iterator[Track]:
        """Yield the track of each of consecutive `blocks` of samples, in memory that does not grow."""
        for samples in blocks:
            state, track = self.step(state, samples)
            if track is not None:
                yield track

    def forward(
        self, samples: Tensor, seeds: Tensor | int = 0, start: Tensor | None = None, *, block: float = 1.0
    ) -> Track:
        """Return the track of whole recordings `samples` (*batch, M, n).

        Args:
            samples: Sound pressure on any scale.
            seeds: One run for each, (*batch, *runs).
            start: As in `begin`.
            block: Samples are worked on in pieces of this length [s]; the numbers do not depend on it.

        Raises:
            InputError: if the samples are shorter than a frame.
        """
        state = self.begin(seeds, start)
        pieces = list(self.stream(samples.split(max(1, round(block * self.fs)), -1), state))
        if not pieces:
            length = self.front_end.stft.frame_length
            raise InputError(f"samples are shorter than a frame: {samples.shape[-1]} of {length}")
        return join(pieces)


def _for_runs(observations: Observations, runs: int) -> Observations:
    """Append `runs` batch axes of size one, over which the observations are shared."""
    gcc, speech = observations
    batch = speech.shape
    return Observations(gcc.reshape(*batch, *[1] * runs, *gcc.shape[-2:]), speech.reshape(*batch, *[1] * runs))


def _described(region: Region) -> str:
    axes = zip("xyz", region.low, region.high, strict=False)
    return ", ".join(f"{axis} {low:g} to {high:g} m" for axis, low, high in axes)
