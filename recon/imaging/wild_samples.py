"""Single samples of a detector far from all others: electric pulses, cosmic rays, errors of a transfer."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanner.arrays import Array

MAX_CHECKED_SAMPLES = 1_000_000
"""Samples from the start of the intensity that are checked: 0.2 s at 5 MS/s. Sorting takes 0.1 s."""

TAIL_QUANTILE = 0.01
"""Share of the samples beyond the tail that scales the limit: fewer wild samples leave it unchanged."""

LIMIT_IN_TAILS = 10.0
"""Distance of a wild sample from the median, over that of the tail. An exponential distribution of intensities exceeds
it with a probability of 1e-17."""


class WildLimits(NamedTuple):
    """Median, and the values below and above which a single sample is wild; each of shape (detectors,)."""

    middle: Array
    low: Array
    high: Array


def wild_limits(values: Array) -> WildLimits:
    """The limits from samples of shape (n,) or (n, detectors).

    A scene with bright points has samples beyond them, too. Points are as wide as the beam's spot and mostly crossed in
    several samples, so that there is no limit where most of the samples beyond it have others beside them.
    """
    columns = values.reshape(len(values), -1).astype(float)
    columns = np.where(np.isfinite(columns), columns, np.nan)
    columns[:, np.isnan(columns).all(axis=0)] = 0.0
    low, middle, high = np.nanquantile(columns, [TAIL_QUANTILE, 0.5, 1.0 - TAIL_QUANTILE], axis=0)
    sides = []
    for sign, tail in ((-1.0, middle - low), (1.0, high - middle)):
        distance = LIMIT_IN_TAILS * np.where(tail > 0.0, tail, np.inf)
        far, alone = _find_far(sign * (columns - middle), distance)
        is_scene = alone.sum(axis=0) < 0.5 * far.sum(axis=0)
        sides.append(middle + sign * np.where(is_scene, np.inf, distance))
    return WildLimits(middle, *sides)


def usable_samples(values: Array, limits: WildLimits) -> NDArray[np.bool_]:
    """Whether each sample is finite and not wild, shape (n, detectors); arguments as :func:`find_wild_samples`."""
    return np.isfinite(values).reshape(len(values), -1) & ~find_wild_samples(values, limits)


def find_wild_samples(values: Array, limits: WildLimits) -> NDArray[np.bool_]:
    """Whether each sample is far from the median and the samples beside it are not, shape (n, detectors).

    Args:
        values: shape (n,) or (n, detectors).
        limits: of the detectors.
    """
    columns = values.reshape(len(values), -1).astype(float)
    below, above = (
        _find_far(sign * (columns - limits.middle), sign * (limit - limits.middle))[1]
        for sign, limit in ((-1.0, limits.low), (1.0, limits.high))
    )
    return (below | above) & np.isfinite(columns)


def _find_far(distance: Array, limit: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether samples lie beyond a limit, and whether they do while those beside them are not even in the tail.

    Args:
        distance: of each sample from the median, shape (n, detectors).
        limit: shape (detectors,).
    """
    far, in_tail = distance > limit, distance > limit / LIMIT_IN_TAILS
    beside = np.zeros_like(far)
    beside[1:] |= in_tail[:-1]
    beside[:-1] |= in_tail[1:]
    return far, far & ~beside
