"""Edge times of a sync signal that was sampled, as the output of a comparator in a column of an oscilloscope."""

from __future__ import annotations

import numpy as np

from scanner.arrays import Array

LEVEL_QUANTILE = 1e-3
"""Quantile of the low samples at which the signal is low, and from the top of the high ones at which it is high."""

HYSTERESIS = 0.25
"""Distance from the middle, relative to that of both levels, that a sample has to pass before the next edge counts."""

DIRECTIONS = {"zero-crossing-up": (1,), "zero-crossing-down": (-1,)}
"""Edges of the signal that belong to an event: rising or falling ones; both for any other event."""


def find_edges(values: Array, rate: float, start: float, event: str) -> Array:
    """Times at which a signal passes the middle of its two levels, interpolated between samples.

    Args:
        values: shape (n,); samples that are not finite are left out.
        rate: [Hz]. start: of the first sample [s].
        event: of the detector, which selects the direction.

    Returns:
        Edge times [s], increasing; none of a signal that is constant.
    """
    at = np.flatnonzero(np.isfinite(values))
    values = values[at]
    if values.size < 2:
        return np.empty(0)
    low, high = _levels(values)
    middle, margin = 0.5 * (low + high), HYSTERESIS * (high - low)
    outside = np.flatnonzero(np.abs(values - middle) > margin)
    side = np.sign(values[outside] - middle)
    changed = np.flatnonzero(side[1:] != side[:-1]) + 1
    times = []
    for direction in DIRECTIONS.get(event, (1, -1)):
        before = np.where((values - middle) * direction <= 0.0, np.arange(values.size), 0)
        last = np.maximum.accumulate(before)[outside[changed[side[changed] == direction]]]
        share = (middle - values[last]) / (values[last + 1] - values[last])
        times.append(start + (at[last] + share * (at[last + 1] - at[last])) / rate)
    return np.sort(np.concatenate(times))


def _levels(values: Array) -> tuple[float, float]:
    """The two levels of a signal, however short its pulses are.

    The low samples are separated from the high ones where the variance within both is smallest (Otsu 1979).
    """
    ordered = np.sort(values)
    below = np.arange(1, ordered.size)
    sums = np.cumsum(ordered - ordered[0])
    difference = sums[:-1] / below - (sums[-1] - sums[:-1]) / below[::-1]
    count = 1 + int(np.argmax(below * below[::-1] * difference**2))
    low = np.quantile(ordered[:count], LEVEL_QUANTILE)
    return float(low), float(np.quantile(ordered[count:], 1.0 - LEVEL_QUANTILE))
