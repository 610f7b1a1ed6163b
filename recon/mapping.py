"""From angles and intensities to a picture: mean and count of the samples in each pixel.

The pixel law is eq (2) of Chen et al. (2020) with its edges decided: pixel k holds k < N/2 (θ/half_angle + 1) <= k + 1,
the field's lower edge belongs to pixel 0, and what lies outside the field is dropped.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from scanner.errors import BadInput

BLOCK = 256  # samples whose pixels are found before they are added up
BITS = 18  # of a position's fraction, in an int32
WIDEST = 1 << 12  # pixels across whose positions do fit
OUTSIDE = 1 << 29  # beyond every index, an int32 still
SMALL = ("i1", "u1", "i2", "u2")  # types of which sum and count share a cell of eight bytes
COUNTED = 24  # bits of a cell for the count, the rest for the sum
MOST = 1 << (COUNTED - 1)  # samples that no cell overflows with


@dataclass(frozen=True)
class Grid:
    """Pixels over the field of view; column 0 is θ_x = -half_angle_x, row 0 is θ_y = -half_angle_y.

    Attributes:
        width, height: pixels.
        half_angle_x, half_angle_y: the field's edge, mechanical angle [rad].
        metres_per_radian: by which the beam moves over the sample [m/rad]; None where it is not known.

    Raises:
        BadInput: a size or an angle that is not positive and finite, or more pixels than an index counts.
    """

    width: int
    height: int
    half_angle_x: float
    half_angle_y: float
    metres_per_radian: float | None = None

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise BadInput(f"a picture of {self.width}x{self.height} pixels", hint="give at least 1x1")
        if self.width * self.height >= OUTSIDE:
            raise BadInput(f"a picture of {self.width}x{self.height} pixels", hint=f"give fewer than {OUTSIDE}")
        if not all(math.isfinite(half) and half > 0 for half in (self.half_angle_x, self.half_angle_y)):
            raise BadInput(
                f"half angles of {self.half_angle_x} and {self.half_angle_y} rad", hint="give positive, finite angles"
            )

    @property
    def pixel_angle(self) -> tuple[float, float]:
        """Width and height of a pixel, mechanical angle [rad]."""
        return 2 * self.half_angle_x / self.width, 2 * self.half_angle_y / self.height


@dataclass(frozen=True)
class Picture:
    """A picture and how often each of its pixels was visited.

    Attributes:
        image: mean intensity, shape (height, width) or (height, width, detectors), float32; NaN where never visited.
        coverage: samples a pixel, shape (height, width), uint32.
        grid: the pixels' place in the field.
    """

    image: NDArray[np.float32]
    coverage: NDArray[np.uint32]
    grid: Grid


@numba.njit(cache=True, inline="always")
def pixel_of(angle: float, half_angle: float, n: int) -> int:
    """`pixel_index` of one angle, for use in compiled loops."""
    position = angle / half_angle
    if not abs(position) <= 1.0:  # outside the field, and NaN, which no comparison holds for
        return -1
    return max(math.ceil(0.5 * n * (position + 1.0)) - 1, 0)


@numba.vectorize(cache=True)
def _pixels(angle: float, half_angle: float, n: int) -> int:
    return pixel_of(angle, half_angle, n)


def pixel_index(angle: NDArray[Any] | float, half_angle: float, n: int) -> NDArray[np.int64]:
    """Column (or row) that an angle falls in: ceil(n/2 (θ/half_angle + 1)) - 1, of [-half_angle, half_angle].

    Args:
        angle: any shape [rad].
        half_angle: the field's edge [rad].
        n: pixels across.

    Returns:
        Index, shape of ``angle``; -1 outside the field and for NaN.
    """
    return _pixels(angle, half_angle, n)


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def _found(x, y, values, half_x, half_y, width, height, index):  # type: ignore[no-untyped-def]
    """`_indices` without a branch or a division, for SIMD: False where it cannot tell.

    Positions are whole numbers of 2^-BITS pixels; what lies next to an edge could belong to either side. Every number
    stays an int32: twice as many fit a register.
    """
    if max(width, height) > WIDEST:
        return False
    one, fraction, stride = np.int32(1), np.int32((1 << BITS) - 1), np.int32(width)
    right, top = np.int32(width << BITS), np.int32(height << BITS)
    middle_x, middle_y = 0.5 * right, 0.5 * top
    scale_x, scale_y = middle_x / half_x, middle_y / half_y
    nearest = np.int32(2)
    for i in range(values.size):
        column = np.int32(max(min(x[i] * scale_x + middle_x, right + 2.0), -2.0))
        row = np.int32(max(min(y[i] * scale_y + middle_y, top + 2.0), -2.0))
        nearest = min(nearest, np.int32(np.int32(column + one) & fraction), np.int32(np.int32(row + one) & fraction))
        inside = (column >= 0) & (column < right) & (row >= 0) & (row < top) & (values[i] == values[i])
        pixel = np.int32(np.int32(np.int32(row >> BITS) * stride) + np.int32(column >> BITS))
        index[i] = pixel if inside else np.int32(OUTSIDE)
    return nearest >= 2


@numba.njit(cache=True)
def _indices(x, y, values, half_x, half_y, width, height, index):  # type: ignore[no-untyped-def]
    """Flat indices of the pixels of a block, OUTSIDE outside the field and where there is no value."""
    for i in range(values.size):
        column, row = pixel_of(x[i], half_x, width), pixel_of(y[i], half_y, height)
        inside = column >= 0 and row >= 0 and values[i] == values[i]
        index[i] = row * width + column if inside else OUTSIDE


@numba.njit(cache=True, error_model="numpy")
def find_block(x, y, values, half_x, half_y, width, height, index):  # type: ignore[no-untyped-def]
    """Flat indices of a block's pixels into ``index``, int32; OUTSIDE outside the field and where there is no value."""
    if not _found(x, y, values, half_x, half_y, width, height, index):
        _indices(x, y, values, half_x, half_y, width, height, index)


