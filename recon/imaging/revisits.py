"""Whether a scan comes back to the places of the field, so that a drift of the detector differs from the scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.arrays import Array

MIN_TIME_SHARE = 0.1
"""Share of the variance of time that lies within the cells, from which on a drift is estimated. It is 0.3 to 0.7 for
Lissajous figures and rasters, and below 0.03 for spirals that visit every place once: the detail within their cells
showed gains that rise by 120 % or fall by 70 %, where there was none."""


def is_revisited(cell: NDArray[np.integer], time: Array) -> bool:
    """Whether samples of one cell of the field were taken at times that are far apart; False without any sample.

    Args:
        cell: number of the cell of each sample, shape (n,).
        time: of each sample, in any unit, shape (n,).
    """
    if not cell.size:
        return False
    visited = np.bincount(cell, time) / np.maximum(np.bincount(cell), 1)
    return bool(np.var(time - visited[cell]) >= MIN_TIME_SHARE * np.var(time))
