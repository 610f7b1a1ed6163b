"""How the scan fills the picture, and how long a wanted fill takes."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from recon.mapping import Grid, pixel_of
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
    """Fill factor as the scan goes on: one entry for every pixel that is visited, at its first visit.

    Args:
        theta_x, theta_y: mechanical angles, shape (n,) [rad].
        rate: samples a second [Hz].
        grid: the pixels.

    Returns:
        Time from the start of the scan to the end of the sample that visited the pixel [s], and the fraction of pixels
        visited by then; both of shape (visited pixels,) and increasing.
    """
    theta_x, theta_y = np.asarray(theta_x), np.asarray(theta_y)
    if theta_x.ndim != 1 or theta_x.shape != theta_y.shape:
        raise BadInput(f"angles of shape {theta_x.shape} and {theta_y.shape}", hint="give both axes on one clock")
    if not rate > 0:
        raise BadInput(f"a sample rate of {rate} Hz")
    first = _first_visits(theta_x, theta_y, grid.half_angle_x, grid.half_angle_y, grid.width, grid.height)
    return (first + 1) / rate, np.arange(1, first.size + 1) / (grid.width * grid.height)


def time_for_fill(theta_x: NDArray[Any], theta_y: NDArray[Any], rate: float, grid: Grid, fill: float) -> float | None:
    """Frame time after which the scan has visited the fraction ``fill`` of the pixels [s]; None if it never does.

    Args are those of `fill_against_time`, and ``fill`` in (0, 1].
    """
    if not 0 < fill <= 1:
        raise BadInput(f"a fill of {fill}", hint="give a fraction above 0 and at most 1")
    time, reached = fill_against_time(theta_x, theta_y, rate, grid)
    k = int(np.searchsorted(reached, fill))
    return float(time[k]) if k < time.size else None
