"""Phase and frequency from numbered edges by a Kalman smoother.

The phase is phi(t) = 2 pi f0 t + psi(t). Its slow part psi is integrated from a frequency that walks at random
(integrated Wiener process), which is the natural prior of a drift. An edge of kind c measures

    psi(t_k) + noise = nominal phase of the edge - 2 pi f0 t_k + s_c alpha,      s_0 = 1, s_1 = -1,

where alpha is the asymmetry of the detector: the phase by which the beam passes it late on the way up and early on the
way down. It is constant, or walks at random with the amplitude of the motion, where the likelihood gains by that more
than ``MIN_DEVIANCE_GAIN``. The ratios of the walks to the jitter maximise the likelihood, with the jitter's variance
eliminated.

Source: Rauch, Tung and Striebel, AIAA J. 3 (1965) 1445 (smoother); Harvey, Forecasting, Structural Time Series Models
and the Kalman Filter (1989), section 4.2 (concentrated likelihood).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scanner.arrays import Array

MIN_VARIANCE = 1e-24
"""Least variance of the jitter [rad2]: of times that repeat exactly, whose rounding is about 1e-12 rad."""

LOG10_WALK_RANGE = (-16.0, 2.0)
"""Range of the ratio that is searched: variance of the frequency's change in a period over that of the jitter, both as
phases. From a motion that does not drift within a million periods to one whose edges are independent."""

DIFFUSE = 1e10
"""Variance of the state before the first edge, relative to the jitter's: without information."""

INITIAL_EDGES = 6
"""Edges that fix the diffuse state; their innovations do not enter the likelihood."""

LIKELIHOOD_EDGES = 20_000
"""Edges from the start from which walk and jitter are found: they are then known to 1 %."""

MAX_OUTLIER_SD = 6.0
"""Residual in standard deviations above which an edge is left out: by chance once in 5e8."""


MIN_DEVIANCE_GAIN = 10.0
"""Decrease of -2 log likelihood from which the asymmetry is taken to walk: by chance once in 1000."""

SEARCH_ROUNDS = 2
"""Alternations between the two walks; their estimates are nearly independent."""


class SmoothedPhase(NamedTuple):
    """Phase at the edges.

    Attributes:
        phase: psi, shape (n,) [rad]. rate: its derivative [rad a period].
        phase_sd: shape (n,) [rad].
        asymmetry, asymmetry_sd: alpha at each edge, shape (n,) [rad]; 0 where the edges are of one kind.
        jitter_sd: of an edge [rad].
        used: whether it is an edge and no outlier, shape (n,).
    """

    phase: Array
    rate: Array
    phase_sd: Array
    asymmetry: Array
    asymmetry_sd: Array
    jitter_sd: float
    used: NDArray[np.bool_]


def smooth_phase(
    periods: Array, measured: Array, side: Array, is_edge: NDArray[np.bool_], walking_asymmetry: bool = False
) -> SmoothedPhase:
    """Smooth the phases of edges, once more without the outliers of the first pass.

    Args:
        periods: time of each edge in periods, increasing, shape (n,).
        measured: psi(t_k) - s alpha as measured [rad], shape (n,).
        side: -s of each edge, shape (n,); zeros where all edges are of one kind.
        is_edge: shape (n,); elsewhere, as in the gaps between edges, the phase is predicted, and ``measured`` not used.
        walking_asymmetry: whether the asymmetry may change, as it does with the amplitude.
    """
    used = is_edge.astype(float)
    part = slice(0, LIKELIHOOD_EDGES)
    for _ in range(2):
        walks, variance = _most_likely(periods[part], measured[part], side[part], used[part], walking_asymmetry)
        states, covariances = _smooth(periods, measured, side, used, *walks, DIFFUSE)
        residual = measured - states[:, 0] - side * states[:, 2]
        used = (is_edge & (np.abs(residual) < MAX_OUTLIER_SD * np.sqrt(variance))).astype(float)
        if used.sum() == is_edge.sum():
            break
    sd = np.sqrt(variance)
    return SmoothedPhase(
        states[:, 0],
        states[:, 1],
        sd * np.sqrt(covariances[:, 0]),
        states[:, 2],
        sd * np.sqrt(covariances[:, 1]),
        float(sd),
        used > 0.0,
    )


def _most_likely(
    periods: Array, measured: Array, side: Array, used: Array, walking_asymmetry: bool
) -> tuple[tuple[float, float], float]:
    """Ratios of the walks' variances, of frequency and asymmetry, to the jitter's, and the jitter's variance [rad2]."""

    def deviance(ratio: float, asymmetry_ratio: float) -> float:
        count, chi2, log_det = _likelihood(periods, measured, side, used, ratio, asymmetry_ratio, DIFFUSE)
        return float(count * np.log(max(chi2 / count, MIN_VARIANCE)) + log_det)

    ratio, least = _search(partial(deviance, asymmetry_ratio=0.0))
    walks = (ratio, 0.0)
    if walking_asymmetry and np.abs(side).max() > 0.0:
        both, free = walks, least
        for _ in range(SEARCH_ROUNDS):
            asymmetry_ratio, _ = _search(partial(deviance, both[0]))
            ratio, free = _search(partial(deviance, asymmetry_ratio=asymmetry_ratio))
            both = (ratio, asymmetry_ratio)
        if free < least - MIN_DEVIANCE_GAIN:
            walks = both
    count, chi2, _ = _likelihood(periods, measured, side, used, *walks, DIFFUSE)
    return walks, max(chi2 / count, MIN_VARIANCE)


