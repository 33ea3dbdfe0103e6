"""Rooms whose impulse responses were measured."""

import functools
import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from probtrack._checks import as_positive
from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray, Region
from probtrack.simulation.motion import Motion
from probtrack.simulation.rooms.base import Room
from probtrack.simulation.rooms.cache import ResponseCache
from probtrack.simulation.rooms.directivity import Directivity
from probtrack.simulation.rooms.responses import Responses, load_folder, resampled, resampling_lead
from probtrack.simulation.rooms.sofa import load_sofa
from probtrack.simulation.rooms.switching import render_places

_FADE = 0.05  # s
_SAME = 1e-3  # m; within which a microphone counts as the one that was measured with
_AT_ONCE = 1 << 14  # samples of a walk whose distances to all places are held at a time


@dataclass(frozen=True)
class MeasuredRoom(Room):
    """A room, or a head, heard through impulse responses that were measured from some places to its own microphones.

    A source is at the measured place that is nearest at each moment, and fades over to the next within 50 ms: its
    sound jumps there, without Doppler shift. Level, time of flight and the directivity of source and receiver are those
    of the measurement: `directivity` is not heeded, nor where the mouth points.

    Args:
        path: A SOFA file, or a folder of WAV files, one a source position, one channel a microphone, in the order of
            the numbers in their names; beside them one CSV file with the positions (columns x_m, y_m and maybe z_m).
        array_file: Where a folder's microphones are; None for its `array.yaml`. A SOFA file tells its own.
        height: Of sources and microphones in a folder that are given by x and y only [m].
        reach: How far a source may be from the nearest measured place [m].
        clockwise: A SOFA file counts the azimuths of its sources clockwise, against the standard, as some do.
    """

    path: str
    array_file: str | None = None
    height: float = 0.0
    reach: float = 0.3
    clockwise: bool = False

    def __post_init__(self) -> None:
        as_positive(self.reach, "reach")
        if not math.isfinite(self.height):
            raise InputError(f"height must be finite, got {self.height}")
        if self.array_file is not None and Path(self.path).is_file():
            raise InputError(f"array_file goes with a folder of WAV files, not with a SOFA file, got {self.array_file}")

        if self.clockwise and Path(self.path).is_dir():
            raise InputError(f"clockwise goes with a SOFA file, not with a folder, got {self.path}")

    @functools.cached_property
    def responses(self) -> Responses:
        """The responses as they were measured, at their own sampling rate."""
        path = Path(self.path)
        if not path.exists():
            raise InputError(f"{path}: there is no such SOFA file or folder of responses")
        loaded = (
            load_folder(path, self.array_file, self.height)
            if path.is_dir()
            else load_sofa(path, clockwise=self.clockwise)
        )
        return loaded.checked(self.path)

    @property
    def array(self) -> MicrophoneArray:
        """The microphones measured with, three axes: those that `render` must be given."""
        return MicrophoneArray(self.responses.microphones, Path(self.path).stem)

    @property
    def positions(self) -> Tensor:
        """Where sources were measured, (K, 3) [m]."""
        return self.responses.positions.to(torch.get_default_dtype())

    @property
    def fs(self) -> int:
        """Sampling rate of the measurement [Hz]."""
        return self.responses.fs

    @property
    def region(self) -> Region:
        """The box around all measured places; where it is wider than they are dense, parts of it are out of reach."""
        margin = self.reach / math.sqrt(3)  # the corner of such a cube is at the reach
        low, high = self.responses.positions.amin(0) - margin, self.responses.positions.amax(0) + margin
        return Region(tuple(low.tolist()), tuple(high.tolist()))

    def check_array(self, array: MicrophoneArray) -> None:
        own = self.array.positions
        if array.positions.shape != own.shape:
            raise InputError(
                f"{self.path}: responses were measured with {len(own)} microphones on 3 axes, got "
                f"{array.num_microphones} on {array.axes}"
            )
        off = torch.linalg.vector_norm(array.positions.to(own) - own, dim=-1)
        if off.max() > _SAME:
            k = int(off.argmax())
            raise InputError(
                f"{self.path}: responses were measured with microphone {k + 1} at {_metres(own[k])} and hold for no "
                f"other place (position_std must be 0), got {_metres(array.positions[k])}"
            )

    def render(
        self,
        signal: Tensor,
        motion: Motion,
        array: MicrophoneArray,
        fs: int,
        *,
        directivity: Directivity | None = None,  # noqa: ARG002
        cache: ResponseCache | None = None,  # noqa: ARG002
    ) -> Tensor:
        if motion.position.shape != (len(signal), 3):
            raise InputError(f"motion must have positions ({len(signal)}, 3), got {tuple(motion.position.shape)}")
        self.check_array(array)
        place = self._nearest(motion.position)
        return render_places(
            signal,
            place,
            lambda p: resampled(self.responses.samples[p], self.fs, fs),
            fade=_FADE,
            fs=fs,
            lead=resampling_lead(self.fs, fs),
        )

    def _nearest(self, positions: Tensor) -> Tensor:
        """Return the number (S,) of the place nearest to each of `positions` (S, 3)."""
        if not positions.isfinite().all():
            raise InputError("motion must be finite, got NaN or infinite positions")
        places, nearest = self.positions.to(positions), []
        for some in positions.split(_AT_ONCE):
            distance, number = torch.cdist(some, places, compute_mode="donot_use_mm_for_euclid_dist").min(-1)
            far = int(distance.argmax())
            if distance[far] > self.reach:
                raise InputError(
                    f"{self.path}: a source at {_metres(some[far])} is {float(distance[far]):.2f} m from the nearest "
                    f"measured place, {_metres(places[number[far]])}, and must be within {self.reach:g} m"
                )
            nearest.append(number)
        return torch.cat(nearest)


def _metres(position: Tensor) -> str:
    return "(" + ", ".join(f"{x:.3g}" for x in position.tolist()) + ") m"
