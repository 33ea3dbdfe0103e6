"""Filter, smoother and evidence of a linear Gaussian system by conditioning one Gaussian: no recursion."""

import numpy as np


class JointGaussian:
    """All states x_1..x_T and observations y_1..y_T of one sequence, with F and G (T, ...) for each frame."""

    def __init__(self, F, G, H, R, mean, covariance):
        T, D, K = G.shape
        source = np.zeros((T * D, D + T * K))  # x_1..x_T as a linear map of (x_0, u_1, .., u_T)
        for t in range(T):
            source[t * D : (t + 1) * D, :D] = np.linalg.multi_dot([np.eye(D), np.eye(D), *F[t::-1]])
            for s in range(t + 1):
                carried = np.linalg.multi_dot([np.eye(D), np.eye(D), *F[t:s:-1]])
                source[t * D : (t + 1) * D, D + s * K : D + (s + 1) * K] = carried @ G[s]
        spread = np.eye(D + T * K)
        spread[:D, :D] = covariance
        self.shape = T, D, H.shape[0]
        self.x_mean = source[:, :D] @ mean
        self.x_cov = source @ spread @ source.T
        self.H = np.kron(np.eye(T), H)
        self.y_cov = self.H @ self.x_cov @ self.H.T + np.kron(np.eye(T), R)

    def given(self, y, frames):
        """Return mean (T, D) and covariance (T, D, D) of every state given y (T, J) in `frames`."""
        T, D, J = self.shape
        rows = np.concatenate([np.arange(t * J, (t + 1) * J) for t in frames] or [np.array([], int)])
        cross = (self.x_cov @ self.H.T)[:, rows]
        weight = np.linalg.solve(self.y_cov[np.ix_(rows, rows)], cross.T).T
        mean = self.x_mean + weight @ (y.reshape(-1) - self.H @ self.x_mean)[rows]
        cov = self.x_cov - weight @ cross.T
        return mean.reshape(T, D), np.stack([cov[t * D : (t + 1) * D, t * D : (t + 1) * D] for t in range(T)])

    def filtered(self, y, observed):
        """Return mean (T, D) and covariance (T, D, D) of x_t given what is observed up to t."""
        T = self.shape[0]
        seen = [self.given(y, [s for s in range(t + 1) if observed[s]]) for t in range(T)]
        return np.stack([m[t] for t, (m, _) in enumerate(seen)]), np.stack([P[t] for t, (_, P) in enumerate(seen)])

    def log_evidence(self, y, observed):
        """Return log p of the observed frames of y (T, J)."""
        rows = np.repeat(np.asarray(observed, bool), self.shape[2])
        error = (y.reshape(-1) - self.H @ self.x_mean)[rows]
        cov = self.y_cov[np.ix_(rows, rows)]
        return -0.5 * (error @ np.linalg.solve(cov, error) + np.linalg.slogdet(2 * np.pi * cov)[1])
