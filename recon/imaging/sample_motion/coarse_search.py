"""Coarse translation of the sample in successive parts of a scan, by exhaustive comparison with the earlier parts.

For every translation up to ``MAX_STEP_PX`` from that of the part before, the mean square difference of the part's
samples from the picture of the earlier parts gives the likelihood. Pixels without samples are left out (Padfield 2012,
"Masked object registration in the Fourier domain"). A step needs likelihood against its prior, so that a scene without
structure remains at rest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from recon.imaging.sample_motion.block_equations import ScanSamples
from recon.imaging.smoothing import REACH
from scanner.arrays import Array

CELL_PX = 2.0
"""Width of the cells that are compared [px]: a few periods of the scan leave most pixels unvisited, but few cells."""

KERNEL_CELLS = 1.0
"""Standard deviation of the kernel of the picture of earlier parts [cells]."""

MAX_STEP_PX = 16.0
"""Largest step from one part to the next [px], above the 10 px that are asked for."""

STEP_SD_PX = 1.0
"""Standard deviation of the usual step [px]: a motion of 10 px at 5 Hz steps by less than 0.4 px in 2 ms."""

JUMP_PENALTY = 12.0
"""Negative log probability of a jump to a given cell, beside the number of cells: one in 10^5 parts."""


def search_motion(samples: ScanSamples, length: int, parts: int, shape: tuple[int, int]) -> Array:
    """Return the translation of each part, shape (parts, 2) [px].

    Args:
        samples: of the scan.
        length: samples in a part; the last part has the rest.
        parts: number of parts.
        shape: height and width of the picture [px].
    """
    reach = int(MAX_STEP_PX / CELL_PX)
    height, width = (int(np.ceil(side / CELL_PX)) for side in shape)
    size = tuple(next_fast_len(side + 2 * reach, real=True) for side in (height, width))
    steps: NDArray[np.int64] = np.arange(-reach, reach + 1)
    distance = np.hypot(*np.meshgrid(steps, steps, indexing="ij")) * CELL_PX
    found = np.zeros((parts, 2))
    reference, last = np.zeros((3, height, width)), np.zeros(2)
    for k in range(parts):
        part = slice(k * length, (k + 1) * length if k + 1 < parts else None)
        own = _grid(samples, part, last, (height, width))
        step = np.zeros(2)
        if k:
            cost, overlap = _costs(own, reference, size, steps)
            penalty = np.minimum(0.5 * (distance / STEP_SD_PX) ** 2, JUMP_PENALTY)
            log = 0.5 * overlap.max() * np.log(np.maximum(cost, 1e-30)) + penalty
            step = _refined_minimum(log, steps)
        last = last + step * CELL_PX
        found[k] = last
        reference += _grid(samples, part, last, (height, width))
    return found - found.mean(axis=0)


def _grid(samples: ScanSamples, part: slice, shift: Array, shape: tuple[int, int]) -> Array:
    """Count, sum and sum of squares by cell of the samples of a part, shape (3, height, width)."""
    (x, y), value = samples.places(part), samples.value[part]
    column, row = np.floor((x - shift[0]) / CELL_PX), np.floor((y - shift[1]) / CELL_PX)
    used = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0]) & np.isfinite(value)
    cell, value = (row[used] * shape[1] + column[used]).astype(np.int64), value[used]
    number = shape[0] * shape[1]
    sums = [np.bincount(cell, weights, number) for weights in (np.ones(value.size), value, value**2)]
    return np.stack(sums).astype(float).reshape(3, *shape)


def _costs(own: Array, reference: Array, size: tuple[int, ...], steps: NDArray[np.int64]) -> tuple[Array, Array]:
    """Mean square difference and number of compared samples by step, each of shape (steps, steps): rows are y."""
    import cv2

    odd = 2 * max(int(REACH * KERNEL_CELLS + 0.5), 1) + 1
    count, total = (
        cv2.GaussianBlur(each, (odd, odd), KERNEL_CELLS, borderType=cv2.BORDER_CONSTANT) for each in reference[:2]
    )
    weight = count / (count + 0.3)
    mean = np.divide(total, count, out=np.zeros_like(total), where=count > 1e-6)
    level = total.sum() / max(count.sum(), 1e-30)
    mean = np.where(count > 1e-6, mean - level, 0.0)
    number, sums, squares = own
    squares = squares - 2.0 * level * sums + level**2 * number
    sums = sums - level * number
    fixed = [rfft2(each, size) for each in (weight, weight * mean, weight * mean**2)]
    moved = [rfft2(each, size) for each in (number, sums, squares)]

    def correlate(a: Array, b: Array) -> Array:
        """Sum of a(place) b(place - step)."""
        return np.asarray(irfft2(a * np.conj(b), size)[np.ix_(-steps, -steps)])

    overlap = np.maximum(correlate(fixed[0], moved[0]), 1.0)
    cost = correlate(fixed[0], moved[2]) - 2.0 * correlate(fixed[1], moved[1]) + correlate(fixed[2], moved[0])
    return np.maximum(cost, 0.0) / overlap, overlap


def _refined_minimum(values: Array, steps: NDArray[np.int64]) -> Array:
    """Step (x, y) of the least value [cells], by a parabola through its neighbours."""
    row, column = np.unravel_index(np.argmin(values), values.shape)
    result = []
    for line, at in ((values[row], column), (values[:, column], row)):
        offset = 0.0
        if 0 < at < len(steps) - 1:
            before, here, after = line[at - 1 : at + 2]
            bend = before - 2.0 * here + after
            offset = 0.5 * (before - after) / bend if bend > 0 else 0.0
        result.append(steps[at] + offset)
    return np.array(result)
