"""The ways that talkers take in the recordings of the three papers.

The papers print their ways as figures, if at all: what their text says is kept, and what it does not say is ours.
Every way takes whatever duration is asked for.
"""

import math

import torch

from probtrack.errors import InputError
from probtrack.geometry import wrap_angle
from probtrack.simulation.trajectories.paths import GivenPaths
from probtrack.simulation.trajectories.turning import FacingPoint, InTurn, Turning, TurningTo, Waiting
from probtrack.simulation.trajectories.ways import Arc, Point, Standing, Through, Way

_LEHMANN_HEIGHT = 1.51
_LEHMANN: tuple[Way, ...] = (
    Through(tuple((x, y, _LEHMANN_HEIGHT) for x, y in ((0.85, 0.95), (1.55, 1.25), (2.1, 1.7), (2.45, 2.3)))),
    Through(((2.6, 0.75, _LEHMANN_HEIGHT), (0.9, 2.35, _LEHMANN_HEIGHT))),
    Arc((1.75, 1.55, _LEHMANN_HEIGHT), radius=0.85, start=-2.4, end=0.9),
    Through(tuple((x, y, _LEHMANN_HEIGHT) for x, y in ((0.9, 2.3), (1.35, 1.2), (2.0, 1.9), (2.6, 0.8)))),
    Through(tuple((x, y, _LEHMANN_HEIGHT) for x, y in ((2.55, 2.35), (1.5, 2.25), (1.1, 1.75), (1.2, 0.8)))),
)

_FALLON_HEIGHT = 1.2
_FALLON_PLACE = (2.7, 3.9, _FALLON_HEIGHT)
_FALLON: tuple[Way, ...] = (
    Through(((1.0, 0.8, _FALLON_HEIGHT), (1.3, 5.2, _FALLON_HEIGHT))),
    Through(tuple((x, y, _FALLON_HEIGHT) for x, y in ((1.4, 5.2), (1.9, 3.6), (2.2, 2.0), (3.4, 1.2), (4.6, 1.5)))),
    Through(tuple((x, y, _FALLON_HEIGHT) for x, y in ((1.2, 1.2), (3.0, 1.4), (3.9, 2.6), (2.8, 3.7), (3.2, 5.1)))),
    Through(
        tuple(
            (x, y, _FALLON_HEIGHT) for x, y in ((1.6, 4.9), (3.3, 4.9), (4.5, 3.8), (4.6, 1.9), (4.1, 1.5), (3.7, 2.1))
        )
    ),
    InTurn(
        (
            TurningTo(Standing(_FALLON_PLACE), -math.pi / 2, math.pi),
            TurningTo(Standing(_FALLON_PLACE), math.pi, -math.pi / 4),
        ),
        (0.55, 0.45),
    ),
)

_KLAASSEN_HEIGHT = 1.6
_PAIR = (2.6, 2.25)
_NEAR = 1.0  # m, where two cross in front of the pair


def lehmann2007_way(number: int) -> GivenPaths:
    """Return one of five ways through the square of S1's microphones, to be walked in about 8 s.

    Printed: the room of 3.5 x 3.1 x 2.2 m, the square of 2.52 m and its height of 1.51 m, five different ways, one of
    them drawn in Figure 3 as a bent line across the array, walked in 7.8 s. Ours: where the lines run. Way 1 is
    like that figure, 2.2 m long; 2 is straight, 3 an arc, 4 and 5 are bent to both sides and to one. Every way
    is at the microphones' height and 0.3 m from them at least; the mouth points the way the talker goes.

    Args:
        number: 1 to 5.

    References:
        S1 section 5.1 and Figure 3; section 5.4 for the five.
    """
    return GivenPaths((_numbered(_LEHMANN, number),))


def fallon2006_way(number: int) -> GivenPaths:
    """Return one of the five ways of S2's Table 1, to be taken in 20 to 30 s.

    Printed: the room of 5.5 x 6.1 x 2.8 m; ways 1 to 4, numbered from left to right, at about constant speed, the
    source pointing the way it moves, and 1 not changing its direction as it crosses the room; 5 turning on the
    spot at (2.7, 3.9). Ours: where 1 to 4 run (Figure 6), of which 4 ends in a quick turn, as told of Figure 5;
    how 5 turns, to the left by three quarters of a turn and more than half a turn back; and the height of the
    source, a loudspeaker that was carried, at that of the microphones, 1.2 m.

    Args:
        number: 1 to 5.

    References:
        S2 section 6, Figures 4 to 6.
    """
    return GivenPaths((_numbered(_FALLON, number),))


