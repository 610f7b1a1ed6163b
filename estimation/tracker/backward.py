"""Backward over the filtered blocks, compiled: the fixed-interval smoother, and what it tells of the process noise."""

from __future__ import annotations

import numpy as np
from numba import njit

from estimation.tracker.step import DAMPING, LOG, PHASE, STATES, STIFFNESS, TREND, carried


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
def _solved(A, B, n):  # type: ignore[no-untyped-def]
    """Solve A X = B in place on ``B`` for the first ``n`` states of a covariance ``A``, which becomes its factor."""
    columns = B.shape[1]
    for i in range(n):
        for j in range(i + 1):
            rest = A[i, j]
            for v in range(j):
                rest -= A[i, v] * A[j, v]
            A[i, j] = rest / A[j, j] if j < i else np.sqrt(rest)
    for i in range(n):
        for v in range(i):
            for c in range(columns):
                B[i, c] -= A[i, v] * B[v, c]
        scale = 1.0 / A[i, i]
        for c in range(columns):
            B[i, c] *= scale
    for i in range(n - 1, -1, -1):
        for v in range(i + 1, n):
            for c in range(columns):
                B[i, c] -= A[v, i] * B[v, c]
        scale = 1.0 / A[i, i]
        for c in range(columns):
            B[i, c] *= scale


@njit(cache=True, error_model="numpy")
def run_smoother(step, filtered):  # type: ignore[no-untyped-def]
    """Rauch-Tung-Striebel, in place on the filter's states and covariances; ``step`` from block to block [s].

    The slopes of ``kicks`` would give the same, but for the first blocks as a difference from a covariance up to 1e7
    times as large.
    """
    xs, Ps = filtered.states, filtered.covariances
    n, axes = xs.shape[1], filtered.taken.shape[1]
    back, change, room = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    for k in range(xs.shape[0] - 2, -1, -1):
        back[:] = Ps[k]
        for a in range(axes):
            carried(back[a * STATES : (a + 1) * STATES], filtered.taken[k + 1, a], step)
        room[:] = filtered.predicted_covariances[k + 1]
        _solved(room, back, axes * STATES + 1)  # the gain, transposed
        for u in range(n):
            later = xs[k + 1, u] - filtered.predicted_states[k + 1, u]
            for v in range(n):
                xs[k, v] += back[u, v] * later
                change[u, v] = Ps[k + 1, u, v] - filtered.predicted_covariances[k + 1, u, v]
        _product(change, back, room)
        _product(back.T, room, change)
        for u in range(n):
            for v in range(n):
                Ps[k, u, v] += 0.5 * (change[u, v] + change[v, u])


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
def kicks(signal, linear, filtered):  # type: ignore[no-untyped-def]
    """What all blocks say of a kick of each state between two of them: the two sides of the likelihood's score.

    What later blocks say reaches an earlier one as the slope of their log-likelihood and its information, carried
    through each block's measurements and step (Bryson and Frazier 1963; de Jong, Biometrika 75, 594, 1988): no
    covariance is inverted and nothing smoothed. With r the slope by a kick and N its information, half the sum of
    r_j^2 - N_jj is the derivative of the log-likelihood by the variance of kicks of state j (Koopman and Shephard,
    Biometrika 79, 823, 1992).

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
