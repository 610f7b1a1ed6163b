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


def upper_rail(signal: Array) -> tuple[float, int] | None:
    """Largest value of a signal of shape (n,) and the number of samples there, None where it is no rail."""
    values, counts = np.unique(signal, return_counts=True)
    if values.size <= NEIGHBOURS or counts[-1] < MIN_CLIPPED_SAMPLES:
        return None
    if counts[-1] < MIN_CLIPPED_RATIO * counts[-1 - NEIGHBOURS : -1].max():
        return None
    return float(values[-1]), int(counts[-1])
