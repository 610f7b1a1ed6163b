"""Single samples of a position signal far from their neighbours: a bit that flipped, or a spark in a cable."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimation.signals import robust_sd
from scanner.arrays import Array, Index

MIN_SPIKE_SDS = 8.0
"""Distance of a spike from the cubic through its neighbours, in robust standard deviations of that distance: noise
exceeds it once in 1e15 samples, and a sine, whose largest distance is 1.4 times the median one, never."""

MAX_NOISE_SAMPLES = 1 << 20
"""Samples, evenly spaced, from which the noise is measured: they determine it to 0.1 %, with little memory."""

NEAR_WEIGHT, FAR_WEIGHT = 4.0 / 6.0, -1.0 / 6.0
"""Weights of the two next samples, and of those after them, in the cubic through the four around a sample."""

NEIGHBOURS = {-2: FAR_WEIGHT, -1: NEAR_WEIGHT, 1: NEAR_WEIGHT, 2: FAR_WEIGHT}
"""The same by distance."""

REACH = 2


def find_spikes(values: Array) -> Index:
    """Samples that are isolated spikes, increasing.

    Without a spike the neighbours on one side at least fit those around them. Those of a step or of the flyback of a
    raster do not. Spikes that are one or two samples apart are not found. A corner of a clipped signal is no spike.

    Args:
        values: shape (n,).
    """
    if values.size <= 4 * REACH:
        return np.zeros(0, np.int64)
    distance = _distance(values)
    found = _find_far(distance, np.isfinite(distance))
    if not found.size:
        return found
    near_rail = _near_rail(values, found)
    if not near_rail.any():
        return found
    found = _find_far(distance, np.isfinite(distance) & ~near_rail)  # clipped samples have no noise
    return found[~near_rail[found]]


def _find_far(distance: Array, typical: NDArray[np.bool_]) -> Index:
    """Samples far from the cubic whose neighbours fit, in the noise of the ``typical`` samples; all of shape (n,)."""
    each = slice(None, None, max(1, distance.size // MAX_NOISE_SAMPLES))
    limit = MIN_SPIKE_SDS * robust_sd(distance[each][typical[each]]) if typical[each].any() else 0.0
    if not limit > 0.0:
        return np.zeros(0, np.int64)
    inner = distance[2 * REACH : -2 * REACH]
    found = 2 * REACH + np.flatnonzero((inner > limit) | (inner < -limit))
    fits = {
        step: np.abs(distance[found + step] + weight * distance[found]) <= limit for step, weight in NEIGHBOURS.items()
    }
    return found[(fits[-2] & fits[-1]) | (fits[1] & fits[2])]


def _near_rail(values: Array, found: Index) -> NDArray[np.bool_]:
    """Samples within reach of one at a rail, shape (n,): the cubic through it leaves the range of the converter.

    A rail is the largest or the smallest value of all samples that are not ``found``, if successive ones stand at it.
    """
    others, near = np.delete(values, found), np.zeros(values.size, np.bool_)
    for extreme in (np.nanmin(others), np.nanmax(others)):
        at_extreme = values == extreme
        if (at_extreme[:-1] & at_extreme[1:]).any():
            near |= np.convolve(at_extreme, np.ones(2 * REACH + 1), "same") > 0.5
    return near


def without_spikes(values: Array, spikes: Index) -> Array:
    """The values, shape (n,), with each isolated spike on the cubic through its neighbours."""
    if not spikes.size:
        return values
    repaired = values.copy()
    repaired[spikes] -= _distance(values)[spikes]
    return repaired


@njit(cache=True)
def _distance(values: Array) -> Array:
    """Each sample less the cubic through the two samples on either side, shape (n,); NaN at the ends."""
    out = np.full(values.size, np.nan)
    for i in range(REACH, values.size - REACH):
        near, far = values[i - 1] + values[i + 1], values[i - 2] + values[i + 2]
        out[i] = values[i] - NEAR_WEIGHT * near - FAR_WEIGHT * far
    return out
