"""Backward over the filtered blocks, compiled: the fixed-interval smoother, and what it tells of the process noise.

What later blocks say of a state reaches it as the slope of their log-likelihood and its information, carried through
each block's measurements and step (Bryson and Frazier 1963; de Jong, Biometrika 75, 594, 1988): no covariance is
inverted, and what a kick between two blocks would do to the likelihood stands there ready.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from estimation.tracker.step import DAMPING, LOG, PHASE, STATES, STIFFNESS, TREND


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _product(A, B, out):  # type: ignore[no-untyped-def]
    """A B into ``out``: for matrices this small a loop is faster than a library's call."""
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            out[i, j] = 0.0
        for v in range(A.shape[1]):
            for j in range(B.shape[1]):
                out[i, j] += A[i, v] * B[v, j]


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _to_predicted(signal, k, linear, filtered, slope, information, room):  # type: ignore[no-untyped-def]
    """Slope and information of all that comes after block k, in place, to those of all from its measurements on.

    With D the information of the block's measurements and P its filtered covariance, M = I - P D carries them.

    Args:
        slope: shape (n,). information: shape (n, n). room: shape (3, n, n).
    """
    n, own, M, carried = slope.size, room[0], room[1], room[2]
    scale = 1.0 / filtered.noise[k]
    if scale == 0.0:
        return
    for u in range(n):
        for v in range(n):
            own[u, v] = scale * linear.information[k, u, v]
    for a in range(signal.psi.shape[1]):
        own[a * STATES + PHASE, a * STATES + PHASE] += 1.0 / signal.known_var[k, a]
    _product(filtered.covariances[k], own, M)
    for u in range(n):
        for v in range(n):
            M[u, v] = (1.0 if u == v else 0.0) - M[u, v]
    _product(information, M, carried)
    for u in range(n):
        for v in range(n):
            carried[u, v] += own[u, v]
    _product(M.T, carried, information)
    for u in range(n):
        told = filtered.slopes[k, u]
        for v in range(n):
            told += M[v, u] * slope[v]
        own[0, u] = told
        for v in range(u):
            information[u, v] = information[v, u] = 0.5 * (information[u, v] + information[v, u])
    slope[:] = own[0]


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _carried_back(rows, taken, h):  # type: ignore[no-untyped-def]
    """Multiply one axis's ``rows`` in place from the left by the transpose of what ``step.carried`` does."""
    for v in range(rows.shape[1]):
        phase, log, stiffness = rows[PHASE, v], rows[LOG, v], rows[STIFFNESS, v]
        for j in range(DAMPING + 1):
            own = rows[j, v] if j > LOG else 0.0
            rows[j, v] = own + taken[0, j] * phase + taken[1, j] * log
        rows[TREND, v] += h * stiffness


@njit(cache=True, error_model="numpy")
def _to_filtered(signal, k, filtered, slope, information):  # type: ignore[no-untyped-def]
    """Slope and information of all from block k on, in place, to those by the state of the block before."""
    for a in range(signal.psi.shape[1]):
        own, taken = slice(a * STATES, (a + 1) * STATES), filtered.taken[k, a]
        for matrix in (slope.reshape(-1, 1)[own], information[own]):
            _carried_back(matrix, taken, signal.step)
        _carried_back(information.T[own], taken, signal.step)


@njit(cache=True, error_model="numpy")
def smoothed(signal, linear, filtered):  # type: ignore[no-untyped-def]
    """States and their variances from all blocks, both of shape (blocks, n)."""
    blocks, n = filtered.states.shape
    states, variances = filtered.states.copy(), np.empty((blocks, n))
    slope, information, room = np.zeros(n), np.zeros((n, n)), np.empty((3, n, n))
    for k in range(blocks - 1, -1, -1):
        P = filtered.covariances[k]
        _product(information, P, room[0])
        for u in range(n):
            variances[k, u] = P[u, u]
            for v in range(n):
                states[k, u] += P[u, v] * slope[v]
                variances[k, u] -= P[u, v] * room[0, v, u]
        if k > 0:
            _to_predicted(signal, k, linear, filtered, slope, information, room)
            _to_filtered(signal, k, filtered, slope, information)
    return states, variances


@njit(cache=True, error_model="numpy")
def kicks(signal, linear, filtered):  # type: ignore[no-untyped-def]
    """What all blocks say of a kick of each state between two of them: the two sides of the likelihood's score.

    With r the slope by such a kick and N its information, half the sum of r_j^2 - N_jj is the derivative of the
    log-likelihood by the variance of kicks of state j (Koopman and Shephard, Biometrika 79, 823, 1992).

    Returns:
        (sums of r_j^2, sums of N_jj), each of shape (n,).
    """
    blocks, n = filtered.states.shape
    squares, spreads = np.zeros(n), np.zeros(n)
    slope, information, room = np.zeros(n), np.zeros((n, n)), np.empty((3, n, n))
    for k in range(blocks - 1, 0, -1):
        _to_predicted(signal, k, linear, filtered, slope, information, room)
        for u in range(n):
            squares[u] += slope[u] * slope[u]
            spreads[u] += information[u, u]
        _to_filtered(signal, k, filtered, slope, information)
    return squares, spreads
