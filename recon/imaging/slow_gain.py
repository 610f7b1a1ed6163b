"""Slow changes of the detector's gain, estimated beside the phase error so that they are not attributed to the phase.

Bleaching, laser power and a detector's supply change the gain over many periods of the slower axis. Samples of one
place at two times then differ, as with a phase error. The model of sample i in cell p is

    I_i = s_p exp(γ(t_i)) + noise,    γ(t) = Σ_j w_j(t) γ_j,   γ_j ~ N(0, PRIOR_SD²),

with hat functions w_j between the ends of the time slices: each slice covers the field, so that it determines a gain.
The scene s is free, and is eliminated. Gauss-Newton gives the posterior of γ. Faster changes are removed from the
picture on request (``intensity_drift``), which takes longer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanner.arrays import Array

PRIOR_SD = 0.5
"""Standard deviation of the logarithm of the gain at the end of a slice: bleaching to 60 %. Samples that determine no
gain leave it at 1."""

ROUNDS = 3
"""Steps of Gauss-Newton: each squares the relative error of the step before, which is a tenth for a fall to a half."""

REPORTED_SDS = 3.0
"""Change of the gain in standard deviations from which it is reported: 0.3 % of noise exceeds."""

MIN_REPORTED_CHANGE = 0.01
"""Relative change of the gain from which it is reported: a third of the noise of a pixel of 1000 photons."""


class SlowGain(NamedTuple):
    """Posterior of the logarithm of the gain at the ends of the slices, with mean 0, as a factor belongs to the scene.

    Attributes:
        log_gain: shape (slices + 1,).
        covariance: shape (slices + 1, slices + 1).
    """

    log_gain: Array
    covariance: Array

    def at(self, time: Array) -> Array:
        """The gain at times in slices, shape (n,)."""
        return np.exp(np.interp(time, np.arange(self.log_gain.size), self.log_gain))

    @property
    def change(self) -> tuple[float, float]:
        """Relative change from the largest to the smallest gain, positive if it rises with time, and its sd."""
        low, high = int(np.argmin(self.log_gain)), int(np.argmax(self.log_gain))
        first, last = min(low, high), max(low, high)
        change = math.exp(self.log_gain[last] - self.log_gain[first])
        pair = self.covariance[np.ix_((first, last), (first, last))]
        return change - 1.0, change * math.sqrt(max(pair[0, 0] + pair[1, 1] - 2.0 * pair[0, 1], 0.0))


def estimate_slow_gain(cell: NDArray[np.int64], time: Array, intensity: Array, slices: int) -> SlowGain:
    """The slow gain of the samples of a scan.

    Args:
        cell: number of the cell of each sample, shape (n,).
        time: of each sample in slices, from 0 to ``slices``, shape (n,).
        intensity: shape (n,).
        slices: equal parts of the scan.
    """
    knots, left = slices + 1, np.minimum(time.astype(np.int64), slices - 1)
    weights = (1.0 - (time - left), time - left)
    number = np.maximum(np.bincount(cell), 1).astype(float)

    def sum_by_knot(values: Array) -> Array:
        """Sums of the values times each hat function over the samples of each cell, shape (cells, knots)."""
        size = number.size * knots
        first, last = (np.bincount(cell * knots + left + side, weights[side] * values, size) for side in (0, 1))
        return np.asarray(first + last).reshape(number.size, knots)

    visits = sum_by_knot(np.ones_like(intensity))
    free = max(cell.size - np.count_nonzero(visits.any(axis=1)), 1)
    found = SlowGain(np.zeros(knots), np.eye(knots))
    for _ in range(ROUNDS):
        corrected = intensity / found.at(time)
        scene = np.bincount(cell, corrected) / number
        residual, square = corrected - scene[cell], scene[cell] ** 2
        information = -(visits.T * (scene**2 / number)) @ visits
        for one in (0, 1):
            for other in (0, 1):
                product = np.bincount(left, weights[one] * weights[other] * square, slices)
                information[np.arange(slices) + one, np.arange(slices) + other] += product
        prior = residual @ residual / free / PRIOR_SD**2
        inverse = np.linalg.pinv(information + prior * np.eye(knots))
        step = inverse @ (scene @ sum_by_knot(residual) - prior * found.log_gain)
        log_gain = found.log_gain + step
        found = SlowGain(log_gain - log_gain.mean(), prior * PRIOR_SD**2 * inverse)
    return found


def describe_slow_gain(gains: Sequence[SlowGain]) -> list[str]:
    """A line if the gain changes, with the option that removes the change from the picture.

    Args:
        gains: of parts of the scan, each with its own picture.
    """
    changes = [gain.change for gain in gains]
    clear = [each for each in changes if abs(each[0]) > max(MIN_REPORTED_CHANGE, REPORTED_SDS * each[1])]
    if not clear:
        return []
    change, sd = max(clear, key=lambda each: abs(each[0]))
    return [
        f"intensity: samples of one place {'rise' if change > 0.0 else 'fall'} by {100 * abs(change):.2g} % "
        f"± {100 * sd:.1g} % during the scan (gain, laser power or bleaching). The phase allows for it, the picture "
        "does not: run again with --intensity-drift gain, or offset for stray light"
    ]
