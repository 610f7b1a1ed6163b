"""The rail of a clipped signal: many samples exactly at its largest value."""

from __future__ import annotations

import numpy as np

from scanner.arrays import Array

MIN_CLIPPED_SAMPLES = 5
"""Number of samples at the extreme value from which it is a rail. By noise alone two or three samples share the largest
value of a converter."""

MIN_CLIPPED_RATIO = 3.0
"""Number of samples at the extreme value over that at the most frequent value next to it. A sine without clipping
already has more samples at its turning points, but by less than this factor."""

NEIGHBOURS = 8
"""Distinct values next to the extreme one whose sample counts are compared with its own."""

MIN_EXCESS_SD = 5.0
"""Excess of samples at the largest value over the expected number, in standard deviations of that number, from which it
is a rail: chance exceeds it in 3e-7 of histograms."""

MAX_STEP_DIFFERENCE = 1e-6
"""Relative difference of the steps between values up to which they are those of a counter."""


def upper_rail(signal: Array) -> tuple[float, int] | None:
    """Largest value of a signal of shape (n,) and the number of samples there, None where it is no rail."""
    values, counts = np.unique(signal, return_counts=True)
    if values.size <= NEIGHBOURS or counts[-1] < MIN_CLIPPED_SAMPLES:
        return None
    if counts[-1] < MIN_CLIPPED_RATIO * counts[-1 - NEIGHBOURS : -1].max():
        return None
    return float(values[-1]), int(counts[-1])


def upper_rail_of_counts(signal: Array) -> tuple[float, int] | None:
    """As :func:`upper_rail`, for counts of photons, whose noise gives an unsaturated histogram a smooth end.

    It is a rail if significantly more samples stand at the largest value than the values below it let expect: the
    logarithm of their numbers, continued as a straight line. The numbers of an unsaturated tail fall faster than that.
    """
    values, counts = np.unique(signal, return_counts=True)
    if values.size <= NEIGHBOURS or counts[-1] < MIN_CLIPPED_SAMPLES:
        return None
    steps = np.diff(values[-1 - NEIGHBOURS :])
    if np.ptp(steps) > MAX_STEP_DIFFERENCE * steps[0]:
        return None
    below = counts[-1 - NEIGHBOURS : -1].astype(float)
    offset = np.polyfit(np.arange(-NEIGHBOURS, 0), np.log(below), 1, w=np.sqrt(below))[1]
    expected = float(np.exp(offset))
    if counts[-1] - expected < MIN_EXCESS_SD * np.sqrt(expected):
        return None
    return float(values[-1]), int(counts[-1])
