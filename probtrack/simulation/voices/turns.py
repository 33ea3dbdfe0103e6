"""Who speaks when: turns drawn from what people do, or given."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import pairwise

import torch

from probtrack._checks import as_non_negative, as_positive, check_int
from probtrack.errors import InputError

Schedule = list[list[tuple[float, float]]]
"""Start and end [s] of every utterance of every talker, in order."""

_SHORTEST, _LONGEST = -2.1, 3.3  # pauses end here, in standard deviations of their logarithm: 0.3 s and 5 s
_LEAST = 0.25  # of the mean length of an utterance
_SPREAD = 0.5  # standard deviation of the logarithm of a gap and of an overlap
_OVERLAP = 0.4  # s, median; also the largest share of either utterance: so never do more than two speak at once
_REMNANT = 0.3  # s; an utterance that the end would cut shorter does not begin


class Turns(ABC):
    """Who speaks when. A subclass is a frozen dataclass of plain values, so that a scene file can say it."""

    @abstractmethod
    def draw(self, num_talkers: int, duration: float, generator: torch.Generator) -> Schedule:
        """Return start and end [s] of every utterance, one list a talker, in order and apart from each other.

        Args:
            num_talkers: K, at least 1.
            duration: [s]; no utterance ends later.
            generator: Draws the turns; the same seed gives the same.
        """


@dataclass(frozen=True)
class TurnTaking(Turns):
    r"""Turns as in conversation: utterances and pauses, and short gaps where another talker takes over.

    Pauses of a talker within a turn are log-normal, :math:`\ln p \sim N(\ln m, s^2)`, no shorter than a third
    of the median m and no longer than 5 times m (by default 0.3 s to 5 s). An utterance lasts a quarter of its
    mean and three quarters of an Erlang variable of order 2; its mean is that of the pauses times
    `active_share / (1 - active_share)`. The defaults are those of the talkers of the LOCATA challenge: active 65
    to 70 % of the time, pauses with a median of 0.8 to 1 s and a 90th percentile of 1.5 to 2 s. A turn has a
    geometric number of utterances; one who has not spoken yet comes next. At most two speak at once.

    Args:
        active_share: Share of the time that a talker who has the floor speaks, in (0, 1).
        pause_median: Median pause between two utterances of a turn [s].
        pause_p90: Length that one pause in ten exceeds [s].
        gap: Median silence between the turns of two talkers [s].
        overlap: Share of the changes of talker at which the next begins before the last has ended, in [0, 1].
        utterances_a_turn: Mean number of utterances until another talker takes over, at least 1.

    References:
        S. C. Levinson, F. Torreira, "Timing in turn-taking and its implications for processing models of
        language", Front. Psychol. 6:731, 2015, for the gap; the lengths of overlaps (median 0.4 s) and of turns
        are our choice.
    """

    active_share: float = 0.675
    pause_median: float = 0.9
    pause_p90: float = 1.75
    gap: float = 0.2
    overlap: float = 0.0
    utterances_a_turn: float = 2.0

    def __post_init__(self) -> None:
        if not 0 < self.active_share < 1:
            raise InputError(f"active_share must be in (0, 1), got {self.active_share}")
        if not 0 <= self.overlap <= 1:
            raise InputError(f"overlap must be in [0, 1], got {self.overlap}")
        as_positive(self.pause_median, "pause_median")
        as_non_negative(self.gap, "gap")
        if not self.pause_median < self.pause_p90 < math.inf:
            raise InputError(f"pause_p90 must be finite and above pause_median, got {self.pause_p90}")
        if not 1 <= self.utterances_a_turn < math.inf:
            raise InputError(f"utterances_a_turn must be finite and at least 1, got {self.utterances_a_turn}")

    def draw(self, num_talkers: int, duration: float, generator: torch.Generator) -> Schedule:
        check_int(num_talkers, "num_talkers", low=1)
        as_positive(duration, "duration")
        schedule: Schedule = [[] for _ in range(num_talkers)]
        talker = _choose(num_talkers, generator)
        start = min(0.1 + 0.3 * _uniform(generator), duration / 10)  # trackers begin with the talker
        length = self._utterance(generator)
        while start < duration - _REMNANT or not any(schedule):
            schedule[talker].append((start, min(start + length, duration)))
            following = self._utterance(generator)
            if num_talkers > 1 and _uniform(generator) < 1 / self.utterances_a_turn:
                talker = _next_talker(schedule, talker, generator)
                start += length + self._gap(min(length, following), generator)
            else:
                start += length + self._pause(generator)
            length = following
        return schedule

    @property
    def _pause_spread(self) -> float:
        return math.log(self.pause_p90 / self.pause_median) / 1.2815515655446004  # the normal 90 % quantile

    def _pause(self, generator: torch.Generator) -> float:
        z = min(max(_normal(generator), _SHORTEST), _LONGEST)
        return self.pause_median * math.exp(self._pause_spread * z)

    def _mean_pause(self) -> float:
        s, low, high = self._pause_spread, _SHORTEST, _LONGEST
        middle = math.exp(s * s / 2) * (_cdf(high - s) - _cdf(low - s))
        return self.pause_median * (math.exp(s * low) * _cdf(low) + middle + math.exp(s * high) * _cdf(-high))

    def _utterance(self, generator: torch.Generator) -> float:
        mean = self._mean_pause() * self.active_share / (1 - self.active_share)
        erlang = -math.log((1 - _uniform(generator)) * (1 - _uniform(generator))) / 2
        return mean * (_LEAST + (1 - _LEAST) * erlang)

    def _gap(self, shorter: float, generator: torch.Generator) -> float:
        """Return the silence before the next talker [s], below 0 if the two overlap."""
        factor = math.exp(_SPREAD * _normal(generator))
        if _uniform(generator) < self.overlap:
            return -min(_OVERLAP * factor, _OVERLAP * shorter)
        return self.gap * factor


@dataclass(frozen=True)
class GivenTurns(Turns):
    """Utterances that are known: a script, or the annotation of a recording.

    Args:
        utterances: (talker, start, end) of each, talkers counted from 0, times in [s].
            What lies beyond the end of a shorter scene is cut.
    """

    utterances: tuple[tuple[int, float, float], ...]

    def __post_init__(self) -> None:
        for talker, start, end in self.utterances:
            check_int(talker, "utterances: talker", low=0)
            if not 0 <= start < end < math.inf:
                raise InputError(f"utterances: start and end must be 0 <= start < end, got {start} and {end}")
        ordered = sorted(self.utterances)
        for (talker, _, end), (other, start, _) in pairwise(ordered):
            if talker == other and start < end:
                raise InputError(
                    f"utterances of talker {talker} must not overlap, got one to {end} s and from {start} s"
                )

    def draw(self, num_talkers: int, duration: float, generator: torch.Generator) -> Schedule:  # noqa: ARG002 (given)
        check_int(num_talkers, "num_talkers", low=1)
        as_positive(duration, "duration")
        highest = max((talker for talker, _, _ in self.utterances), default=0)
        if highest >= num_talkers:
            raise InputError(f"utterances: talker must be below the number of talkers {num_talkers}, got {highest}")
        schedule: Schedule = [[] for _ in range(num_talkers)]
        for talker, start, end in sorted(self.utterances):
            if start < duration:
                schedule[talker].append((start, min(end, duration)))
        return schedule


def _next_talker(schedule: Schedule, talker: int, generator: torch.Generator) -> int:
    """Draw one of those who have not spoken yet, or else one of the others."""
    others = [k for k in range(len(schedule)) if k != talker]
    waiting = [k for k in others if not schedule[k]] or others
    return waiting[_choose(len(waiting), generator)]


def _choose(count: int, generator: torch.Generator) -> int:
    return int(torch.randint(count, (), generator=generator))


def _uniform(generator: torch.Generator) -> float:
    return float(torch.rand((), generator=generator, dtype=torch.float64))


def _normal(generator: torch.Generator) -> float:
    return float(torch.randn((), generator=generator, dtype=torch.float64))


def _cdf(z: float) -> float:
    return 0.5 * math.erfc(-z / math.sqrt(2))
