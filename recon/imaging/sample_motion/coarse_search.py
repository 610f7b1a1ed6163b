"""Coarse translation of the sample in successive parts of a scan, by exhaustive comparison with the earlier parts.

For every translation up to ``MAX_STEP_PX`` from that of the part before, the picture of the earlier parts predicts the
part's samples, with a mean and a variance by cell. Cells without earlier samples predict the mean and the variance of
the scene, so that the likelihoods of all translations are those of the same samples. With overlapping samples alone, a
part that moves away would no longer contradict the picture. A step needs likelihood against its prior, so that a scene
without structure remains at rest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from recon.imaging.sample_motion.placed_samples import PlacedSamples
from recon.imaging.sample_motion.residual_noise import fit_residual_noise
from recon.imaging.smoothing import REACH
from scanner.arrays import Array

CELL_PX = 2.0
"""Width of the cells that are compared [px]: a few periods of the scan leave most pixels unvisited, but few cells."""

KERNEL_CELLS = 1.0
"""Standard deviation of the kernel of the picture of earlier parts [cells]."""

PRIOR_SAMPLES = 0.3
"""Samples that the level of the scene counts for in the value of a cell."""

MAX_STEP_PX = 16.0
"""Largest step from one part to the next [px], above the 10 px that are asked for."""

STEP_SD_PX = 1.0
"""Standard deviation of the usual step [px]: a motion of 10 px at 5 Hz steps by less than 0.4 px in 2 ms."""

JUMP_PENALTY = 12.0
"""Negative log probability of a jump to a given cell, beside the number of cells: one in 10^5 parts."""


def search_motion(samples: PlacedSamples, length: int, parts: int, shape: tuple[int, int]) -> Array:
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
            penalty = np.minimum(0.5 * (distance / STEP_SD_PX) ** 2, JUMP_PENALTY)
            step = _refined_minimum(_costs(own, reference, size, steps) + penalty, steps)
        last = last + step * CELL_PX
        found[k] = last
        reference += _grid(samples, part, last, (height, width))
    return found - found.mean(axis=0)


def _grid(samples: PlacedSamples, part: slice, shift: Array, shape: tuple[int, int]) -> Array:
    """Count, sum and sum of squares by cell of the samples of a part, shape (3, height, width)."""
    (x, y), value = samples.places(part), samples.value[part]
    column, row = np.floor((x - shift[0]) / CELL_PX), np.floor((y - shift[1]) / CELL_PX)
    used = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0]) & np.isfinite(value)
    cell, value = (row[used] * shape[1] + column[used]).astype(np.int64), value[used]
    number = shape[0] * shape[1]
    sums = [np.bincount(cell, weights, number) for weights in (np.ones(value.size), value, value**2)]
    return np.stack(sums).astype(float).reshape(3, *shape)


def _costs(own: Array, reference: Array, size: tuple[int, ...], steps: NDArray[np.int64]) -> Array:
    """Negative log probability of the part's samples by step, up to a constant, shape (steps, steps): rows are y.

    The earlier samples around a cell draw its value from the level of the scene to their mean, in the proportion of
    their number to ``PRIOR_SAMPLES``. The variance is that of the residuals at the present translation, and the share
    of the scene's variance that they leave.

    Args:
        own, reference: of the part and of the earlier parts, as returned by :func:`_grid`.
        size: of the Fourier transforms.
        steps: in x and y [cells], shape (steps,).
    """
    import cv2

    odd = 2 * max(int(REACH * KERNEL_CELLS + 0.5), 1) + 1
    count, total = (
        cv2.GaussianBlur(each, (odd, odd), KERNEL_CELLS, borderType=cv2.BORDER_CONSTANT) for each in reference[:2]
    )
    samples = max(reference[0].sum(), 1.0)
    level = reference[1].sum() / samples
    spread = reference[2].sum() / samples - level**2
    weight = count / (count + PRIOR_SAMPLES)
    mean = weight * (np.divide(total, count, out=np.full_like(total, level), where=count > 1e-6) - level)
    number, sums = own[0], own[1] - level * own[0]
    squares = own[2] - 2.0 * level * own[1] + level**2 * number
    visited = (number > 0.0) & (count > PRIOR_SAMPLES)
    if not visited.any() or not spread > 0.0:
        return np.zeros((steps.size, steps.size))
    down, across = np.gradient(mean)
    gradient = down**2 + across**2
    square = squares - 2.0 * mean * sums + mean**2 * number
    residual = np.sqrt(np.maximum(square[visited] / number[visited], 0.0))
    noise = fit_residual_noise(mean[visited], gradient[visited], residual)
    variance = np.minimum(noise.at(mean, gradient), spread) + (1.0 - weight) * spread
    outside = min(noise.floor, spread) + spread
    terms = 1.0 / variance - 1.0 / outside, mean / variance, mean**2 / variance + np.log(variance / outside)
    fixed = [rfft2(each, size) for each in terms]
    moved = [rfft2(each, size) for each in (squares, sums, number)]

    def correlate(a: Array, b: Array) -> Array:
        """Sum of a(place) b(place - step)."""
        return np.asarray(irfft2(a * np.conj(b), size)[np.ix_(-steps, -steps)])

    products = [correlate(one, other) for one, other in zip(fixed, moved, strict=True)]
    return 0.5 * (products[0] - 2.0 * products[1] + products[2])


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
