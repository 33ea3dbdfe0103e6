"""What talkers of a scene do, at the centre of each frame, and the file it goes to."""

import csv
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from probtrack.geometry import azimuth
from probtrack.simulation.motion import Motion
from probtrack.simulation.voices import Speech

FRAME, HOP = 0.032, 0.016
"""Length of the frames that the truth is given for, and the way from one to the next [s]."""

_SCORE_COLUMNS = ("time", "track", "f0", "f1", "f2", "f3", "b1", "b2", "b3", "voicing", "vowel")


class Truth(NamedTuple):
    """What K talkers do at the centre of each of T frames.

    Attributes:
        time: (T,) [s].
        motion: Of the mouths, batch (K,).
        azimuth: (T, K), of the mouths, seen from the centre of the array [rad].
        speech: (T, K) bool.
    """

    time: Tensor
    motion: Motion
    azimuth: Tensor
    speech: Tensor

    @classmethod
    def of(cls, motion: Motion, speech: list[Speech], origin: Tensor, fs: int) -> "Truth":
        """Return the truth of talkers in `motion` (S, K) who give `speech`, seen from `origin` (3,)."""
        size = motion.position.shape[0]
        count = max(0, (size - round(FRAME * fs)) // round(HOP * fs)) + 1
        centre = (round(FRAME * fs) // 2 + round(HOP * fs) * torch.arange(count)).clamp(max=size - 1)
        active = torch.stack([one.active for one in speech], -1)
        at = motion.every(centre)
        return cls(centre.double() / fs, at, azimuth(at.position, origin.to(at.position)), active[centre])

    def save(self, path: str | Path) -> None:
        """Write the rows as CSV in the columns of a track file, talkers numbered from 1."""
        with Path(path).open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            names = ("x", "y", "z", "azimuth", "heading", "speech", "vx", "vy", "vz", "body")
            writer.writerow(["time", "track", *names])
            angles = torch.stack([self.azimuth, self.motion.mouth], -1).double()
            after = torch.cat([self.motion.velocity, self.motion.body[..., None]], -1).double()
            rows = torch.cat([self.motion.position.double(), angles], -1).tolist()
            for t, row, speech, rest in zip(
                self.time.tolist(), rows, self.speech.tolist(), after.tolist(), strict=True
            ):
                for k, (numbers, talks, more) in enumerate(zip(row, speech, rest, strict=True), 1):
                    writer.writerow([f"{t:.6f}", k, *map(_decimal, numbers), int(talks), *map(_decimal, more)])


def save_scores(path: str | Path, speech: list[Speech]) -> None:
    """Write what synthetic voices do as CSV, one row every 5 ms of each talker; nothing for recorded voices."""
    known = [(k, one.score) for k, one in enumerate(speech, 1) if one.score is not None]
    if not known:
        return
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_SCORE_COLUMNS)
        for k, score in known:
            columns = (score.time, score.f0, *score.formants.unbind(-1), *score.bandwidths.unbind(-1), score.voicing)
            for (t, *row), vowel in zip(torch.stack(columns, -1).tolist(), score.vowel.tolist(), strict=True):
                writer.writerow([f"{t:.6f}", k, *(f"{value:.4g}" for value in row), int(vowel)])


def _decimal(value: float) -> str:
    return f"{value:.6f}"
