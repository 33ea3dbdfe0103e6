"""Distances of sets by scipy's assignment, one frame at a time, with points that stand for none."""

import numpy as np
from scipy.optimize import linear_sum_assignment


def assigned_cost(cost):
    """Return the least total cost of a square matrix."""
    return cost[linear_sum_assignment(cost)].sum()


def ospa(distance, order, cutoff):
    """OSPA of m points from n points at `distance` (m, n): the smaller set is filled up with points at the cut-off."""
    larger = max(distance.shape)
    if larger == 0:
        return 0.0
    cost = np.full((larger, larger), float(cutoff) ** order)
    cost[: distance.shape[0], : distance.shape[1]] = np.minimum(distance, cutoff) ** order
    return (assigned_cost(cost) / larger) ** (1 / order)


def gospa(distance, order, cutoff):
    """GOSPA with alpha 2: every point may also go to a point of its own that stands for none, at half the cut-off."""
    talkers, tracks = distance.shape
    half = float(cutoff) ** order / 2
    cost = np.full((talkers + tracks, talkers + tracks), 1e9)
    cost[:talkers, :tracks] = distance**order
    cost[:talkers, tracks:][np.eye(talkers, dtype=bool)] = half
    cost[talkers:, :tracks][np.eye(tracks, dtype=bool)] = half
    cost[talkers:, tracks:] = 0.0
    return assigned_cost(cost) ** (1 / order)
