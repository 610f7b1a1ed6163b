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


def finest_cell(samples: RegistrationSamples, inside: Mask, grid: Grid) -> tuple[float, bool]:
    """Return the smallest size of a cell that the samples fill [px], and whether they repeat at the same places.

    Args:
        samples: all of them.
        inside: which of them lie inside the field, shape (n,).
        grid: the pixels.
    """
    cell = max(
        min(1.0, grid.width / MIN_CELLS_ACROSS),
        math.sqrt(MIN_SAMPLES_PER_CELL * grid.width * grid.height / samples.x.size),
    )
    occupied = _occupied_cell(samples.select(inside), cell)
    return occupied, occupied > cell


def _occupied_cell(samples: RegistrationSamples, cell: float) -> float:
    """The smallest size of a cell [px], from ``cell`` on, with an occupancy of ``MIN_OCCUPANCY``.

    Only samples further apart than a cell leave columns between them, so that it is hardly more than their distance.
    """
    if samples.x.size < 2:
        return cell
    distance = float(np.median(np.hypot(np.diff(samples.x), np.diff(samples.y))))
    column, row = (place - place.min() for place in (samples.x, samples.y))
    while cell < distance:
        columns, rows = (math.ceil(place.max() / cell) + 1 for place in (column, row))
        index = (row / cell).astype(np.int64) * columns + (column / cell).astype(np.int64)
        occupied, cells = np.count_nonzero(np.bincount(index)), columns * rows
        if occupied >= MIN_OCCUPANCY * cells * -math.expm1(-index.size / cells):
            break
        cell *= math.sqrt(2.0)
    return cell
