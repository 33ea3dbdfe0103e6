"""Switching models that the papers describe, and one of a well-known robot-audition system."""

from collections.abc import Callable

from probtrack._checks import as_positive
from probtrack.dynamics import (
    CoordinateUncoupled,
    DrivenVelocity,
    Dynamics,
    RandomWalk,
    TimeCorrelated,
    euler,
    lehmann2007,
)
from probtrack.switching.chain import MarkovChain
from probtrack.switching.dynamics import SwitchingDynamics

_SPEECH, _SILENCE = [[0.99, 0.01], [0.99, 0.01]], [[0.01, 0.99], [0.01, 0.99]]


def speech_and_silence(axes: int = 2, *, dt: float = 0.032) -> SwitchingDynamics:
    """Return a talker who is tracked as usual in speech and goes straight on in silence.

    CU-LAN while speaking, a velocity that is all but constant (0.02 m/s per sqrt(s)) in silence. The mode follows
    the probability of speech with 99 % in each frame of `dt`; S1 has no figures for it.

    References:
        S1 section 3.3: "use a normal tracking model during periods of speech activity, and switch to a purely
        constant-velocity model during silences".
    """
    straight = CoordinateUncoupled(DrivenVelocity(RandomWalk(0.02)), axes)
    return SwitchingDynamics([lehmann2007("CU-LAN", axes), straight], _listening(dt))


def teleconference(axes: int = 2, *, dt: float = 0.032) -> SwitchingDynamics:
    """Return a talker at a table, who shifts in the seat while speaking and stays put in silence.

    CU-LAN-ORIG while speaking; in silence a velocity of 2 cm/s that lasts a tenth of a second, so that the cloud
    cannot follow noise. The mode follows the probability of speech as in `speech_and_silence`.

    References:
        S1 section 3.3, last paragraph, which gives no figures.
    """
    still = CoordinateUncoupled(DrivenVelocity(TimeCorrelated(rate=10.0, std=0.02)), axes)
    return SwitchingDynamics([lehmann2007("CU-LAN-ORIG", axes), still], _listening(dt))


def odas(axes: int = 2, *, distance: float = 1.0, dt: float = 0.032) -> SwitchingDynamics:
    """Return the three regimes of ODAS's particle filter: stationary, constant velocity, accelerating.

    Langevin motion by Euler steps with (rate [1/s], speed): (2.0, 0.04) in 50 % of frames, (0.05, 0.2) in 30 % and
    (0.5, 0.2) in 20 %, drawn anew in each frame of `dt`.

    Args:
        axes: Number of coordinates A.
        distance: ODAS moves directions on a sphere of radius 1; its speeds are multiplied by this distance of a
            talker from the array [m].
        dt: Time step that the chain is for [s].

    References:
        F. Grondin, F. Michaud, "Lightweight and optimized sound source localization and tracking methods for open
        and closed microphone array configurations", Robotics and Autonomous Systems 113, 2019; the values are
        those of the program's own configuration.
    """
    distance = float(as_positive(distance, "distance"))
    regimes = [(2.0, 0.04), (0.05, 0.2), (0.5, 0.2)]
    models = [
        CoordinateUncoupled(DrivenVelocity(TimeCorrelated(rate, speed * distance), euler), axes)
        for rate, speed in regimes
    ]
    shares = [0.5, 0.3, 0.2]
    return SwitchingDynamics(models, MarkovChain(shares, [shares] * 3, dt=dt))


def moving_and_stopped(
    axes: int = 2, *, moving: float = 3.0, stopped: float = 2.0, dt: float = 0.032
) -> SwitchingDynamics:
    """Return a talker who walks and stands: friction stops the talker once the driving force is gone.

    Langevin motion by Euler steps with beta = 10 /s and a speed of 1 m/s r.m.s. per axis while moving; the same
    friction and no noise while stopped. A particle that stands spreads again once it moves.

    Args:
        axes: Number of coordinates A.
        moving: Mean time on the move [s]. S3 has a chain p(i_t | i_{t-1}) without figures.
        stopped: Mean time standing [s].
        dt: Time step that the chain is for [s].

    References:
        S3 eq. A.1 to A.5. It lets the force have variance sigma_x^2 with sigma_x = 5 beside v_x = 1 m/s, which
        would make 5 m/s r.m.s.; here v_x alone is the speed, as in the paper it cites (Vermaak and Blake 2001).
    """
    models: list[Dynamics] = [
        CoordinateUncoupled(DrivenVelocity(TimeCorrelated(rate=10.0, std=std), euler), axes) for std in (1.0, 0.0)
    ]
    return SwitchingDynamics(models, MarkovChain.dwelling([moving, stopped], dt=dt))


PRESETS: dict[str, Callable[..., SwitchingDynamics]] = {
    "speech-silence": speech_and_silence,
    "teleconference": teleconference,
    "odas": odas,
    "moving-stopped": moving_and_stopped,
}
"""Name -> switching model, called with the number of axes and the time between frames, `(axes, dt=...)`."""


def _listening(dt: float) -> MarkovChain:
    # begun as in silence: half a cloud pushed in the first frame would be seen for seconds
    return MarkovChain(_SILENCE[0], _SPEECH, silence=_SILENCE, dt=dt)
