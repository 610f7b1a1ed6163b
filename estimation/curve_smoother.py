"""Rauch-Tung-Striebel smoother of a phase whose frequency is a random walk, for measurements at irregular times."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from estimation.frequency_motion import SlowCurve
from scanner.arrays import Array

RATE_WALK_DENSITIES = 10.0 ** np.arange(-2.0, 7.0)
"""Spectral densities of the random walk of the rate that are compared [rad^2 / s^3]: decades from a phase that leaves a
straight line by 0.1° in 0.1 s to one that leaves it by as much in 0.1 ms."""

NOISE_FACTORS = np.array([1.0, 2.0, 4.0])
"""Factors on the standard deviations of the measurements that are compared: detail that the registration does not
resolve acts on short parts as additional noise."""

INITIAL_SD = (10.0, 1.0e3)
"""Standard deviations of phase [rad] and rate [rad/s] before the first measurement: any phase, within 160 Hz."""


def smooth_curve(time: Array, value: Array, sd: Array) -> SlowCurve:
    """A slow curve and its rate at the times of its measurements.

    The density of the random walk and the factor on ``sd`` are those of the largest likelihood.

    Args:
        time: increasing, shape (n,), n > 1 [s].
        value, sd: measurements and their standard deviations, shape (n,).
    """
    candidates = [(q, factor) for q in RATE_WALK_DENSITIES for factor in NOISE_FACTORS]
    fits = [_smooth(time, value, (factor * sd) ** 2, q, *INITIAL_SD) for q, factor in candidates]
    best: Any = max(fits, key=lambda fit: fit[0])
    _, mean, variance = best
    return SlowCurve(time, mean[:, 0].copy(), mean[:, 1].copy(), np.sqrt(variance))


@njit(cache=True)
def _smooth(time, value, noise, density, value_sd, rate_sd):  # type: ignore[no-untyped-def]
    """Log-likelihood, means of value and rate (n, 2), and variances of the value (n,)."""
    n = time.size
    mean, predicted = np.empty((n, 2)), np.empty((n, 2))  # value, rate
    cov, predicted_cov = np.empty((n, 3)), np.empty((n, 3))  # variance of value, covariance, variance of rate
    p, v, a, b, c = value[0], 0.0, value_sd**2, 0.0, rate_sd**2
    log_likelihood = 0.0
    for k in range(n):
        if k > 0:
            h = time[k] - time[k - 1]
            p += h * v
            a += 2.0 * h * b + h * h * c + density * h**3 / 3.0
            b += h * c + density * h * h / 2.0
            c += density * h
        predicted[k, 0], predicted[k, 1] = p, v
        predicted_cov[k, 0], predicted_cov[k, 1], predicted_cov[k, 2] = a, b, c
        innovation, total = value[k] - p, a + noise[k]
        if k > 0:
            log_likelihood -= 0.5 * (math.log(total) + innovation**2 / total)
        p += a / total * innovation
        v += b / total * innovation
        c -= b * b / total
        a, b = a * noise[k] / total, b * noise[k] / total
        mean[k, 0], mean[k, 1] = p, v
        cov[k, 0], cov[k, 1], cov[k, 2] = a, b, c
    for k in range(n - 2, -1, -1):
        h = time[k + 1] - time[k]
        a, b, c = cov[k]
        A, B, C = predicted_cov[k + 1]
        determinant = A * C - B * B
        # gain G = P F' / P_predicted, row by row
        g00, g01 = ((a + h * b) * C - b * B) / determinant, (b * A - (a + h * b) * B) / determinant
        g10, g11 = ((b + h * c) * C - c * B) / determinant, (c * A - (b + h * c) * B) / determinant
        dp, dv = mean[k + 1, 0] - predicted[k + 1, 0], mean[k + 1, 1] - predicted[k + 1, 1]
        mean[k, 0] += g00 * dp + g01 * dv
        mean[k, 1] += g10 * dp + g11 * dv
        da, db, dc = cov[k + 1, 0] - A, cov[k + 1, 1] - B, cov[k + 1, 2] - C
        cov[k, 0] = a + g00 * g00 * da + 2.0 * g00 * g01 * db + g01 * g01 * dc
        cov[k, 1] = b + g00 * g10 * da + (g00 * g11 + g01 * g10) * db + g01 * g11 * dc
        cov[k, 2] = c + g10 * g10 * da + 2.0 * g10 * g11 * db + g11 * g11 * dc
    return log_likelihood, mean, cov[:, 0].copy()
