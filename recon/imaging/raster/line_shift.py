"""Correction of a raster frame's line phase: counts are moved once, to where they were detected."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from recon.imaging.raster.line_phase import lag_at
from scanner.arrays import Array

MIN_COVERED_FRACTION = 0.5
"""Part of a pixel that has to be covered by the recorded line for its mean; below it the pixel has no data."""


def correct_frame(frame: NDArray[Any], shift: float, fill_squared: float, means: bool = False) -> tuple[Array, float]:
    """Move forward and backward lines by half the shift each, so that both show one place in one pixel.

    The counts of a line are a distribution over its length. Its integral is interpolated by monotone cubic polynomials
    (Fritsch and Carlson 1980), and a pixel of the result holds the difference of the integral at its two borders: no
    count is lost or invented between the borders of the frame, and none becomes negative.

    Args:
        frame: shape (rows, columns).
        shift: distance of the directions' lines at the middle [px].
        fill_squared: see :mod:`recon.imaging.raster.line_phase`.
        means: the pixels hold means over their time instead of counts. The result then is the mean over the new
            pixel, without the change of a pixel's width.

    Returns:
        The frame, shape (rows, columns), float64, and what lay beyond its border. Pixels without data are 0, and nan in
        a frame of means.
    """
    columns = frame.shape[1]
    edges = np.arange(columns + 1.0)
    half = 0.5 * shift * lag_at(2.0 * edges / columns - 1.0, fill_squared)
    corrected = np.empty(frame.shape)
    for first, sign in ((0, -1.0), (1, 1.0)):
        wanted = edges + sign * half
        recorded = np.clip(wanted, 0.0, columns)
        counts = np.empty(frame[first::2].shape)
        _count_between(np.ascontiguousarray(frame[first::2], np.float64), recorded, counts)
        if means:
            width = np.diff(recorded)
            usable = width > MIN_COVERED_FRACTION * np.diff(wanted)
            counts = np.where(usable, counts / np.where(usable, width, 1.0), np.nan)
        corrected[first::2] = counts
    return corrected, 0.0 if means else float(frame.sum(dtype=np.float64) - corrected.sum())


def to_dtype(corrected: Array, dtype: np.dtype[Any], means: bool = False) -> tuple[NDArray[Any], int]:
    """The frame in the film's type, and how many pixels did not fit into it.

    Counts are rounded so that the sum from the beginning of a line to any pixel is right to half a count, which keeps
    the total. Means are rounded each; pixels without data become 0.
    """
    if dtype.kind == "f":
        return corrected.astype(dtype), 0
    if means:
        rounded = np.round(np.nan_to_num(corrected))
    else:
        rounded = np.diff(np.round(np.cumsum(corrected, axis=1)), axis=1, prepend=0.0)
    limits = np.iinfo(dtype)
    beyond = int(np.count_nonzero((rounded < limits.min) | (rounded > limits.max)))
    return np.clip(rounded, limits.min, limits.max).astype(dtype), beyond


@numba.njit(cache=True, nogil=True)
def _count_between(lines, places, counts):  # type: ignore[no-untyped-def]
    """Counts of each line between successive places, counted in pixels from its beginning."""
    columns = lines.shape[1]
    for i in range(lines.shape[0]):
        line = lines[i]
        whole, index = 0.0, 0  # the integral up to the beginning of pixel ``index``
        before = 0.0
        for k in range(places.size):
            while index < columns - 1 and places[k] >= index + 1.0:
                whole += line[index]
                index += 1
            t = places[k] - index
            value = line[index]
            left = _slope(line[index - 1], value) if index > 0 else value
            right = _slope(value, line[index + 1]) if index < columns - 1 else value
            total = whole + t * (left + t * (3.0 * value - 2.0 * left - right + t * (left + right - 2.0 * value)))
            if k > 0:
                counts[i, k - 1] = total - before
            before = total


@numba.njit(cache=True, inline="always")
def _slope(a, b):  # type: ignore[no-untyped-def]
    """Slope of the integral between two pixels: their harmonic mean, 0 where their signs differ."""
    return 2.0 * a * b / (a + b) if a * b > 0.0 else 0.0
