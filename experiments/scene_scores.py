"""How well a tracker does on the scenes of a data set, by reverberation time and signal-to-noise ratio."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from probtrack.metrics import position_error, root_mean_square, track_lost
from probtrack.simulation import SceneFolder
from probtrack.trackers import Tracker

_AT_ONCE = 5  # recordings


class Scores(NamedTuple):
    """Figures of each run of each recording, (recordings, runs).

    Attributes:
        rmse: S1 eq. 7 [m].
        lost: Whether the track is lost at the end, S1 eq. 8.
        away: Share of frames more than 20 cm off.
    """

    rmse: Tensor
    lost: Tensor
    away: Tensor


@torch.no_grad()
def scores(tracker: Tracker, folders: Sequence[SceneFolder], runs: int) -> Scores:
    """Track every recording `runs` times, from around the talker's first position, as S1 does."""
    found = []
    for start in range(0, len(folders), _AT_ONCE):
        group = folders[start : start + _AT_ONCE]
        sounds = [folder.open_recording(tracker.fs).read() for folder in group]
        length = min(sound.shape[-1] for sound in sounds)
        truth = torch.stack([position_of(folder) for folder in group], 1)
        first = truth[0, :, None].float().expand(-1, runs, -1)
        seeds = torch.arange(runs).expand(len(group), runs)
        track = tracker(torch.stack([sound[:, :length] for sound in sounds]), seeds, first)
        frames = min(len(truth), track.num_frames)
        error = position_error(track.position[:frames].double(), truth[:frames, :, None])
        found.append(Scores(root_mean_square(error), track_lost(error, tracker.dt), (error > 0.2).double().mean(0)))
    return Scores._make(torch.cat(column) for column in zip(*found, strict=True))


def position_of(folder: SceneFolder) -> Tensor:
    """Return the true path (T, 2) [m] of a scene's one talker."""
    truth = folder.truth
    assert truth is not None  # simulated scenes have one
    position = truth[0].position
    assert position is not None
    return position[:, :2]


def condition(folder: SceneFolder) -> str:
    """Return the T60 [s] and the signal-to-noise ratio [dB] of a scene."""
    scene = folder.scene
    assert scene is not None
    return f"{scene.room.t60:g} s, {scene.snr_db:g} dB"


def by_condition(folders: Sequence[SceneFolder], found: Scores) -> dict[str, dict[str, float]]:
    """Return means and their standard errors over recordings, of all and by condition."""
    names = [condition(folder) for folder in folders]
    rows = {name: [i for i, other in enumerate(names) if other == name] for name in dict.fromkeys(names)}
    return {name: _row(found, chosen) for name, chosen in {"all": list(range(len(names))), **rows}.items()}


def _row(found: Scores, chosen: list[int]) -> dict[str, float]:
    rmse, lost, away = (column.double()[chosen].mean(-1) for column in found)
    error = math.sqrt(len(chosen))
    return {
        "rmse": round(float(rmse.mean()), 3),
        "rmse_error": round(float(rmse.std() / error), 3),
        "track_loss_percentage": round(100 * float(lost.mean()), 1),
        "track_loss_error": round(100 * float(lost.std() / error), 1),
        "frames_away_percentage": round(100 * float(away.mean()), 1),
        "recordings": len(chosen),
    }
