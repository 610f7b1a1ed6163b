"""From slow phase and amplitude straight to the picture: no angle is stored and no sine taken for a sample.

Each segment's angles come from turning phasors (``estimation.tracker.angle``), are turned into pixels side by side, and
only the adding up is done one at a time. Counts equal those of ``mapping.accumulate`` on the same angles to the sample.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from estimation.tracker.angle import FINE, SEGMENT, SlowAngle, segment_angles
from recon.mapping import Grid, add_block
from scanner.errors import BadInput


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _accumulate(x, y, intensity, half_x, half_y, sums, counts):  # type: ignore[no-untyped-def]
    theta_x, theta_y, re, im = np.empty(SEGMENT), np.empty(SEGMENT), np.empty(FINE), np.empty(FINE)
    index = np.empty(SEGMENT, np.int32)
    for s in range(x[0].size):
        segment_angles(x[0][s], x[1][s], x[2][s], x[3][s], re, im, theta_x)
        segment_angles(y[0][s], y[1][s], y[2][s], y[3][s], re, im, theta_y)
        values = intensity[s * SEGMENT : (s + 1) * SEGMENT]
        add_block(theta_x, theta_y, values, half_x, half_y, index, sums, counts)


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
