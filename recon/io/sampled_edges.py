"""Edge times of a sync signal that was sampled, as the output of a comparator in a column of an oscilloscope."""

from __future__ import annotations

import numpy as np

from scanner.arrays import Array

LEVEL_QUANTILE = 1e-3
"""Quantile of the samples at which the signal is low, and from the top at which it is high: a pulse may be short."""

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
    low, high = np.quantile(values, [LEVEL_QUANTILE, 1.0 - LEVEL_QUANTILE])
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
