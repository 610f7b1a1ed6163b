"""From slow phase and amplitude straight to the picture: no angle is stored and no sine taken for a sample.

Each segment's angles come from turning phasors (``estimation.tracker.angle``), are turned into pixels side by side, and
only the adding up is done one at a time. Counts equal those of ``mapping.accumulate`` on the same angles to the sample.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from estimation.tracker.angle import FINE, SEGMENT, SlowAngle, segment_angles
from recon.mapping import Grid
from scanner.errors import BadInput

OUTSIDE = 1 << 29  # beyond every index, and twice it is an int32 still


@numba.njit(cache=True, error_model="numpy", inline="always")
def _pixels(angles, half_angle, n, stride, out):  # type: ignore[no-untyped-def]
    """``stride`` times the pixels of one segment: ``mapping.pixel_of`` without a branch, OUTSIDE outside the field."""
    for i in range(SEGMENT):
        position = angles[i] / half_angle
        pixel = max(math.ceil(0.5 * n * (position + 1.0)) - 1.0, 0.0)
        out[i] = np.int32(pixel * stride) if abs(position) <= 1.0 else np.int32(OUTSIDE)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _accumulate(x, y, intensity, half_x, half_y, sums, counts):  # type: ignore[no-untyped-def]
    height, width = counts.shape
    angles, re, im = np.empty(SEGMENT), np.empty(FINE), np.empty(FINE)
    columns, index = np.empty(SEGMENT, np.int32), np.empty(SEGMENT, np.int32)
    flat_sums, flat_counts = sums.reshape(-1), counts.reshape(-1)
    for s in range(x[0].size):
        segment_angles(x[0][s], x[1][s], x[2][s], x[3][s], re, im, angles)
        _pixels(angles, half_x, width, 1.0, columns)
        segment_angles(y[0][s], y[1][s], y[2][s], y[3][s], re, im, angles)
        _pixels(angles, half_y, height, float(width), index)
        values = intensity[s * SEGMENT : (s + 1) * SEGMENT]
        for i in range(values.size):  # apart from the adding up, so that it is done side by side
            index[i] = index[i] + columns[i] if values[i] == values[i] else OUTSIDE
        for i in range(values.size):
            if index[i] < OUTSIDE:
                pixel = np.uint32(index[i])
                flat_counts[pixel] += np.uint32(1)
                flat_sums[pixel] += values[i]


def accumulate_slow(
    x: SlowAngle,
    y: SlowAngle,
    first: int,
    intensity: NDArray[Any],
    grid: Grid,
    sums: NDArray[np.float64] | None = None,
    counts: NDArray[np.uint32] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    """Add samples ``first`` on to the sums and counts of their pixels; otherwise as ``mapping.accumulate``.

    Args:
        x, y: angles on the intensity's clock.
        intensity: shape (n,); NaN is left out.

    Raises:
        BadInput: an intensity that is not one-dimensional, or goes on beyond the angles.
    """
    intensity = np.asarray(intensity)
    size = min(x.size, y.size)
    if intensity.ndim != 1 or first + intensity.size > size:
        raise BadInput(
            f"an intensity of shape {intensity.shape} from sample {first} on, for angles of {size} samples",
            hint="give one intensity for each angle",
        )
    sums = np.zeros((grid.height, grid.width)) if sums is None else sums
    counts = np.zeros((grid.height, grid.width), np.uint32) if counts is None else counts
    if intensity.size:
        part = first, first + intensity.size
        a, b = ((s.first, s.turn, s.lines, s.line_steps) for s in (x.segments(*part), y.segments(*part)))
        _accumulate(a, b, intensity, grid.half_angle_x, grid.half_angle_y, sums, counts)
    return sums, counts
