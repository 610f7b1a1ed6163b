"""Backward passes over the filtered blocks, compiled: the Rauch-Tung-Striebel smoother and the disturbance smoother.

Sources: Rauch, Tung and Striebel, AIAA J. 3, 1445 (1965); Bryson and Frazier (1963); de Jong, Biometrika 75, 594
(1988); Koopman and Shephard, Biometrika 79, 823 (1992).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from estimation.tracker.state_space import (
    AXIS_STATES,
    DAMPING,
    LOG_AMPLITUDE,
    PHASE,
    STIFFNESS,
    STIFFNESS_RATE,
    apply_transition,
)


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _multiply(A, B, out):  # type: ignore[no-untyped-def]
    """A B into ``out``; for matrices this small a loop is faster than a library call."""
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            out[i, j] = 0.0
        for v in range(A.shape[1]):
            for j in range(B.shape[1]):
                out[i, j] += A[i, v] * B[v, j]


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _solve_cholesky(A, B, n):  # type: ignore[no-untyped-def]
    """Solve A X = B, in place on ``B``, for the first ``n`` states of a covariance ``A``, which becomes its factor."""
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
def run_smoother(step, history):  # type: ignore[no-untyped-def]
    """Smooth the filtered means and covariances of a ``FilterHistory`` in place. step: from block to block [s].

    With F the transition to block k + 1, G = P(k) F' P(k+1|k)^-1:
    x(k) += G (x(k+1) - x(k+1|k)), P(k) += G (P(k+1) - P(k+1|k)) G'.

    The disturbance smoother would give the same result, but in the first blocks as a small difference from covariances
    up to 1e7 times as large.
    """
    xs, Ps = history.states, history.covariances
    n, axes = xs.shape[1], history.transitions.shape[1]
    gain, change, buffer = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    for k in range(xs.shape[0] - 2, -1, -1):
        gain[:] = Ps[k]
        for a in range(axes):
            apply_transition(gain[a * AXIS_STATES : (a + 1) * AXIS_STATES], history.transitions[k + 1, a], step)
        buffer[:] = history.predicted_covariances[k + 1]
        _solve_cholesky(buffer, gain, axes * AXIS_STATES + 1)  # G'
        for u in range(n):
            correction = xs[k + 1, u] - history.predicted_states[k + 1, u]
            for v in range(n):
                xs[k, v] += gain[u, v] * correction
                change[u, v] = Ps[k + 1, u, v] - history.predicted_covariances[k + 1, u, v]
        _multiply(change, gain, buffer)
        _multiply(gain.T, buffer, change)
        for u in range(n):
            for v in range(n):
                Ps[k, u, v] += 0.5 * (change[u, v] + change[v, u])


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _score_before_update(signal, k, linear, history, score, information, buffer):  # type: ignore[no-untyped-def]
    """Score and information of the blocks after k, in place, to those of block k and all after it.

    With D the information of the block's measurements and P its filtered covariance, M = I - P D maps the deviation of
    the predicted state to that of the filtered one.

    Args:
        score: shape (n,). information: shape (n, n). buffer: shape (3, n, n).
    """
    n, D, M, product = score.size, buffer[0], buffer[1], buffer[2]
    scale = 1.0 / history.noise_var[k]
    if scale == 0.0:
        return
    for u in range(n):
        for v in range(n):
            D[u, v] = scale * linear.information[k, u, v]
    for a in range(signal.psi.shape[1]):
        D[a * AXIS_STATES + PHASE, a * AXIS_STATES + PHASE] += 1.0 / signal.external_var[k, a]
    _multiply(history.covariances[k], D, M)
    for u in range(n):
        for v in range(n):
            M[u, v] = (1.0 if u == v else 0.0) - M[u, v]
    _multiply(information, M, product)
    for u in range(n):
        for v in range(n):
            product[u, v] += D[u, v]
    _multiply(M.T, product, information)
    for u in range(n):
        total = history.scores[k, u]
        for v in range(n):
            total += M[v, u] * score[v]
        D[0, u] = total
        for v in range(u):
            information[u, v] = information[v, u] = 0.5 * (information[u, v] + information[v, u])
    score[:] = D[0]


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _apply_transposed(rows, transition, h):  # type: ignore[no-untyped-def]
    """Multiply one axis's ``rows`` in place from the left by the transpose of the Jacobian of ``apply_transition``."""
    for v in range(rows.shape[1]):
        phase, log, stiffness = rows[PHASE, v], rows[LOG_AMPLITUDE, v], rows[STIFFNESS, v]
        for j in range(DAMPING + 1):
            direct = rows[j, v] if j > LOG_AMPLITUDE else 0.0
            rows[j, v] = direct + transition[0, j] * phase + transition[1, j] * log
        rows[STIFFNESS_RATE, v] += h * stiffness


@njit(cache=True, error_model="numpy")
def _score_before_step(signal, k, history, score, information):  # type: ignore[no-untyped-def]
    """Score and information of block k and all after it, in place, by the state of block k - 1."""
    for a in range(signal.psi.shape[1]):
        mine, transition = slice(a * AXIS_STATES, (a + 1) * AXIS_STATES), history.transitions[k, a]
        for matrix in (score.reshape(-1, 1)[mine], information[mine]):
            _apply_transposed(matrix, transition, signal.step)
        _apply_transposed(information.T[mine], transition, signal.step)


@njit(cache=True, error_model="numpy")
def disturbance_scores(signal, linear, history):  # type: ignore[no-untyped-def]
    """Both terms of the likelihood's derivative by the variance of a disturbance of each state between two blocks.

    The derivative of the log-likelihood of all later blocks by the state (r), and its information (N), are propagated
    backward through each update and step (disturbance smoother of de Jong). No covariance is inverted. Half the sum of
    r_j^2 - N_jj is the derivative of the log-likelihood by the variance of disturbances of state j (Koopman and
    Shephard).

    Returns:
        (sums of r_j^2, sums of N_jj), each of shape (n,).
    """
    blocks, n = history.states.shape
    squares, variances = np.zeros(n), np.zeros(n)
    score, information, buffer = np.zeros(n), np.zeros((n, n)), np.empty((3, n, n))
    for k in range(blocks - 1, 0, -1):
        _score_before_update(signal, k, linear, history, score, information, buffer)
        for u in range(n):
            squares[u] += score[u] * score[u]
            variances[u] += information[u, u]
        _score_before_step(signal, k, history, score, information)
    return squares, variances