def _search(deviance: Callable[[float], float]) -> tuple[float, float]:
    """The ratio in ``LOG10_WALK_RANGE`` of the least deviance, and that deviance."""
    from scipy.optimize import minimize_scalar

    grid = np.linspace(*LOG10_WALK_RANGE, 19)
    at = int(np.argmin([deviance(10.0 ** float(log_ratio)) for log_ratio in grid]))
    bounds = (float(grid[max(at - 1, 0)]), float(grid[min(at + 1, grid.size - 1)]))
    found = minimize_scalar(lambda each: deviance(10.0**each), bounds=bounds, method="bounded", options={"xatol": 0.02})
    return 10.0 ** float(found.x), float(found.fun)


@njit(cache=True)
def _predict(x, P, step, ratio, asymmetry_ratio):  # type: ignore[no-untyped-def]
    """The state after ``step`` periods: x (3,) and P (3, 3) in place."""
    x[0] += step * x[1]
    for j in range(3):
        P[0, j] += step * P[1, j]
    for i in range(3):
        P[i, 0] += step * P[i, 1]
    P[0, 0] += ratio * step**3 / 3.0
    P[0, 1] += ratio * step**2 / 2.0
    P[1, 0] += ratio * step**2 / 2.0
    P[1, 1] += ratio * step
    P[2, 2] += asymmetry_ratio * step


@njit(cache=True)
def _update(x, P, y, side):  # type: ignore[no-untyped-def]
    """One edge of variance 1; returns its innovation and that one's variance. x and P in place."""
    h = P[:, 0] + side * P[:, 2]
    S = h[0] + side * h[2] + 1.0
    r = y - x[0] - side * x[2]
    K = h / S
    x += K * r
    G = -np.outer(K, np.array([1.0, 0.0, side]))  # Joseph's form keeps P positive from a diffuse start
    for i in range(3):
        G[i, i] += 1.0
    P[:] = G @ P @ G.T + np.outer(K, K)
    return r, S


@njit(cache=True)
def _start(measured, side, diffuse):  # type: ignore[no-untyped-def]
    x, P = np.array([measured[0], 0.0, 0.0]), np.diag(np.array([diffuse, diffuse, 0.0]))
    if np.abs(side).max() > 0.0:
        P[2, 2] = diffuse
    return x, P


@njit(cache=True)
def _likelihood(periods, measured, side, used, ratio, asymmetry_ratio, diffuse):  # type: ignore[no-untyped-def]
    """Number of innovations, their sum of squares over their variances, and the sum of log variances."""
    x, P = _start(measured, side, diffuse)
    count, chi2, log_det = 0, 0.0, 0.0
    for k in range(periods.size):
        if k:
            _predict(x, P, periods[k] - periods[k - 1], ratio, asymmetry_ratio)
        if used[k] > 0.0:
            r, S = _update(x, P, measured[k], side[k])
            if k >= INITIAL_EDGES:
                count, chi2, log_det = count + 1, chi2 + r * r / S, log_det + np.log(S)
    return count, chi2, log_det


@njit(cache=True)
def _smooth(periods, measured, side, used, ratio, asymmetry_ratio, diffuse):  # type: ignore[no-untyped-def]
    """States (n, 3), and the variances of phase and asymmetry (n, 2), for edges of variance 1, all edges used."""
    n = periods.size
    means, before = np.empty((n, 3)), np.empty((n, 3))
    covariances, covariances_before = np.empty((n, 3, 3)), np.empty((n, 3, 3))
    x, P = _start(measured, side, diffuse)
    for k in range(n):
        if k:
            _predict(x, P, periods[k] - periods[k - 1], ratio, asymmetry_ratio)
        before[k], covariances_before[k] = x, P
        if used[k] > 0.0:
            _update(x, P, measured[k], side[k])
        means[k], covariances[k] = x, P
    out = np.empty((n, 2))
    out[n - 1] = covariances[n - 1, 0, 0], covariances[n - 1, 2, 2]
    for k in range(n - 2, -1, -1):
        step, P = periods[k + 1] - periods[k], covariances[k]
        F = np.eye(3)
        F[0, 1] = step
        nxt = covariances_before[k + 1].copy()
        nxt[2, 2] += 1e-300  # an asymmetry that is fixed to 0
        gain = np.linalg.solve(nxt, F @ P).T
        means[k] += gain @ (means[k + 1] - before[k + 1])
        covariances[k] = P + gain @ (covariances[k + 1] - covariances_before[k + 1]) @ gain.T
        out[k] = max(covariances[k, 0, 0], 0.0), max(covariances[k, 2, 2], 0.0)
    return means, out