@numba.njit(cache=True, error_model="numpy")
def add_block(index, values, sums, counts, cells):  # type: ignore[no-untyped-def]
    """Add a block's values to the pixels that were found: to ``cells``, unless there are none, of ``shared_cells``."""
    if cells.size:
        _add_shared(index, values, cells)
    else:
        _add(index, values, sums.reshape(-1), counts.reshape(-1))


@numba.njit(cache=True, error_model="numpy")
def _add(index, values, sums, counts):  # type: ignore[no-untyped-def]
    for i in range(values.size):  # apart from the indices, so that those are found side by side
        if index[i] < OUTSIDE:
            pixel = np.uint32(index[i])
            counts[pixel] += np.uint32(1)
            sums[pixel] += values[i]


@numba.njit(cache=True, error_model="numpy")
def _add_shared(index, values, cells):  # type: ignore[no-untyped-def]
    """One addition, and one place in memory, for sum and count."""
    for i in range(values.size):
        if index[i] < OUTSIDE:
            cells[np.uint32(index[i])] += (np.int64(values[i]) << np.int64(COUNTED)) + np.int64(1)


@numba.njit(cache=True)
def _emptied(cells, sums, counts):  # type: ignore[no-untyped-def]
    """Move what cells hold to sums and counts."""
    for i in range(cells.size):
        sums[i] += cells[i] >> np.int64(COUNTED)
        counts[i] += np.uint32(cells[i] & np.int64((1 << COUNTED) - 1))
        cells[i] = 0


def added(
    kernel: Callable[[slice, NDArray[np.int64]], object],
    intensity: NDArray[Any],
    sums: NDArray[np.float64],
    counts: NDArray[np.uint32],
) -> None:
    """Have a kernel add samples, in parts after which what it left in cells for ``add_block`` moves to sums and counts.

    Args:
        kernel: adds a part of the samples to sums and counts, or to cells if there are any.
        intensity: shape (n,). Small integers, if they are many, share cells: half of an addition is to fetch its place.
    """
    shared = intensity.dtype.str[1:] in SMALL and intensity.size >= counts.size
    cells = np.zeros(counts.size if shared else 0, np.int64)
    for first in range(0, intensity.size, MOST):
        kernel(slice(first, first + MOST), cells)
        _emptied(cells, sums.reshape(-1), counts.reshape(-1))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _accumulate(theta_x, theta_y, intensity, half_x, half_y, sums, counts, cells):  # type: ignore[no-untyped-def]
    height, width = counts.shape
    index = np.empty(BLOCK, np.int32)
    for at in range(0, theta_x.size, BLOCK):
        x, y, values = theta_x[at : at + BLOCK], theta_y[at : at + BLOCK], intensity[at : at + BLOCK]
        find_block(x, y, values, half_x, half_y, width, height, index)
        add_block(index, values, sums, counts, cells)


