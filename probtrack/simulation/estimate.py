"""What a data set will cost, before it is made."""

import time
from pathlib import Path
from typing import NamedTuple

import torch

from probtrack._threads import one_thread
from probtrack.geometry import MicrophoneArray
from probtrack.simulation.data_set import DataSet, missing_scenes
from probtrack.simulation.motion import Motion
from probtrack.simulation.rooms import SPEECH, ResponseCache, ShoeboxRoom
from probtrack.simulation.rooms.cache import Node
from probtrack.simulation.rooms.direct import direct_sound
from probtrack.simulation.scenes import Scene

_SURVEYED = 40  # scenes whose ways are drawn; the rest are taken to be like them
_MORE_PLACES = 3.0  # times the places of those scenes at most: then the room is full
_WAY_RATE = 100.0  # Hz
_DRAWN = 1.0  # s, to draw a way and what is said
_OVER_DIRECT = 3.5  # time of a scene over that of its direct sound: reflections, voices, noise, files
_PER_RECORDING = 0.15  # s: noise, faults and files


_Key = tuple[ShoeboxRoom, str, int, str, int]  # what the responses depend on; the last is 0 where scenes share them


class Estimate(NamedTuple):
    """What is left to do of a data set.

    Attributes:
        recordings: That are to be made.
        done: That are there.
        seconds: Of one process [s].
        audio_bytes: That the recordings will take.
        responses: Places whose responses are to be computed; 0 for measured ones.
        response_bytes: That these will take in the cache.
    """

    recordings: int
    done: int
    seconds: float
    audio_bytes: int
    responses: int
    response_bytes: int


def estimate(data_set: DataSet, folder: Path, cache: ResponseCache) -> Estimate:
    """Return what is left to do of `data_set` in `folder`, by drawing ways and timing small parts of the work.

    The ways of the first 40 scenes are drawn. Of more scenes the number of responses is a guess, rather too high.
    """
    ratios = len(data_set.snr_db or (None,))
    todo = missing_scenes(data_set, folder)
    surveyed = todo[:_SURVEYED]
    wanted: dict[_Key, set[Node]] = {}
    rooms: dict[_Key, tuple[Scene, MicrophoneArray]] = {}
    audio_bytes, seconds = 0, 0.0
    for number, template in enumerate(data_set.scenes):
        same = [index for index in surveyed if index % len(data_set.scenes) == number]
        if not same:
            continue
        array = template.load_array()
        audio_bytes += len(same) * ratios * array.num_microphones * round(template.duration * template.fs) * 2
        direct = _direct_seconds(template, array) * template.duration * template.num_talkers
        seconds += len(same) * (_OVER_DIRECT * direct + _DRAWN)
        if isinstance(template.room, ShoeboxRoom) and template.room.t60 > 0:
            scenes = [next(iter(data_set.recordings(index).values())) for index in same]
            ways = template.motions([scene.seed for scene in scenes], _WAY_RATE).position
            for run, scene in enumerate(scenes):
                apart = 1 + run if scene.faults.position_std > 0 else 0
                key: _Key = (template.room, template.array, template.fs, template.directivity, apart)
                rooms[key] = scene, scene.true_array()
                wanted.setdefault(key, set()).update(template.room.nodes(ways[:, run]))
    scale = len(todo) / max(1, len(surveyed))
    more = min(scale, _MORE_PLACES)
    places, place_bytes, place_seconds = 0.0, 0.0, 0.0
    for key, (scene, array) in rooms.items():
        count, size, cost = _responses(scene, array, wanted[key], cache)
        times = scale if key[-1] else more
        places, place_bytes = places + times * count, place_bytes + times * size
        place_seconds += times * cost
    recordings = len(todo) * ratios
    return Estimate(
        recordings,
        data_set.count * ratios - recordings,
        scale * seconds + recordings * _PER_RECORDING + place_seconds,
        round(scale * audio_bytes),
        round(places),
        round(place_bytes),
    )


def _responses(scene: Scene, array: MicrophoneArray, nodes: set[Node], cache: ResponseCache) -> tuple[int, int, float]:
    """Return how many of the nodes' responses are missing, their bytes and the time to compute them [s]."""
    assert isinstance(scene.room, ShoeboxRoom)
    directivity = SPEECH if scene.directivity == "speech" else None
    missing = scene.room.missing(nodes, array, scene.fs, directivity, cache)
    if not missing:
        return 0, 0, 0.0
    compute = scene.room.responses(array, scene.fs, directivity, None)
    with one_thread():
        begin = time.perf_counter()
        response = compute(missing[0])
        first = time.perf_counter() - begin
        begin = time.perf_counter()
        compute(missing[-1])
        each = time.perf_counter() - begin
    return len(missing), len(missing) * 2 * response.numel(), first + each * len(missing)


def _direct_seconds(scene: Scene, array: MicrophoneArray) -> float:
    """Return how long the direct sound of a second of one talker takes here [s]."""
    place, nothing = torch.tensor(scene.room.region.high) / 2, torch.zeros(scene.fs)
    motion = Motion(place.expand(scene.fs, 3), torch.zeros(scene.fs, 3), nothing, nothing)
    with one_thread():
        begin = time.perf_counter()
        direct_sound(torch.randn(scene.fs), motion, array.positions, SPEECH, scene.fs, 343.0)
        return time.perf_counter() - begin
