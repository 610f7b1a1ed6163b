"""Size of the cells in which forward and backward half-periods are compared."""

from __future__ import annotations

import math

import numpy as np

from recon.imaging.picture import Grid
from recon.imaging.scan_phase.bidirectional_search import RegistrationSamples
from scanner.arrays import Mask

MIN_SAMPLES_PER_CELL = 2.0
"""Samples per cell below which the pattern of the scan lines biases the result."""

MIN_OCCUPANCY = 0.8
"""Number of cells with a sample, over that of samples at random places, below which cells are too fine. Figures of
incommensurate frequencies have 0.9 to 1.1. Where the sample rate is a multiple of a frequency, it is 0.4 to 0.6: the
samples fall on columns with empty cells between them, and detail between the columns would shift the phase."""

MIN_CELLS_ACROSS = 400
"""Cells across the field that are used, if there are samples for them, however few pixels the picture has: coarse cells
do not resolve fine detail, which then biases the result."""


def finest_cell(samples: RegistrationSamples, inside: Mask, grid: Grid) -> float:
    """Return the smallest size of a cell that the samples fill [px].

    Args:
        samples: all of them.
        inside: which of them lie inside the field, shape (n,).
        grid: the pixels.
    """
    cell = max(
        min(1.0, grid.width / MIN_CELLS_ACROSS),
        math.sqrt(MIN_SAMPLES_PER_CELL * grid.width * grid.height / samples.x.size),
    )
    return _occupied_cell(samples.select(inside), cell)


def _occupied_cell(samples: RegistrationSamples, cell: float) -> float:
    """The smallest size of a cell [px], from ``cell`` on, with an occupancy of ``MIN_OCCUPANCY``; at most
    a sixteenth of the smaller side of the field that the samples cover."""
    ranges = [(float(np.min(place)), float(np.ptp(place))) for place in (samples.x, samples.y)]
    most = min(length for _, length in ranges) / 16.0
    while cell < most:
        column, row = (
            ((place - first) / cell).astype(np.int64)
            for place, (first, _) in zip((samples.x, samples.y), ranges, strict=True)
        )
        columns, rows = (math.ceil(length / cell) for _, length in ranges)
        occupied = np.count_nonzero(np.bincount(row * (columns + 1) + column))
        at_random = columns * rows * -math.expm1(-samples.x.size / (columns * rows))
        if occupied >= MIN_OCCUPANCY * at_random:
            break
        cell *= math.sqrt(2.0)
    return cell
