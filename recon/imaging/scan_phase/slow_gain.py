"""Slow changes of the detector's gain, estimated beside the phase error so that they are not attributed to the phase.

Bleaching, laser power and a detector's supply change the gain over many periods of the slower axis. Samples of one
place at two times then differ, as with a phase error. The model of sample i in cell p is

    I_i = s_p exp(γ(t_i)) + noise,    γ(t) = Σ_j w_j(t) γ_j,   γ_j ~ N(0, PRIOR_SD²),

with hat functions w_j between the ends of the time slices: each slice covers the field, so that it determines a gain.
Where the scan comes to each place at one time only, as a spiral that opens, gain and scene are one. The scene s is
free, and is eliminated. Gauss-Newton gives the posterior of γ. The variance of a sample follows from the scatter of the
scores of the cells, which holds the detail within a cell: a few bright points would else show a drift. A steady gain
has half of the prior probability, so that a steady detector keeps its intensity. Faster changes are removed from the
picture on request (``intensity_drift``), which takes longer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.imaging.revisits import is_revisited
from scanner.arrays import Array

PRIOR_SD = 0.5
"""Standard deviation of the logarithm of the gain at the end of a slice: bleaching to 60 %. Samples that determine no
gain leave it at 1."""

ROUNDS = 3
"""Steps of Gauss-Newton: each squares the relative error of the step before, which is a tenth for a fall to a half."""

MIN_VARIANCE = 1e-100
"""Variance of a sample in samples without noise: keeps the precision finite."""

MAX_EVIDENCE = 1000.0
"""Largest -2 log of the odds of a drift: its exponential is finite."""

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
        return _gain_at(self.log_gain, time)

    @property
    def change(self) -> tuple[float, float]:
        """Relative change from the largest to the smallest gain, positive if it rises with time, and its sd."""
        low, high = int(np.argmin(self.log_gain)), int(np.argmax(self.log_gain))
        first, last = min(low, high), max(low, high)
        change = math.exp(self.log_gain[last] - self.log_gain[first])
        pair = self.covariance[np.ix_((first, last), (first, last))]
        return change - 1.0, change * math.sqrt(max(pair[0, 0] + pair[1, 1] - 2.0 * pair[0, 1], 0.0))


def _gain_at(log_gain: Array, time: Array) -> Array:
    """The gain at times in slices, shape (n,), from its logarithm at their ends."""
    return np.exp(np.interp(time, np.arange(log_gain.size), log_gain))


def estimate_slow_gain(cell: NDArray[np.int64], time: Array, intensity: Array, slices: int) -> SlowGain:
    """The slow gain of the samples of a scan, averaged over a steady and a changing one by their probabilities.

    Args:
        cell: number of the cell of each sample, shape (n,).
        time: of each sample in slices, from 0 to ``slices``, shape (n,).
        intensity: shape (n,).
        slices: equal parts of the scan.
    """
    knots, left = slices + 1, np.minimum(time.astype(np.int64), slices - 1)
    weights = (1.0 - (time - left), time - left)
    number = np.maximum(np.bincount(cell), 1).astype(float)
    if not is_revisited(cell, time):
        return SlowGain(np.zeros(knots), PRIOR_SD**2 * np.eye(knots))

    def sum_by_knot(values: Array) -> Array:
        """Sums of the values times each hat function over the samples of each cell, shape (cells, knots)."""
        size = number.size * knots
        first, last = (np.bincount(cell * knots + left + side, weights[side] * values, size) for side in (0, 1))
        return np.asarray(first + last).reshape(number.size, knots)

    visits = sum_by_knot(np.ones_like(intensity))
    log_gain = np.zeros(knots)
    for _ in range(ROUNDS):
        corrected = intensity / _gain_at(log_gain, time)
        scene = np.bincount(cell, corrected) / number
        information = -(visits.T * (scene**2 / number)) @ visits
        for one in (0, 1):
            for other in (0, 1):
                product = np.bincount(left, weights[one] * weights[other] * scene[cell] ** 2, slices)
                information[np.arange(slices) + one, np.arange(slices) + other] += product
        scores = scene[:, None] * sum_by_knot(corrected - scene[cell])
        variance = max(np.trace(np.linalg.pinv(information) @ scores.T @ scores) / slices, MIN_VARIANCE)
        precision = information / variance + np.eye(knots) / PRIOR_SD**2
        covariance = np.linalg.inv(precision)
        log_gain = log_gain + covariance @ (scores.sum(axis=0) / variance - log_gain / PRIOR_SD**2)
        log_gain = log_gain - log_gain.mean()
    evidence = log_gain @ precision @ log_gain - np.linalg.slogdet(precision * PRIOR_SD**2)[1]
    share = 1.0 / (1.0 + math.exp(-0.5 * max(evidence, -MAX_EVIDENCE)))
    return SlowGain(share * log_gain, share * (covariance + (1.0 - share) * np.outer(log_gain, log_gain)))


class GainPart(NamedTuple):
    """The slow gain of a part of the scan with its own picture, and the begin and the end of the part [samples]."""

    begin: int
    end: int
    gain: SlowGain


def join_gains(parts: Sequence[GainPart]) -> SlowGain:
    """The gain over the whole scan, from parts whose gains are each known up to a factor.

    The gain is continuous. Between two parts its logarithm changes with the mean of their slopes.

    Args:
        parts: in the order of time, at least one.
    """
    sizes = [part.gain.log_gain.size for part in parts]
    firsts = np.cumsum([0, *sizes])
    own = np.eye(firsts[-1])
    slopes = [
        (own[last - 1] - own[first]) / (part.end - part.begin)
        for first, last, part in zip(firsts[:-1], firsts[1:], parts, strict=True)
    ]
    joined = [own[: sizes[0]]]
    for k in range(1, len(parts)):
        gap = parts[k].begin - parts[k - 1].end
        start = joined[-1][-1] + gap * 0.5 * (slopes[k - 1] + slopes[k])
        joined.append(start + own[firsts[k] : firsts[k + 1]] - own[firsts[k]])
    combine = np.concatenate(joined)
    combine -= combine.mean(axis=0)
    covariance = np.zeros_like(own)
    for first, last, part in zip(firsts[:-1], firsts[1:], parts, strict=True):
        covariance[first:last, first:last] = part.gain.covariance
    log_gain = combine @ np.concatenate([part.gain.log_gain for part in parts])
    return SlowGain(log_gain, combine @ covariance @ combine.T)


def describe_slow_gain(parts: Sequence[GainPart]) -> list[str]:
    """A line if the gain changes, with the option that removes the change from the picture.

    Args:
        parts: in the order of time.
    """
    if not parts:
        return []
    change, sd = join_gains(parts).change
    if abs(change) <= max(MIN_REPORTED_CHANGE, REPORTED_SDS * sd):
        return []
    return [
        f"intensity: samples of one place {'rise' if change > 0.0 else 'fall'} by {100 * abs(change):.3g} % "
        f"± {100 * sd:.2g} % during the scan: the gain of the channel or what it records drifts. The phase allows for "
        "it, the picture does not: run again with --intensity-drift gain, or offset for a drift that adds to the signal"
    ]
