"""Entropy-regularised transport by plain loops in log space, at one epsilon, until nothing changes."""

import math


def log_sum(terms):
    top = max(terms)
    return top + math.log(sum(math.exp(t - top) for t in terms))


def plan(points, weights, epsilon, rounds=3000):
    """Return the plan (N rows) with rows 1/N and columns `weights` > 0, cost half the squared distance."""
    size = range(len(points))
    cost = [[0.5 * sum((a - b) ** 2 for a, b in zip(points[i], points[j], strict=True)) for j in size] for i in size]
    f, g = [0.0 for _ in size], [0.0 for _ in size]
    for _ in range(rounds):
        f = [-epsilon * (log_sum([(g[j] - cost[i][j]) / epsilon for j in size]) + math.log(len(points))) for i in size]
        new = [epsilon * (math.log(weights[j]) - log_sum([(f[i] - cost[i][j]) / epsilon for i in size])) for j in size]
        done = max(abs(a - b) for a, b in zip(new, g, strict=True)) < 1e-14
        g = new
        if done:
            break
    return [[math.exp((f[i] + g[j] - cost[i][j]) / epsilon) for j in size] for i in size]


def blended(points, weights, epsilon):
    """Return N P x, each dimension measured in its own weighted spread."""
    dims = range(len(points[0]))
    mean = [sum(w * p[d] for w, p in zip(weights, points, strict=True)) for d in dims]
    spread = [math.sqrt(sum(w * (p[d] - mean[d]) ** 2 for w, p in zip(weights, points, strict=True))) for d in dims]
    unit = [s * math.sqrt(len(dims)) for s in spread]
    rows = plan([[p[d] / unit[d] for d in dims] for p in points], weights, epsilon)
    return [[len(points) * sum(m * p[d] for m, p in zip(row, points, strict=True)) for d in dims] for row in rows]
