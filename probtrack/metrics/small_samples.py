"""What few independent units allow to be said: widened bootstrap intervals, and bounds of shares of none or all."""

import math

import numpy as np


def expanded_tail(level: float, units: int, strata: int = 1) -> float:
    r"""Return the share of resamples to leave out at either end, so that an interval from few units is wide enough.

    .. math:: \alpha' / 2 = \Phi\left(-\sqrt{\frac{n}{n - h}} \, t_{1 - \alpha/2, n - h}\right)

    for n units drawn within h strata. Resampling divides by n where an unbiased variance has n - h, and knows nothing
    of the tails of Student's t: for means of normal units that are drawn normally this undoes both exactly.

    >>> round(expanded_tail(0.95, 5), 5), round(expanded_tail(0.95, 2000), 3)
    (0.00095, 0.025)

    Args:
        level: Of the interval, in (0, 1).
        units: n, what is drawn anew.
        strata: h < n, parts within which units are drawn.

    References:
        T. C. Hesterberg, "What teachers should know about the bootstrap: resampling in the undergraduate statistics
        curriculum", The American Statistician 69(4), 2015, section on the expanded percentile interval; h = 1 there.
    """
    freedom = units - strata
    deviations = math.sqrt(units / freedom) * student_quantile(level, freedom)
    return math.erfc(deviations / math.sqrt(2)) / 2


def none_of_bound(level: float, units: int) -> float:
    r"""Return the upper bound of a share that none of `units` draws show, :math:`1 - (\alpha / 2)^{1/n}`.

    Resampling draws that are all alike gives an interval without width. 1 minus it is the lower bound of a share that
    all draws show.

    >>> round(none_of_bound(0.95, 60), 3)
    0.06

    References:
        C. J. Clopper, E. S. Pearson, "The use of confidence or fiducial limits illustrated in the case of the
        binomial", Biometrika 26(4), 1934.
    """
    return 1.0 - float(((1.0 - level) / 2) ** (1 / units))


def student_quantile(level: float, freedom: int) -> float:
    r"""Return t > 0 such that Student's variable of `freedom` degrees is within -t and t with probability `level`.

    By bisection in the angle :math:`\theta = \arctan(t / \sqrt\nu)`, of which the probability is a finite sum.

    References:
        M. Abramowitz, I. A. Stegun, "Handbook of mathematical functions", 1964, eq. (26.7.3) and (26.7.4).
    """
    odd = freedom % 2
    steps = np.arange(1 + odd, freedom - 2, 2, dtype=np.float64)
    factors = np.cumprod(np.append(1.0, steps / (steps + 1)))
    powers = 2 * np.arange(len(factors))

    def inside(angle: float) -> float:
        series = float(factors @ math.cos(angle) ** powers)
        if not odd:
            return math.sin(angle) * series
        return 2 / math.pi * (angle + math.sin(angle) * math.cos(angle) * series * (freedom > 1))

    low, high = 0.0, math.pi / 2
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if inside(middle) < level else (low, middle)
    return math.sqrt(freedom) * math.tan((low + high) / 2)
