"""The measures of the LOCATA challenge: detections, false alarms, latency, broken tracks and swaps.

They look at talkers while they are active: where the truth knows them, and says speech >= 0.5 if it says so at all.

References:
    C. Evers et al., "The LOCATA challenge: acoustic source localization and tracking", IEEE/ACM Transactions on Audio,
    Speech, and Language Processing 28, 2020, section on measures. The scripts released with it differ at three places,
    where we keep to the definitions: an exchange of two talkers is two swaps (they see none), the wait for the first
    detection is latency and no break (they count it as both), and a track of a talker who is silent is no false alarm
    (to them it is one while nobody else talks).
"""

from abc import ABC, abstractmethod
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from probtrack.errors import InputError
from probtrack.metrics.association import OfSets, associate
from probtrack.metrics.episodes import detected, fragments, latencies, swaps
from probtrack.metrics.metric import Parts
from probtrack.metrics.talkers import Talkers

_GATES = {"position": 0.5, "azimuth": torch.pi / 6}  # m; the 30 degrees of LOCATA


class _Pairs(NamedTuple):
    """Tracks of talkers.

    Attributes:
        track: Which track belongs to each talker (T, *batch, K), -1 for none.
        active: Whether each talks (T, *batch, K).
        known: Whether it is known who is there (T, *batch).
    """

    track: Tensor
    active: Tensor
    known: Tensor


class _Associated(OfSets, ABC):
    """A metric of tracks that are paired with talkers frame by frame."""

    def __init__(self, gate: float | None = None, by: Literal["position", "azimuth"] = "position") -> None:
        super().__init__(_GATES.get(by, 1.0) if gate is None else gate, by)

    def judge(self, estimate: Talkers, truth: Talkers) -> Parts:
        if estimate.num_frames < 2:
            raise InputError(f"metric {self.name} needs two frames or more, got {estimate.num_frames}")
        there = self.present(truth)
        active = there if truth.speech is None else there & (truth.speech >= 0.5)
        distance = self.distance(estimate, truth)
        active = active.expand(distance.shape[:-1])
        known = self.known(truth).expand(distance.shape[:-2])
        return self.judge_pairs(_Pairs(associate(distance, self.limit, active), active, known), estimate)

    @abstractmethod
    def judge_pairs(self, pairs: _Pairs, estimate: Talkers) -> Parts:
        """Return the figure of each run (*batch)."""


class DetectionRate(_Associated):
    """Share of frames of active talkers in which they have a track within the gate.

    Args:
        gate: Largest distance of a track from its talker [m], or angle [rad]; 0.5 m or 30 degrees if not given.
        by: What is compared: positions, or azimuths alone.
    """

    name = "detection_rate"
    unit = "%"

    def judge_pairs(self, pairs: _Pairs, estimate: Talkers) -> Parts:  # noqa: ARG002
        return _rate(detected(pairs.track, pairs.active), pairs.active, 1.0)


class FalseAlarmRate(_Associated):
    """Tracks that belong to nobody, per second of which the truth knows who is there: each counts in every frame.

    A track of a talker who is silent is not one of them. Where nobody is there, every track is.

    Args:
        gate: Largest distance of a track from its talker [m], or angle [rad]; 0.5 m or 30 degrees if not given.
        by: What is compared: positions, or azimuths alone.
    """

    name = "false_alarm_rate"
    unit = "1/s"

    def judge_pairs(self, pairs: _Pairs, estimate: Talkers) -> Parts:
        alarms = self.present(estimate).sum(-1) - (pairs.track >= 0).sum(-1)
        frames = pairs.known.double().sum(0)
        return Parts(alarms.double().where(pairs.known, 0.0).sum(0), frames * estimate.dt)


class Latency(_Associated):
    """Mean time from the onset of a period of activity to its first detection [s].

    Periods without any detection do not count: they show in `DetectionRate`.

    Args:
        gate: Largest distance of a track from its talker [m], or angle [rad]; 0.5 m or 30 degrees if not given.
        by: What is compared: positions, or azimuths alone.
    """

    name = "latency"
    unit = "s"

    def judge_pairs(self, pairs: _Pairs, estimate: Talkers) -> Parts:
        late = latencies(pairs.track, pairs.active, estimate.time)
        known = ~late.isnan()
        return Parts(late.where(known, 0.0).sum((0, -1)), known.double().sum((0, -1)))


class FragmentationRate(_Associated):
    """Breaks per second of a talker's activity: detected again after a miss, or by another track, within a period.

    Args:
        gate: Largest distance of a track from its talker [m], or angle [rad]; 0.5 m or 30 degrees if not given.
        by: What is compared: positions, or azimuths alone.
    """

    name = "fragmentation_rate"
    unit = "1/s"

    def judge_pairs(self, pairs: _Pairs, estimate: Talkers) -> Parts:
        return _rate(fragments(pairs.track, pairs.active), pairs.active, estimate.dt)


class SwapRate(_Associated):
    """Swaps per second of a talker's activity: a talker's track is another than the last one it had.

    Two talkers whose tracks change places are two swaps, one of each; a silence between does not hide them.

    Args:
        gate: Largest distance of a track from its talker [m], or angle [rad]; 0.5 m or 30 degrees if not given.
        by: What is compared: positions, or azimuths alone.
    """

    name = "swap_rate"
    unit = "1/s"

    def judge_pairs(self, pairs: _Pairs, estimate: Talkers) -> Parts:
        return _rate(swaps(pairs.track, pairs.active), pairs.active, estimate.dt)


def _rate(events: Tensor, active: Tensor, dt: float) -> Parts:
    """Return how many events of talkers there are, and for how long these are active (*batch)."""
    return Parts(events.double().sum((0, -1)), active.double().sum((0, -1)) * dt)
