"""Coverage of a scan: fill factor over time, time after which a given fill factor is reached, and the largest gap."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from recon.imaging.gridding import pixel_index, pixel_of
from recon.imaging.picture import Grid
from scanner.arrays import Array
from scanner.errors import BadInput


@numba.njit(cache=True, nogil=True)
def _first_visits(theta_x, theta_y, half_x, half_y, width, height):  # type: ignore[no-untyped-def]
    visited = np.zeros((height, width), np.bool_)
    first = np.empty(width * height, np.int64)
    n = 0
    for i in range(theta_x.size):
        column = pixel_of(theta_x[i], half_x, width)
        row = pixel_of(theta_y[i], half_y, height)
        if column >= 0 and row >= 0 and not visited[row, column]:
            visited[row, column] = True
            first[n] = i
            n += 1
    return first[:n]


def fill_against_time(
    theta_x: NDArray[Any], theta_y: NDArray[Any], rate: float, grid: Grid
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the fill factor over time, with one entry for the first visit of each pixel.

    Args:
        theta_x, theta_y: mechanical angles, shape (n,) [rad].
        rate: samples a second [Hz].
        grid: the pixels.

    Returns:
        Time from the start of the scan to the end of the sample that visits the pixel [s], and the fraction of pixels
        visited by then; both of shape (visited pixels,) and increasing.

    Raises:
        BadInput: angles of different shapes, or a sample rate that is not positive.
    """
    theta_x, theta_y = np.asarray(theta_x), np.asarray(theta_y)
    if theta_x.ndim != 1 or theta_x.shape != theta_y.shape:
        raise BadInput(f"angles of shape {theta_x.shape} and {theta_y.shape}", hint="give both axes on one clock")
    if not rate > 0:
        raise BadInput(f"a sample rate of {rate} Hz")
    first = _first_visits(theta_x, theta_y, grid.half_angle_x, grid.half_angle_y, grid.width, grid.height)
    return (first + 1) / rate, np.arange(1, first.size + 1) / (grid.width * grid.height)


def time_for_fill(theta_x: NDArray[Any], theta_y: NDArray[Any], rate: float, grid: Grid, fill: float) -> float | None:
    """Return the time [s] after which the scan has visited the fraction ``fill`` of the pixels; None if it never does.

    Args are those of :func:`fill_against_time`, and ``fill`` in (0, 1].

    Raises:
        BadInput: a fill outside (0, 1].
    """
    if not 0 < fill <= 1:
        raise BadInput(f"a fill of {fill}", hint="give a fraction above 0 and at most 1")
    time, reached = fill_against_time(theta_x, theta_y, rate, grid)
    k = int(np.searchsorted(reached, fill))
    return float(time[k]) if k < time.size else None


def largest_gap(visited: NDArray[np.bool_]) -> float:
    """Return the diameter of the largest disc around a pixel without a visited pixel's centre, less one pixel [px].

    It is 0 where all pixels are visited, 1 for single holes, and infinite where none is.

    Args:
        visited: shape (height, width).
    """
    from scipy.ndimage import distance_transform_edt

    if not visited.any():
        return math.inf
    return max(0.0, 2.0 * float(distance_transform_edt(~visited).max()) - 1.0)


def gap_against_time(theta_x: Array, theta_y: Array, rate: float, grid: Grid, times: Sequence[float] | Array) -> Array:
    """Return ``largest_gap`` [px] at increasing times, shape (times,).

    Args:
        theta_x, theta_y: angles, shape (n,) [rad].
        rate: sample rate of the angles [Hz].
        grid: the pixels.
        times: since the first sample, shape (times,) [s].
    """
    row = pixel_index(theta_y, grid.half_angle_y, grid.height)
    column = pixel_index(theta_x, grid.half_angle_x, grid.width)
    inside = (row >= 0) & (column >= 0)
    visited = np.zeros((grid.height, grid.width), bool)
    gaps, done = [], 0
    for time in times:
        new = slice(done, done := round(time * rate))
        visited[row[new][inside[new]], column[new][inside[new]]] = True
        gaps.append(largest_gap(visited))
    return np.array(gaps)
