"""The sounds that a synthetic voice knows."""

from typing import NamedTuple

VOWELS: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "i": ((270, 2290, 3010), (80, 120, 300)),
    "I": ((390, 1990, 2550), (100, 120, 300)),
    "E": ((530, 1840, 2480), (120, 140, 300)),
    "@": ((660, 1720, 2410), (140, 200, 300)),
    "a": ((730, 1090, 2440), (160, 80, 300)),
    "c": ((570, 840, 2410), (120, 200, 240)),
    "U": ((440, 1020, 2240), (120, 200, 200)),
    "u": ((300, 870, 2240), (100, 140, 200)),
    "A": ((640, 1190, 2390), (140, 140, 300)),
    "R": ((490, 1350, 1690), (80, 120, 120)),
}
"""Formants F1 to F3 and their bandwidths [Hz] of a man's vowels: Klaassen 2005, Tables 3.1 and 3.2."""


class Consonant(NamedTuple):
    """How a syllable begins.

    Attributes:
        voicing: Amplitude of the voice [-].
        friction: Amplitude of the noise while it lasts [-].
        burst: Amplitude of the noise at its end [-].
        aspiration: Amplitude of the breath after it, as the voice sets in [-].
        centre: Of the noise [Hz].
        width: Of the noise [Hz].
        locus: F1 to F3 from which the formants of the vowel come [Hz].
    """

    voicing: float
    friction: float
    burst: float
    aspiration: float
    centre: float
    width: float
    locus: tuple[float, float, float]


CONTINUANTS: dict[str, Consonant] = {
    "s": Consonant(0.0, 0.50, 0.50, 0.0, 5500.0, 2000.0, (320.0, 1700.0, 2600.0)),
    "S": Consonant(0.0, 0.45, 0.45, 0.0, 3000.0, 1200.0, (320.0, 1800.0, 2500.0)),
    "f": Consonant(0.0, 0.12, 0.12, 0.0, 6500.0, 5000.0, (320.0, 1100.0, 2300.0)),
    "h": Consonant(0.0, 0.05, 0.05, 0.2, 1500.0, 1500.0, (500.0, 1500.0, 2500.0)),
    "z": Consonant(0.3, 0.20, 0.20, 0.0, 5500.0, 2000.0, (280.0, 1700.0, 2600.0)),
    "n": Consonant(0.3, 0.00, 0.00, 0.0, 4000.0, 3000.0, (280.0, 1600.0, 2600.0)),
    "m": Consonant(0.3, 0.00, 0.00, 0.0, 4000.0, 3000.0, (280.0, 1000.0, 2300.0)),
    "l": Consonant(0.5, 0.00, 0.00, 0.0, 4000.0, 3000.0, (350.0, 1200.0, 2700.0)),
}
"""Consonants that sound from their beginning: also the first of an utterance."""

PLOSIVES: dict[str, Consonant] = {
    "p": Consonant(0.0, 0.00, 0.35, 0.15, 1000.0, 1500.0, (250.0, 900.0, 2300.0)),
    "t": Consonant(0.0, 0.00, 0.60, 0.2, 4000.0, 3000.0, (250.0, 1800.0, 2700.0)),
    "k": Consonant(0.0, 0.00, 0.60, 0.2, 1800.0, 1500.0, (250.0, 2000.0, 2300.0)),
    "b": Consonant(0.06, 0.00, 0.20, 0.0, 1000.0, 1500.0, (200.0, 900.0, 2200.0)),
    "d": Consonant(0.06, 0.00, 0.35, 0.0, 3800.0, 3000.0, (200.0, 1700.0, 2600.0)),
}
"""Consonants that begin with a closure of the mouth and end in a burst."""
