"""Gridding: mean and count of the samples in each pixel, from angles and intensities.

The pixel law is eq (2) of Chen et al. (2020) with its edges decided: pixel k holds k < N/2 (θ/half_angle + 1) <= k + 1,
the field's lower edge belongs to pixel 0, and what lies outside the field is dropped.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from recon.imaging.picture import MAX_PIXELS, Grid, Picture
from scanner.arguments import check_type
from scanner.errors import BadInput

BLOCK_SAMPLES = 256
"""Samples whose pixel indices are computed before their values are added: their arrays fit into the first-level
cache."""

FRACTION_BITS = 18
"""Bits of an int32 for the fraction of a position in pixels. The other bits hold the whole part and the sign."""

MAX_FAST_PIXELS = 1 << 12
"""Pixels across up to which positions with ``FRACTION_BITS`` fit into an int32."""

OUTSIDE_INDEX = MAX_PIXELS
"""Pixel index of a sample outside the field: above every index, and still an int32."""

SHARED_CELL_TYPES = ("i1", "u1", "i2", "u2")
"""Integer types of an intensity for which sum and count share a cell of eight bytes."""

COUNT_BITS = 24
"""Bits of a shared cell for the count. The upper 40 bits hold the sum."""

MAX_SHARED_SAMPLES = 1 << (COUNT_BITS - 1)
"""Samples after which shared cells are emptied: no cell overflows, even if all samples fall on one pixel."""


@numba.njit(cache=True, inline="always")
def pixel_of(angle: float, half_angle: float, n: int) -> int:
    """Return `pixel_index` of one angle; for compiled loops."""
    position = angle / half_angle
    if not abs(position) <= 1.0:  # outside the field, or NaN
        return -1
    return max(math.ceil(0.5 * n * (position + 1.0)) - 1, 0)


@numba.vectorize(cache=True)
def _pixels(angle: float, half_angle: float, n: int) -> int:
    return pixel_of(angle, half_angle, n)


def pixel_index(angle: NDArray[Any] | float, half_angle: float, n: int) -> NDArray[np.int64]:
    """Return the column (or row) that an angle falls in: ceil(n/2 (θ/half_angle + 1)) - 1 within ±half_angle.

    Args:
        angle: any shape [rad].
        half_angle: the field's edge [rad].
        n: pixels across.

    Returns:
        Index, shape of ``angle``; -1 outside the field and for NaN.
    """
    return _pixels(angle, half_angle, n)


def find_sample_pixels(theta_x: NDArray[Any], theta_y: NDArray[Any], grid: Grid) -> NDArray[np.int32]:
    """Return the number of the pixel of each sample, row by row; -1 outside the field and for NaN.

    Args:
        theta_x, theta_y: mechanical angles, shape (n,) [rad].
        grid: the pixels.
    """
    column = pixel_index(theta_x, grid.half_angle_x, grid.width)
    row = pixel_index(theta_y, grid.half_angle_y, grid.height)
    return np.where((column >= 0) & (row >= 0), row * grid.width + column, -1).astype(np.int32)


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def _find_pixels_fast(x, y, values, half_x, half_y, width, height, index):  # type: ignore[no-untyped-def]
    """`_find_pixels_exact` without branches and divisions, for SIMD; False if a position is too close to an edge.

    Positions are whole multiples of 2^-FRACTION_BITS pixels, so a sample within one multiple of a pixel's edge could
    belong to either side. All numbers are int32, because twice as many of them fit into a register.
    """
    if max(width, height) > MAX_FAST_PIXELS:
        return False
    one, fraction, stride = np.int32(1), np.int32((1 << FRACTION_BITS) - 1), np.int32(width)
    right, top = np.int32(width << FRACTION_BITS), np.int32(height << FRACTION_BITS)
    middle_x, middle_y = 0.5 * right, 0.5 * top
    scale_x, scale_y = middle_x / half_x, middle_y / half_y
    nearest = np.int32(2)
    for i in range(values.size):
        column = np.int32(max(min(x[i] * scale_x + middle_x, right + 2.0), -2.0))
        row = np.int32(max(min(y[i] * scale_y + middle_y, top + 2.0), -2.0))
        nearest = min(nearest, np.int32(np.int32(column + one) & fraction), np.int32(np.int32(row + one) & fraction))
        inside = (column >= 0) & (column < right) & (row >= 0) & (row < top) & (values[i] == values[i])
        pixel = np.int32(np.int32(np.int32(row >> FRACTION_BITS) * stride) + np.int32(column >> FRACTION_BITS))
        index[i] = pixel if inside else np.int32(OUTSIDE_INDEX)
    return nearest >= 2


@numba.njit(cache=True)
def _find_pixels_exact(x, y, values, half_x, half_y, width, height, index):  # type: ignore[no-untyped-def]
    """Flat pixel indices of a block; OUTSIDE_INDEX outside the field and for NaN."""
    for i in range(values.size):
        column, row = pixel_of(x[i], half_x, width), pixel_of(y[i], half_y, height)
        inside = column >= 0 and row >= 0 and values[i] == values[i]
        index[i] = row * width + column if inside else OUTSIDE_INDEX


@numba.njit(cache=True, error_model="numpy")
def find_pixels(x, y, values, half_x, half_y, width, height, index):  # type: ignore[no-untyped-def]
    """Write the flat pixel indices of a block into ``index``; OUTSIDE_INDEX outside the field and for NaN."""
    if not _find_pixels_fast(x, y, values, half_x, half_y, width, height, index):
        _find_pixels_exact(x, y, values, half_x, half_y, width, height, index)


@numba.njit(cache=True, error_model="numpy")
def add_to_pixels(index, values, sums, counts, cells):  # type: ignore[no-untyped-def]
    """Add the values of a block to its pixels: to shared cells if there are any, else to sums and counts."""
    if cells.size:
        _add_shared(index, values, cells)
    else:
        _add(index, values, sums.reshape(-1), counts.reshape(-1))


@numba.njit(cache=True, error_model="numpy")
def _add(index, values, sums, counts):  # type: ignore[no-untyped-def]
    for i in range(values.size):  # a loop without the search for indices, which so can use SIMD
        if index[i] < OUTSIDE_INDEX:
            pixel = np.uint32(index[i])
            counts[pixel] += np.uint32(1)
            sums[pixel] += values[i]


@numba.njit(cache=True, error_model="numpy")
def _add_shared(index, values, cells):  # type: ignore[no-untyped-def]
    """Add value and count in one operation on one place in memory."""
    for i in range(values.size):
        if index[i] < OUTSIDE_INDEX:
            cells[np.uint32(index[i])] += (np.int64(values[i]) << np.int64(COUNT_BITS)) + np.int64(1)


@numba.njit(cache=True)
def _empty_shared_cells(cells, sums, counts):  # type: ignore[no-untyped-def]
    """Move the content of shared cells to sums and counts."""
    for i in range(cells.size):
        sums[i] += cells[i] >> np.int64(COUNT_BITS)
        counts[i] += np.uint32(cells[i] & np.int64((1 << COUNT_BITS) - 1))
        cells[i] = 0


def accumulate_in_parts(
    kernel: Callable[[slice, NDArray[np.int64]], object],
    intensity: NDArray[Any],
    sums: NDArray[np.float64],
    counts: NDArray[np.uint32],
) -> None:
    """Run a kernel over parts of the samples and move what it left in shared cells to sums and counts after each part.

    Args:
        kernel: adds a part of the samples to sums and counts, or to shared cells if there are any.
        intensity: shape (n,). Many small integers use shared cells, because memory access is half of the cost.
        sums, counts: shape (height, width); changed in place.
    """
    shared = intensity.dtype.str[1:] in SHARED_CELL_TYPES and intensity.size >= counts.size
    cells = np.zeros(counts.size if shared else 0, np.int64)
    for first in range(0, intensity.size, MAX_SHARED_SAMPLES):
        kernel(slice(first, first + MAX_SHARED_SAMPLES), cells)
        _empty_shared_cells(cells, sums.reshape(-1), counts.reshape(-1))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _accumulate(theta_x, theta_y, intensity, half_x, half_y, sums, counts, cells):  # type: ignore[no-untyped-def]
    height, width = counts.shape
    index = np.empty(BLOCK_SAMPLES, np.int32)
    for at in range(0, theta_x.size, BLOCK_SAMPLES):
        x, y, values = (
            theta_x[at : at + BLOCK_SAMPLES],
            theta_y[at : at + BLOCK_SAMPLES],
            intensity[at : at + BLOCK_SAMPLES],
        )
        find_pixels(x, y, values, half_x, half_y, width, height, index)
        add_to_pixels(index, values, sums, counts, cells)


@numba.njit(cache=True, nogil=True)
def _accumulate_detectors(theta_x, theta_y, intensity, half_x, half_y, sums, counts):  # type: ignore[no-untyped-def]
    height, width = counts.shape
    for i in range(theta_x.size):
        column = pixel_of(theta_x[i], half_x, width)
        row = pixel_of(theta_y[i], half_y, height)
        if column < 0 or row < 0:
            continue
        complete = True
        for d in range(intensity.shape[1]):
            complete = complete and not np.isnan(intensity[i, d])
        if complete:
            counts[row, column] += 1
            for d in range(intensity.shape[1]):
                sums[row, column, d] += intensity[i, d]


def _to_native(values: NDArray[Any]) -> NDArray[Any]:
    """Return real numbers in the machine's byte order, floats of 4 or 8 bytes, as compiled loops need them; the same
    array if it has them."""
    dtype = values.dtype
    if dtype.kind == "f":
        dtype = np.dtype(np.float32 if dtype.itemsize <= 4 else np.float64)
    return values.astype(dtype.newbyteorder("="), copy=False)


def accumulate_samples(
    theta_x: NDArray[Any],
    theta_y: NDArray[Any],
    intensity: NDArray[Any],
    grid: Grid,
    sums: NDArray[np.float64] | None = None,
    counts: NDArray[np.uint32] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    """Add samples to the sums and counts of their pixels, in one pass and without temporaries.

    For a long recording, call it once a chunk with the sums and counts that the previous call returned. A sample
    outside the field, or masked or NaN in an angle or in any detector, is left out.

    Args:
        theta_x, theta_y: mechanical angles, shape (n,) [rad].
        intensity: shape (n,) or (n, detectors).
        grid: the pixels.
        sums: shape (height, width) or (height, width, detectors); changed in place. New when None.
        counts: shape (height, width); changed in place. New when None.

    Returns:
        ``sums``, float64, and ``counts``, uint32.

    Raises:
        BadInput: the shapes do not match, values are not real numbers, or ``grid`` is no Grid.
    """
    check_type(Grid, "give a lissajous.Grid", grid=grid)
    theta_x, theta_y, intensity = (
        np.ma.filled(np.ma.array(values, float), np.nan) if np.ma.is_masked(values) else np.asarray(values)
        for values in (theta_x, theta_y, intensity)
    )
    for name, values in (("theta_x", theta_x), ("theta_y", theta_y), ("intensity", intensity)):
        if values.dtype.kind not in "biuf":
            raise BadInput(f"holds {values.dtype}, not real numbers", channel=name, hint="give integers or floats")
    theta_x, theta_y, intensity = _to_native(theta_x), _to_native(theta_y), _to_native(intensity)
    one_clock = theta_x.ndim == 1 and theta_x.shape == theta_y.shape == intensity.shape[:1]
    if not one_clock or intensity.ndim > 2:
        raise BadInput(
            f"angles of shape {theta_x.shape} and {theta_y.shape} with an intensity of shape {intensity.shape}",
            hint="give one angle of each axis for each intensity",
        )
    shape = (grid.height, grid.width, *intensity.shape[1:])
    sums = np.zeros(shape) if sums is None else sums
    counts = np.zeros(shape[:2], np.uint32) if counts is None else counts
    if sums.shape != shape or counts.shape != shape[:2]:
        raise BadInput(f"sums of shape {sums.shape} and counts of {counts.shape} where {shape} is needed")
    field = grid.half_angle_x, grid.half_angle_y, sums, counts
    if intensity.ndim == 2:
        _accumulate_detectors(theta_x, theta_y, intensity, *field)
    else:

        def kernel(i: slice, cells: NDArray[np.int64]) -> None:
            _accumulate(theta_x[i], theta_y[i], intensity[i], *field, cells)

        accumulate_in_parts(kernel, intensity, sums, counts)
    return sums, counts


def mean_picture(sums: NDArray[np.float64], counts: NDArray[np.uint32], grid: Grid) -> Picture:
    """Return the picture of accumulated sums and counts: sums over counts, NaN where the count is 0."""
    divisor = counts if sums.ndim == 2 else counts[..., None]
    image = np.full(sums.shape, np.nan, np.float32)
    np.divide(sums, divisor, out=image, where=divisor > 0, casting="same_kind")
    return Picture(image, counts, grid)


def map_samples(theta_x: NDArray[Any], theta_y: NDArray[Any], intensity: NDArray[Any], grid: Grid) -> Picture:
    """Return the picture of samples in memory.

    Args and Raises as in :func:`accumulate_samples`.
    """
    return mean_picture(*accumulate_samples(theta_x, theta_y, intensity, grid), grid)
