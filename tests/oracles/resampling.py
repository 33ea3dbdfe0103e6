"""Resampling in exact arithmetic, one point of the comb after the other."""

from fractions import Fraction


def systematic(weights, u):
    """Return how many of the points (j + u) / N each particle catches; `weights` are floats that sum to anything."""
    exact = [Fraction(w) for w in weights]
    total, size = sum(exact), len(exact)
    return stratified(exact, [u] * size, total)


def stratified(weights, uniforms, total=None):
    """Return how many of the points (j + u_j) / N each particle catches."""
    exact = [Fraction(w) for w in weights]
    total, size = total or sum(exact), len(exact)
    counts, particle, reached = [0] * size, 0, exact[0]
    for j, u in enumerate(uniforms):
        while Fraction(j + Fraction(u)) / size * total >= reached:
            particle += 1
            reached += exact[particle]
        counts[particle] += 1
    return counts


def residual(weights, uniforms):
    """Return the whole parts of N w, and what the first of `uniforms` draw of the rest."""
    exact = [Fraction(w) for w in weights]
    scaled = [len(exact) * w / sum(exact) for w in exact]
    counts = [int(x) for x in scaled]
    rest = [x - int(x) for x in scaled]
    for u in uniforms[: len(exact) - sum(counts)]:
        point, particle, reached = Fraction(u) * sum(rest), 0, rest[0]
        while point >= reached:
            particle += 1
            reached += rest[particle]
        counts[particle] += 1
    return counts


def multinomial(weights, uniforms):
    """Return how often each particle is drawn by `uniforms`."""
    exact = [Fraction(w) for w in weights]
    counts = [0] * len(exact)
    for u in uniforms:
        point, particle, reached = Fraction(u) * sum(exact), 0, exact[0]
        while point >= reached:
            particle += 1
            reached += exact[particle]
        counts[particle] += 1
    return counts
