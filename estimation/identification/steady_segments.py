"""Segments of a driven record in which frequency and amplitude are steady."""

from __future__ import annotations

import numpy as np

from estimation.identification.fits import MAX_AMPLITUDE_CHANGE, DrivenRecord
from scanner.arrays import Array
from scanner.lock_in import block_length, block_phasors

SEGMENT_CYCLES = 200.0
"""Cycles per segment of a driven recording: a sweep changes little within one, which counts as one frequency."""


def steady_segments(angle: Array, voltage: Array, frequency: Array, rate: float) -> list[DrivenRecord]:
    """Segments of one frequency of a driven record; those whose amplitude changes are left out.

    Args:
        angle: [rad], voltage: [V], frequency: of the motion [Hz], each of shape (n,). rate: [Hz].
    """
    length = block_length(float(np.mean(frequency)), rate, SEGMENT_CYCLES)
    found = []
    for first in range(0, max(angle.size - length // 2, 1), length):
        cut = slice(first, min(first + length, angle.size))
        f = float(np.mean(frequency[cut]))
        block = block_length(f, rate, 10.0)
        if angle[cut].size < 4 * block:
            continue
        size = np.abs(block_phasors(angle[cut], rate, 0.0, f, block)[1])
        if np.ptp(size) < MAX_AMPLITUDE_CHANGE * size.mean():
            found.append(DrivenRecord(angle[cut], voltage[cut], f, rate))
    return found
