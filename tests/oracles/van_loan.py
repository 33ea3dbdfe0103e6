"""Steps of a linear stochastic differential equation by a matrix exponential (Van Loan, 1978)."""

import numpy as np
from scipy.linalg import expm


def van_loan(rate, intensity, dt, order):
    """Return F and Q (K, K) of K - 1 integrators behind d xi = -rate xi dt + intensity dW over `dt`."""
    x, doublings = rate * dt, 0
    while x > 1:  # the exponential of a long step cancels: short steps, joined by the semigroup law
        x, doublings = x / 2, doublings + 1
    h = dt / 2**doublings
    # Units in which the step is 1 and all derivatives are alike; in seconds the exponential loses digits.
    A, W = np.diag(np.ones(order - 1), 1), np.zeros((order, order))
    A[-1, -1], W[-1, -1] = -x, 1.0
    block = expm(np.block([[-A, W], [np.zeros_like(A), A.T]]))
    F = block[order:, order:].T
    Q = F @ block[:order, order:]
    units = np.array([h ** (order - 1 - i) for i in range(order)])
    F, Q = F * units[:, None] / units, intensity**2 * h * Q * np.outer(units, units)
    for _ in range(doublings):
        F, Q = F @ F, F @ Q @ F.T + Q
    return F, (Q + Q.T) / 2
