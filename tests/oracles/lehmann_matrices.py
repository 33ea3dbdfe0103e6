"""Transition matrices of Lehmann and Johansson (2007), written out for the state (x, y, x', y')."""

import numpy as np


def random_walk_velocity(T, sigma):
    """Eq. 17; sigma is per step."""
    F = np.array([[1, 0, T, 0], [0, 1, 0, T], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    G = np.array([[T / 2, 0], [0, T / 2], [1, 0], [0, 1]]) * sigma
    return F, G


def time_correlated_velocity(T, beta, sigma):
    """Eq. 18."""
    a = np.exp(-beta * T)
    b = (1 - a) / beta
    F = np.array([[1, 0, b, 0], [0, 1, 0, b], [0, 0, a, 0], [0, 0, 0, a]])
    G = np.array([[T, 0], [0, T], [1, 0], [0, 1]]) * sigma * np.sqrt(1 - np.exp(-2 * beta * T))
    return F, G


def langevin(T, beta, sigma):
    """Eq. 21."""
    a = np.exp(-beta * T)
    F = np.array([[1, 0, T * a, 0], [0, 1, 0, T * a], [0, 0, a, 0], [0, 0, 0, a]])
    G = np.array([[T, 0], [0, T], [1, 0], [0, 1]]) * sigma * np.sqrt(1 - np.exp(-2 * beta * T))
    return F, G
