"""Exact answers for a linear Gaussian system that switches, by a sum over all paths of modes."""

import itertools

import numpy as np


def answers(y, models, carry, initial, transitions, start, H, R):
    """Return (log p(y_1:T), p(s_T | y_1:T) (S,), E[H x_T | y_1:T] (J,)) by enumeration.

    `y` (T, J); `models` [(F, G)] a mode, with states of any sizes; `carry[i][j]` takes a state of mode i to the
    layout of mode j; `initial` (S,), probabilities of the first mode; `transitions` (T, S, S), the matrix into each
    frame; `start` (mean, covariance) one frame before the first, in the layout of mode 0; `H[i]` (J, D_i); `R` (J, J).
    """
    frames, modes = len(y), len(models)
    log_joint, ends, means = [], [], []
    for path in itertools.product(range(modes), repeat=frames):
        prior = initial[path[0]] * np.prod([transitions[t][path[t - 1], path[t]] for t in range(1, frames)])
        if prior == 0:
            continue
        mean, covariance, last = _observed_jointly(path, models, carry, start, H, R)
        size = y.size
        offset = y.ravel() - mean[:size]
        seen = covariance[:size, :size]
        _, log_det = np.linalg.slogdet(2 * np.pi * seen)
        log_joint.append(np.log(prior) - 0.5 * (offset @ np.linalg.solve(seen, offset) + log_det))
        means.append(mean[size:] + covariance[size:, :size] @ np.linalg.solve(seen, offset))
        ends.append(last)
    log_joint, ends, means = np.array(log_joint), np.array(ends), np.array(means)
    top = log_joint.max()
    weight = np.exp(log_joint - top)
    evidence = top + np.log(weight.sum())
    weight /= weight.sum()
    return evidence, np.array([weight[ends == s].sum() for s in range(modes)]), weight @ means


def _observed_jointly(path, models, carry, start, H, R):
    """Return mean and covariance of (y_1, ..., y_T, H x_T) given the modes, and the last mode; no recursion on beliefs.

    Every x_t is written as a linear map of (x_0, u_1, ..., u_T), whose covariance is block diagonal.
    """
    mean, covariance = start
    noises = [models[s][1].shape[1] for s in path]
    total = len(mean) + sum(noises)
    root = np.zeros((total, total))
    root[: len(mean), : len(mean)] = covariance
    root[len(mean) :, len(mean) :] = np.eye(sum(noises))
    at_zero = np.concatenate([mean, np.zeros(sum(noises))])
    now = np.hstack([np.eye(len(mean)), np.zeros((len(mean), sum(noises)))])
    before, column, rows = 0, len(mean), []
    for s, size in zip(path, noises, strict=True):
        F, G = models[s]
        now = F @ carry[before][s] @ now
        now[:, column : column + size] += G
        column, before = column + size, s
        rows.append(H[s] @ now)
    stacked = np.vstack([*rows, rows[-1]])
    error = np.zeros((len(stacked), len(stacked)))
    seen = len(stacked) - len(R)
    error[:seen, :seen] = np.kron(np.eye(len(path)), R)
    return stacked @ at_zero, stacked @ root @ stacked.T + error, path[-1]
