"""Smoothing of the phase of a drive at knots: noise and coarse samples of a voltage are no motion of its phase."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from scanner.arrays import Array, Index

NOISE_BEND_RATIOS = 10.0 ** np.arange(-8.0, 9.0, 2.0)
"""Variances of the noise over that of the bends that are compared: from a curve through every knot to one that is
straight over about a hundred knots, during which most mirrors forget their motion."""

MIN_KNOTS = 10
"""Knots from which their noise is measured: a single jump, which changes three of the differences, then leaves the
median of seven at that of the noise."""

MIN_JUMP_SDS = 8.0
"""Third difference that is a jump of phase or frequency, in its standard deviations: noise exceeds it once in 1e15."""

NORMAL_MEDIAN = 0.6745
"""Median absolute value of a standard normal variable."""


def smooth_knots(time: Array, phase: Array) -> Array:
    """The phase without the noise of single knots, shape (n,).

    A line that bends at every knot by a random amount is measured with white noise (Whittaker's smoother), between two
    jumps of phase or frequency. The noise is the median one and the bends are those of the largest likelihood, so that
    knots without noise are returned as they are.

    Args:
        time: increasing, shape (n,) [s].
        phase: at the knots, shape (n,) [rad].
    """
    if time.size < MIN_KNOTS:
        return phase
    jumps, difference_sd = find_jumps(phase)
    if not difference_sd > 0.0:
        return phase
    noise = difference_sd / np.sqrt(20.0)
    bounds = [0, *jumps.tolist(), time.size]
    parts = [slice(first, stop) for first, stop in pairwise(bounds)]
    return np.concatenate([_smooth_part(time[part], phase[part] / noise) * noise for part in parts])


def find_jumps(phase: Array) -> tuple[Index, float]:
    """Numbers of the knots before which the phase or the frequency may jump, and the sd of the third differences.

    A jump is large in three of them.

    Args:
        phase: at the knots, shape (n,) [rad].
    """
    differences = np.abs(np.diff(phase, n=3))
    sd = float(np.median(differences)) / NORMAL_MEDIAN if differences.size else 0.0
    return 2 + np.flatnonzero(differences > MIN_JUMP_SDS * sd), sd


def _smooth_part(time: Array, value: Array) -> Array:
    """Values with noise of sd 1 and no jump, smoothed, shape (n,)."""
    if time.size < 3:
        return value
    step = np.diff(time) / np.median(np.diff(time))
    middle = time - time.mean()
    line = np.polyval(np.polyfit(middle, value, 1), middle)
    bends = _bend_products(step)
    fits = [_fit(value - line, step, bends, ratio) for ratio in NOISE_BEND_RATIOS]
    return np.asarray(line + max(fits, key=lambda fit: fit[0])[1])


def _bend_products(step: Array) -> Array:
    """Upper bands of D' D, where D takes the bends of a line at inner knots, shape (3, n); ``step`` (n - 1,)."""
    left, right = 1.0 / step[:-1], 1.0 / step[1:]
    rows = np.stack([left, -left - right, right])  # weights of three successive knots in each bend
    bands = np.zeros((3, step.size + 1))
    for first in range(3):
        for second in range(first, 3):
            bands[2 - (second - first), second : second + rows.shape[1]] += rows[first] * rows[second]
    return bands


def _fit(value: Array, step: Array, bends: Array, ratio: float) -> tuple[float, Array]:
    """Log-likelihood of values with noise of sd 1, up to a constant, and the smoothed values, shape (n,)."""
    matrix = ratio * bends
    matrix[2] += 1.0
    factor = cholesky_banded(matrix)
    smooth = np.asarray(cho_solve_banded((factor, False), value))
    misfit = float(np.sum((value - smooth) ** 2) + ratio * np.sum(np.diff(np.diff(smooth) / step) ** 2))
    return 0.5 * ((value.size - 2) * float(np.log(ratio)) - misfit) - float(np.log(factor[2]).sum()), smooth
