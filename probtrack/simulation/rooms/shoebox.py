"""Rectangular rooms, by the image source method."""

import functools
import importlib.metadata
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from probtrack._checks import check_int
from probtrack.errors import InputError, NotFiniteError
from probtrack.geometry import SPEED_OF_SOUND, MicrophoneArray, Region
from probtrack.simulation.motion import Motion
from probtrack.simulation.rooms.base import Room
from probtrack.simulation.rooms.cache import Node, ResponseCache, rounded
from probtrack.simulation.rooms.direct import LEAD, direct_responses, direct_sound
from probtrack.simulation.rooms.directivity import Directivity
from probtrack.simulation.rooms.images import METHOD, DirectionalResponses, Images, harmonics, image_sources
from probtrack.simulation.rooms.reverberation import COMPLETE, max_order, reach, wall_absorption
from probtrack.simulation.rooms.switching import render_places

_FADE = 0.05  # s, over which the reflections of one place go over into those of the next
_PACE = 2.0  # m/s, and a cell takes no longer than this: who walks must not be between places all the time


@dataclass(frozen=True)
class ShoeboxRoom(Room):
    """Empty rectangular room, all six walls alike at all frequencies, with one corner at the origin.

    The direct sound is exact: delay, loss, Doppler shift and the angle off the mouth's axis follow the talker from
    sample to sample. The reflections are those of the nearest point of a grid, for the direction of the mouth at
    each moment (`DirectionalResponses`), and go over into those of the next point within 50 ms, or as much less as the
    grid is finer than 0.1 m: a moving talker's reflections come without a Doppler shift, with delays right to half a
    diagonal of a cell, and above 2 kHz half a decibel weaker at 1 m/s, since two points sound while one fades.

    Image sources come from pyroomacoustics, and all are there that arrive before the sound has decayed by 40 dB, where
    the responses end. The absorption that gives `t60` is found by bisection, to 5 % on average and 10 % between
    single places; a talker's directivity makes it 3 % longer. Below 20 Hz, where reflections from equal walls add up
    to 30 dB more than elsewhere, they are filtered out.

    Args:
        size: Length, width and height [m].
        t60: Wanted reverberation time [s]; 0 for a room without any reflection.
        spacing: Of the grid that reflections are computed on [m].
        speed_of_sound: [m/s].
    """

    size: tuple[float, float, float]
    t60: float
    spacing: float = 0.1
    speed_of_sound: float = SPEED_OF_SOUND

    def __post_init__(self) -> None:
        if len(self.size) != 3 or not all(math.isfinite(s) and s > 0 for s in self.size):
            raise InputError(f"room: size must be three positive lengths [m], got {self.size}")
        if not (math.isfinite(self.t60) and self.t60 >= 0):
            raise InputError(f"room: t60 must be finite and not negative, got {self.t60}")
        if not (math.isfinite(self.spacing) and self.spacing >= 0.01):
            raise InputError(f"room: spacing must be finite and at least 0.01 m, got {self.spacing}")
        if not (math.isfinite(self.speed_of_sound) and self.speed_of_sound > 0):
            raise InputError(f"room: speed_of_sound must be finite and positive, got {self.speed_of_sound}")

    @property
    def region(self) -> Region:
        return Region((0.0, 0.0, 0.0), self.size)

    def absorption(self, fs: int) -> float:
        """Return the share of the energy that each wall swallows, in (0, 1]."""
        return wall_absorption(self.size, self.t60, fs, self.speed_of_sound) if self.t60 > 0 else 1.0

    def render(
        self,
        signal: Tensor,
        motion: Motion,
        array: MicrophoneArray,
        fs: int,
        *,
        directivity: Directivity | None = None,
        cache: ResponseCache | None = None,
    ) -> Tensor:
        self._check_sound(signal, motion)
        self._check_places(motion.position, array, fs)
        audio = direct_sound(signal, motion, array.positions, directivity, fs, self.speed_of_sound)
        if self.t60 == 0:
            return audio
        nodes, place = torch.unique(self._nearest(motion.position), dim=0, return_inverse=True)
        responses = self.responses(array, fs, directivity, cache)
        turns = harmonics(motion.mouth) if directivity is not None else torch.ones(len(signal), 1)
        return audio + render_places(
            signal,
            place,
            lambda p: responses(tuple(nodes[p].tolist())),
            turns.to(signal),
            fade=min(_FADE, self.spacing / _PACE),
            fs=fs,
            lead=LEAD,
        )

    def impulse_responses(
        self,
        points: Tensor,
        array: MicrophoneArray,
        fs: int,
        *,
        directivity: Directivity | None = None,
        mouth: Tensor | None = None,
    ) -> Tensor:
        """Return (K, M, L), the whole impulse response from each of `points` to each microphone.

        For sources that stand at exactly these points, not at the nearest of the grid. The moment of emission is sample
        `LEAD`. The direct sound falls to 0 from 0.45 to 0.5 of the sampling rate.

        Args:
            points: (K, 3) [m], inside the room.
            array: Microphones at their true places.
            fs: Sampling rate [Hz].
            directivity: Of the sources; None for the same in all directions.
            mouth: (K,), where each source points, counter-clockwise from +x [rad]: with a directivity, and only then.

        Raises:
            InputError: for a point or microphone outside the room, or a mouth that does not fit.
        """
        self._check_places(points, array, fs)
        if points.ndim != 2:
            raise InputError(f"points must have shape (K, 3), got {tuple(points.shape)}")
        if (directivity is None) != (mouth is None):
            raise InputError("mouth must be given for a source with a directivity, and only for one")
        turns = torch.zeros(len(points)) if mouth is None else mouth
        if turns.shape != points.shape[:1] or not turns.isfinite().all():
            raise InputError(f"mouth must be {len(points)} finite angles [rad], got {tuple(turns.shape)}")
        longest = 2 * LEAD + math.ceil(math.hypot(*self.size) / self.speed_of_sound * fs)  # of a direct sound
        heard = direct_responses(
            points,
            array.positions,
            directivity,
            turns,
            length=max(longest, self._length(fs)),
            fs=fs,
            speed_of_sound=self.speed_of_sound,
        )
        if self.t60 > 0:
            reflections = self._reflections(array, fs, directivity)
            weights = harmonics(turns) if directivity is not None else torch.ones(len(points), 1)
            for k, point in enumerate(points):
                heard[k, :, : self._length(fs)] += torch.einsum(
                    "c,cml->ml", weights[k].to(heard), reflections.at(point).to(heard)
                )
        return heard

    def responses(
        self, array: MicrophoneArray, fs: int, directivity: Directivity | None, cache: ResponseCache | None
    ) -> Callable[[Node], Tensor]:
        """Return what gives the reflections (C, M, L) from a point of the grid, read from `cache` if it has them."""
        store = cache.store(self._key(array, fs, directivity)) if cache is not None else None

        @functools.cache
        def computed() -> DirectionalResponses:  # takes a second or two: not made where all is in the cache
            return self._reflections(array, fs, directivity)

        def of(node: Node) -> Tensor:
            known = store.get(node) if store is not None else None
            if known is not None:
                return known
            fresh = computed().at(self._point(node))
            return rounded(fresh) if store is None else store.put(node, fresh)

        return of

    def nodes(self, positions: Tensor) -> set[Node]:
        """Return the points of the grid that a source at `positions` (..., 3) passes."""
        return {tuple(node) for node in torch.unique(self._nearest(positions).reshape(-1, 3), dim=0).tolist()}

    def missing(
        self, nodes: set[Node], array: MicrophoneArray, fs: int, directivity: Directivity | None, cache: ResponseCache
    ) -> list[Node]:
        """Return which of `nodes` have no responses in `cache`."""
        store = cache.store(self._key(array, fs, directivity))
        return [node for node in nodes if not store.has(node)]

    def check_array(self, array: MicrophoneArray) -> None:
        self.check_inside(array.positions, array.name + ": microphone")

    def check_inside(self, points: Tensor, what: str) -> None:
        """Raise `InputError` unless all of `points` (..., 3) are inside the room."""
        if points.shape[-1] != 3:
            raise InputError(f"{what} positions must have shape (..., 3), got {tuple(points.shape)}")
        outside = ~self.region.contains(points)  # a NaN is not inside
        if outside.any():
            place = ", ".join(f"{x:g}" for x in points[outside][0].tolist())
            raise InputError(f"{what} at ({place}) m is outside the room of {self.size} m")

    def _check_places(self, points: Tensor, array: MicrophoneArray, fs: int) -> None:
        check_int(fs, "fs", low=1)
        self.check_inside(points, "talker")
        self.check_array(array)

    def _check_sound(self, signal: Tensor, motion: Motion) -> None:
        if signal.ndim != 1 or len(signal) == 0:
            raise InputError(f"signal must have shape (S,) with S > 0, got {tuple(signal.shape)}")
        if motion.position.shape != (len(signal), 3) or motion.mouth.shape != signal.shape:
            raise InputError(
                f"motion must have positions ({len(signal)}, 3) and mouths ({len(signal)},), "
                f"got {tuple(motion.position.shape)} and {tuple(motion.mouth.shape)}"
            )
        for name, values in (("signal", signal), ("mouth", motion.mouth)):
            if not values.isfinite().all():
                raise NotFiniteError(f"{name} must be finite, got NaN or infinite samples")

    def _nearest(self, positions: Tensor) -> Tensor:
        return (positions.double() / self.spacing).round().long()

    def _point(self, node: Node) -> Tensor:
        """Return where a point of the grid is: those on a wall or beyond it are moved inside."""
        point = torch.tensor(node, dtype=torch.float64) * self.spacing
        edge = min(0.02, *(s / 4 for s in self.size))
        return torch.maximum(point, torch.tensor(edge)).minimum(torch.tensor(self.size) - edge)

    def _length(self, fs: int) -> int:
        return LEAD + math.ceil(self.t60 * COMPLETE / 60 * fs)

    def _reflections(self, array: MicrophoneArray, fs: int, directivity: Directivity | None) -> DirectionalResponses:
        return DirectionalResponses(self._images(array, fs), directivity, self._length(fs), fs, self.speed_of_sound)

    def _images(self, array: MicrophoneArray, fs: int) -> Images:
        order = max_order(self.size, self.t60, self.speed_of_sound)
        far = reach(self.t60, self.speed_of_sound)
        return image_sources(self.size, self.absorption(fs), order, far, array.positions)

    def _key(self, array: MicrophoneArray, fs: int, directivity: Directivity | None) -> dict[str, Any]:
        pattern = None
        if directivity is not None:
            pattern = [list(directivity.bands), list(directivity.depth_db), list(directivity.exponent)]
        return {
            "room": list(self.size),
            "t60": self.t60,
            "spacing": self.spacing,
            "speed_of_sound": self.speed_of_sound,
            "fs": fs,
            "microphones": [[round(x, 6) for x in row] for row in array.positions.tolist()],
            "directivity": pattern,
            "complete_db": COMPLETE,
            "method": METHOD,
            "pyroomacoustics": _version(),
        }


def _version() -> str:
    try:
        return importlib.metadata.version("pyroomacoustics")
    except importlib.metadata.PackageNotFoundError:
        return "none"