@numba.njit(cache=True, nogil=True)
def _accumulate_detectors(theta_x, theta_y, intensity, half_x, half_y, sums, counts):  # type: ignore[no-untyped-def]
    height, width = counts.shape
    for i in range(theta_x.size):
        column = pixel_of(theta_x[i], half_x, width)
        row = pixel_of(theta_y[i], half_y, height)
        if column < 0 or row < 0:
            continue
        whole = True
        for d in range(intensity.shape[1]):
            whole = whole and not np.isnan(intensity[i, d])
        if whole:
            counts[row, column] += 1
            for d in range(intensity.shape[1]):
                sums[row, column, d] += intensity[i, d]


def accumulate(
    theta_x: NDArray[Any],
    theta_y: NDArray[Any],
    intensity: NDArray[Any],
    grid: Grid,
    sums: NDArray[np.float64] | None = None,
    counts: NDArray[np.uint32] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    """Add samples to the sums and counts of their pixels, in one pass and without temporaries.

    A long recording goes through in chunks: give each call the sums and counts that the last one returned. A sample
    outside the field, or with NaN in an angle or in any detector, is left out.

    Args:
        theta_x, theta_y: mechanical angles, shape (n,) [rad].
        intensity: shape (n,) or (n, detectors).
        grid: the pixels.
        sums: shape (height, width) or (height, width, detectors); changed in place. New when None.
        counts: shape (height, width); changed in place. New when None.

    Returns:
        ``sums``, float64, and ``counts``, uint32.

    Raises:
        BadInput: shapes that do not belong together.
    """
    theta_x, theta_y, intensity = np.asarray(theta_x), np.asarray(theta_y), np.asarray(intensity)
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

        added(kernel, intensity, sums, counts)
    return sums, counts


def mean_picture(sums: NDArray[np.float64], counts: NDArray[np.uint32], grid: Grid) -> Picture:
    """The picture of what `accumulate` gathered: sums over counts, NaN where nothing fell."""
    divisor = counts if sums.ndim == 2 else counts[..., None]
    image = np.full(sums.shape, np.nan, np.float32)
    np.divide(sums, divisor, out=image, where=divisor > 0, casting="same_kind")
    return Picture(image, counts, grid)


def map_samples(theta_x: NDArray[Any], theta_y: NDArray[Any], intensity: NDArray[Any], grid: Grid) -> Picture:
    """The picture of samples that are all in memory: `accumulate`, then `mean_picture`."""
    return mean_picture(*accumulate(theta_x, theta_y, intensity, grid), grid)


def fill_factor(coverage: NDArray[Any]) -> float:
    """Fraction of the pixels that were visited at least once."""
    return float(np.count_nonzero(coverage)) / coverage.size


def fill_holes(picture: Picture, radius: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Fill the small holes of a picture from their visited neighbours, by normalised convolution.

    A hole's value is the mean of the visited pixels at most ``radius`` columns and rows away, weighted by a Gaussian of
    sd radius/2 and by how often each was visited (Knutsson & Westin 1993, with coverage as certainty). Visited pixels
    stay as measured; holes with no visited pixel in reach stay NaN.

    Args:
        picture: with NaN where never visited.
        radius: reach [px], >= 1.

    Returns:
        The filled image, shape of ``picture.image``, and the mask of the pixels that are fill and not measurement,
        shape (height, width).
    """
    from scipy.ndimage import gaussian_filter

    if radius < 1:
        raise BadInput(f"a fill radius of {radius} pixels", hint="give at least 1")
    certainty = picture.coverage.astype(float)
    values = picture.image.reshape(*certainty.shape, -1)
    visited = certainty > 0

    def spread(field: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(gaussian_filter(field, radius / 2, radius=radius, axes=(0, 1), mode="constant"))

    weight = spread(certainty)
    filled = ~visited & (weight > 0)
    total = spread(np.where(visited[..., None], values, 0.0) * certainty[..., None])
    image = values.copy()
    image[filled] = total[filled] / weight[filled][:, None]
    return image.reshape(picture.image.shape), filled
