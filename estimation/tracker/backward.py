"""Backward over the filtered blocks, compiled: the fixed-interval smoother, and what it tells of the process noise."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _solved(A, B):  # type: ignore[no-untyped-def]
    """Solve A X = B in place on ``B`` for a small covariance ``A``, which becomes its Cholesky factor."""
    n = A.shape[0]
    for i in range(n):
        for j in range(i + 1):
            rest = A[i, j]
            for v in range(j):
                rest -= A[i, v] * A[j, v]
            A[i, j] = rest / A[j, j] if j < i else np.sqrt(rest)
    for i in range(n):
        for v in range(i):
            for c in range(n):
                B[i, c] -= A[i, v] * B[v, c]
        B[i] /= A[i, i]
    for i in range(n - 1, -1, -1):
        for v in range(i + 1, n):
            for c in range(n):
                B[i, c] -= A[v, i] * B[v, c]
        B[i] /= A[i, i]


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _product(A, B, out):  # type: ignore[no-untyped-def]
    """A B into ``out``: for matrices this small a loop is faster than a library's call."""
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            out[i, j] = 0.0
        for v in range(A.shape[1]):
            for j in range(B.shape[1]):
                out[i, j] += A[i, v] * B[v, j]


@njit(cache=True, error_model="numpy")
def run_smoother(xs, Ps, xp, Pp, Fs):  # type: ignore[no-untyped-def]
    """Rauch-Tung-Striebel, in place on ``xs`` and ``Ps``."""
    n = xs.shape[1]
    back, change, room = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    for k in range(xs.shape[0] - 2, -1, -1):
        _product(Fs[k + 1], Ps[k], back)
        room[:] = Pp[k + 1]
        _solved(room, back)  # the gain, transposed
        for u in range(n):
            later = xs[k + 1, u] - xp[k + 1, u]
            for v in range(n):
                xs[k, v] += back[u, v] * later
                change[u, v] = Ps[k + 1, u, v] - Pp[k + 1, u, v]
        _product(change, back, room)
        _product(back.T, room, change)
        for u in range(n):
            for v in range(n):
                Ps[k, u, v] += 0.5 * (change[u, v] + change[v, u])


@njit(cache=True, error_model="numpy")
def kicks(xs, Ps, xp, Pp):  # type: ignore[no-untyped-def]
    """What a smoothed track says of a kick of each state between two blocks: the two sides of the likelihood's score.

    With r = Pp^-1 (xs - xp) and N = Pp^-1 (Pp - Ps) Pp^-1, half the sum of r_j^2 - N_jj is the derivative of the
    log-likelihood by the variance of kicks of state j (Koopman and Shephard, Biometrika 79, 823, 1992).

    Returns:
        (sums of r_j^2, sums of N_jj), each of shape (states,).
    """
    n = xs.shape[1]
    squares, spreads = np.zeros(n), np.zeros(n)
    factor, inverse, left, both = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    for k in range(1, xs.shape[0]):
        factor[:], inverse[:] = Pp[k], 0.0
        for u in range(n):
            inverse[u, u] = 1.0
        _solved(factor, inverse)
        _product(inverse, Pp[k] - Ps[k], left)
        _product(left, inverse, both)
        for u in range(n):
            r = 0.0
            for v in range(n):
                r += inverse[u, v] * (xs[k, v] - xp[k, v])
            squares[u] += r * r
            spreads[u] += both[u, u]
    return squares, spreads