def klaassen2005_ways(name: str) -> GivenPaths:
    """Return the ways of one or two talkers before S3's pair of microphones, in a recording of 20 to 45 s.

    The room is 2.8 x 4.5 m, the pair at x = 2.6 m, y = 2.1 and 2.4 m and 1.5 m high, and looks along -x. A broadside
    angle is positive towards the first microphone, which is to the left as the pair looks: so S3 has it in
    section 2.5. Section 2.3.1 has the left at negative angles; the sign of an angle is kept here, not the word.

    - ``arc``: waits 0.5 m in front of the pair, then walks in the first half of an arc to a corner and has been
      there since half-way through the recording. Printed: about 3 m away at "-90 degrees", drawn as -0.78 rad: only
      the latter is a corner of this room. Here 2.9 m at -0.76 rad.
    - ``corner``: stands at -0.9 rad. Printed: about 3 m away, which is beyond the wall; here 2.55 m.
    - ``crossing``: two walk from the two corners, stay in front of the pair for a moment, about 1 m away, one behind
      the other, and walk on faster to the other corner.
    - ``approach``: one stands in front of the pair, the other walks up to him from -0.9 rad.
    - ``turn-back``: two come from the two corners, meet in front of the pair and go back without crossing.
    - ``across``: one walks from 0.78 to -0.78 rad at an even pace (section 2.5).

    Ours: all times, the curves, distances to walls (0.25 m at least), the height of the mouths, 1.6 m, and that all
    speak to the pair: the mouth points there all the time, and the body the way the talker goes.

    Args:
        name: As above; ``crossing``, ``approach`` and ``turn-back`` have two talkers.

    References:
        S3 sections 2.3.1, 2.5, 5.3 and 5.6; that two cross about 1 m away is in the conclusions (section 6).
    """
    ways = _klaassen()
    if name not in ways:
        raise InputError(f"name must be one of {', '.join(ways)}, got {name!r}")
    return GivenPaths(tuple(FacingPoint(way, _PAIR) for way in ways[name]))


def _klaassen() -> dict[str, tuple[Way, ...]]:
    left, right = _beside(2.55, 0.9), _beside(2.55, -0.9)
    front, behind = _beside(_NEAR - 0.1, 0.0), _beside(_NEAR + 0.45, 0.0)
    nearly = _beside(_NEAR, 0.28), _beside(_NEAR, -0.28)
    corner = _beside(2.9, -0.761)
    bend = _beside(1.75, 0.6), _beside(1.75, -0.6)
    far_bend = _beside(1.95, 0.5), _beside(1.95, -0.5)
    arc = Through((_beside(0.5, 0.0), _beside(1.3, -0.25), _beside(2.15, -0.6), corner))
    return {
        "arc": (Waiting(arc, before=0.15, after=0.5),),
        "corner": (Standing(right, math.pi / 2),),
        "crossing": (
            _pausing(left, bend[0], front, bend[1], right),
            _pausing(right, far_bend[1], behind, far_bend[0], left),
        ),
        "approach": (
            Turning(Standing(_beside(_NEAR, 0.0)), 0.0),
            Waiting(Through((right, _beside(1.75, -0.6), _beside(_NEAR, -0.55))), before=0.2, after=0.2),
        ),
        "turn-back": (_returning(left, bend[0], nearly[0]), _returning(right, bend[1], nearly[1])),
        "across": (Waiting(Through((_beside(2.0, 0.78), _beside(1.45, 0.0), _beside(2.0, -0.78))), 0.05, 0.05),),
    }


def _pausing(begin: Point, first: Point, middle: Point, last: Point, end: Point) -> Way:
    """Return a way that stays in the middle for a moment, and goes on faster."""
    out, on = Through((begin, first, middle)), Through((middle, last, end))
    return Waiting(InTurn((out, _turn(out, on), on), (0.7, 0.1, 0.2)), before=0.1, after=0.15)


def _returning(begin: Point, bend: Point, end: Point) -> Way:
    """Return a way there and, after turning round on the spot, back."""
    out, back = Through((begin, bend, end)), Through((end, bend, begin))
    return Waiting(InTurn((out, _turn(out, back), back), (0.45, 0.1, 0.45)), before=0.15, after=0.15)


def _turn(before: Through, after: Through) -> Way:
    """Return the turn on the spot from the end of one way to the beginning of the next, the shorter way round."""
    ends = torch.tensor([0.0, 60.0], dtype=torch.float64)
    start, end = before.at(ends, 60.0).body[-1], after.at(ends, 60.0).body[0]
    return TurningTo(Standing(before.points[-1]), float(start), float(start + wrap_angle(end - start)))


def _beside(distance: float, broadside: float) -> Point:
    """Return the place at a distance [m] and broadside angle [rad] from the middle of S3's pair."""
    x, y = _PAIR  # looks along -x; its first microphone is towards -y
    return x - distance * math.cos(broadside), y - distance * math.sin(broadside), _KLAASSEN_HEIGHT


def _numbered(ways: tuple[Way, ...], number: int) -> Way:
    if isinstance(number, bool) or number not in range(1, len(ways) + 1):
        raise InputError(f"number must be from 1 to {len(ways)}, got {number}")
    return ways[number - 1]
