"""Motion models of Lehmann and Johansson (2007), written out by hand: full matrices and one-step maps.

Coordinate-uncoupled models are matrices F, G on the state (x, y, x', y'[, x'', y'']) and the noise (u_x, u_y).
Curvilinear models are maps of a state (x, y, v, phi[, a]) and the noise (u, u'), not wrapped, nothing guarded.
Every sigma of a random walk or of white noise is per step, as printed.
"""

import numpy as np


def random_walk_velocity(T, sigma):
    """Eq. 17."""
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


def time_correlated_acceleration(T, beta, sigma):
    """Eq. 20, with Singer's + e^{-beta T} where the paper prints a minus."""
    a = np.exp(-beta * T)
    b, c = (1 - a) / beta, (beta * T - 1 + a) / beta**2
    F = np.array(
        [
            [1, 0, T, 0, c, 0],
            [0, 1, 0, T, 0, c],
            [0, 0, 1, 0, b, 0],
            [0, 0, 0, 1, 0, b],
            [0, 0, 0, 0, a, 0],
            [0, 0, 0, 0, 0, a],
        ]
    )
    G = np.array([[T**2 / 2, 0], [0, T**2 / 2], [T, 0], [0, T], [1, 0], [0, 1]])
    return F, G * sigma * np.sqrt(1 - np.exp(-2 * beta * T))


def langevin(T, beta, sigma):
    """Eq. 21."""
    a = np.exp(-beta * T)
    F = np.array([[1, 0, T * a, 0], [0, 1, 0, T * a], [0, 0, a, 0], [0, 0, 0, a]])
    G = np.array([[T, 0], [0, T], [1, 0], [0, 1]]) * sigma * np.sqrt(1 - np.exp(-2 * beta * T))
    return F, G


def walk_turn_angle(state, u, T, sigma_v, sigma_phi):
    """CL-RWVE-RWTU: eq. 25 and 24."""
    x, y, v, phi = state
    v, phi = v + sigma_v * u[0], phi + sigma_phi * u[1]
    return np.array([x + T * v * np.cos(phi), y + T * v * np.sin(phi), v, phi])


def correlated_turn_angle(state, u, T, sigma_v, beta_v, sigma_phi, beta_phi):
    """CL-TCVE-TCTU: eq. 26 and 24."""
    x, y, v, phi = state
    v = np.exp(-beta_v * T) * v + sigma_v * np.sqrt(1 - np.exp(-2 * beta_v * T)) * u[0]
    phi = np.exp(-beta_phi * T) * phi + sigma_phi * np.sqrt(1 - np.exp(-2 * beta_phi * T)) * u[1]
    return np.array([x + T * v * np.cos(phi), y + T * v * np.sin(phi), v, phi])


def random_acceleration(state, u, T, sigma_v, sigma_a):
    """CL-RWVE-RAAC: eq. 29, 28 and 24."""
    x, y, v, phi, _ = state
    v, a = v + sigma_v * u[0], sigma_a * u[1]
    phi = phi + T * a / v
    return np.array([x + T * v * np.cos(phi), y + T * v * np.sin(phi), v, phi, a])


def walk_acceleration(state, u, T, sigma_v, sigma_a):
    """CL-RWVE-RWAC: eq. 30, 28 and 24."""
    x, y, v, phi, a = state
    v, a = v + sigma_v * u[0], a + sigma_a * u[1]
    phi = phi + T * a / v
    return np.array([x + T * v * np.cos(phi), y + T * v * np.sin(phi), v, phi, a])


def correlated_acceleration(state, u, T, sigma_v, beta_v, sigma_a, beta_a):
    """CL-TCVE-TCAC: eq. 31, 28 and 24."""
    x, y, v, phi, a = state
    v = np.exp(-beta_v * T) * v + sigma_v * np.sqrt(1 - np.exp(-2 * beta_v * T)) * u[0]
    a = np.exp(-beta_a * T) * a + sigma_a * np.sqrt(1 - np.exp(-2 * beta_a * T)) * u[1]
    phi = phi + T * a / v
    return np.array([x + T * v * np.cos(phi), y + T * v * np.sin(phi), v, phi, a])


def turned_position(x, y, T, v, v_std, phi, phi_std):
    """Mean (2,) and covariance (2, 2) of (x, y) + T v' (cos phi', sin phi'), v' and phi' normal and independent."""
    square, once, twice = v**2 + v_std**2, np.exp(-(phi_std**2) / 2), np.exp(-2 * phi_std**2)
    way = v * once * np.array([np.cos(phi), np.sin(phi)])
    c, s = twice * np.cos(2 * phi), twice * np.sin(2 * phi)
    moment = square / 2 * np.array([[1 + c, s], [s, 1 - c]])
    return np.array([x, y]) + T * way, T**2 * (moment - np.outer(way, way))
