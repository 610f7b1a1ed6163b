"""Changes of the amplitude during a scan, from the self-crossings of the picture; its scale is not determined.

A sample whose true position is (1 + ε) u, but which was mapped to u, differs from the picture f by ε u · ∇f. In each
part of the scan the ε of both axes is solved for by least squares against the picture of all parts. A common ε of all
parts magnifies the picture and cannot be seen: the mean over the parts is zero.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.imaging.picture import Grid
from recon.imaging.scan_phase.bidirectional_equations import SMOOTHING_SD_CELLS
from recon.imaging.scan_phase.registration_cells import MIN_SAMPLES_PER_CELL
from scanner.arrays import Array

MIN_PART_SAMPLES = 1000
"""Samples below which a part determines no change of the amplitude."""


class AmplitudeChanges(NamedTuple):
    """Relative changes of the amplitudes of x and y in parts of a scan, shape (parts, 2); sd inf where undetermined."""

    value: Array
    sd: Array


def measure_amplitude_changes(
    theta_x: Array, theta_y: Array, intensity: Array, part: NDArray[np.integer[Any]], parts: int, grid: Grid
) -> AmplitudeChanges:
    """Relative changes of the true amplitudes against those that the samples were mapped with.

    Args:
        theta_x, theta_y: angles that the samples were mapped with, shape (n,) [rad].
        intensity: shape (n,), finite.
        part: number of the part that a sample belongs to, shape (n,).
        parts: number of parts.
        grid: the pixels.
    """
    import cv2

    cell = max(1.0, math.sqrt(MIN_SAMPLES_PER_CELL * grid.width * grid.height / theta_x.size))
    width, height = math.ceil(grid.width / cell) + 1, math.ceil(grid.height / cell) + 1
    x, y = ((theta / half + 1.0) / 2 * (size - 1) for theta, half, size in (
        (theta_x, grid.half_angle_x, width), (theta_y, grid.half_angle_y, height)))  # fmt: skip
    inside = (x >= 0) & (x < width - 1) & (y >= 0) & (y < height - 1)
    x, y, intensity, part = x[inside], y[inside], intensity[inside], part[inside]
    place = np.round(y).astype(np.int64) * width + np.round(x).astype(np.int64)
    sums = [np.bincount(place, weights, width * height) for weights in (None, intensity, x, y)]
    fields = np.stack(sums, axis=-1).astype(float).reshape(height, width, 4)
    size = 2 * math.ceil(3 * SMOOTHING_SD_CELLS) + 1
    cv2.GaussianBlur(fields, (size, size), SMOOTHING_SD_CELLS, dst=fields, borderType=cv2.BORDER_CONSTANT)
    means = fields[..., 1:] / np.maximum(fields[..., :1], 1e-9)
    slope_y, slope_x = (slope.ravel()[place] for slope in np.gradient(means[..., 0]))
    picture, mean_x, mean_y = means.reshape(-1, 3)[place].T
    residual = intensity - picture - slope_x * (x - mean_x) - slope_y * (y - mean_y)
    z = np.stack([slope_x * (x - (width - 1) / 2), slope_y * (y - (height - 1) / 2)])
    score = np.stack([np.bincount(part, each * residual, parts) for each in z], axis=-1)
    products = [np.bincount(part, z[a] * z[b], parts) for a in range(2) for b in range(2)]
    information = np.stack(products, axis=-1).reshape(parts, 2, 2)
    covariance = np.linalg.pinv(information)
    value = np.einsum("pab,pb->pa", covariance, score)
    noise = np.bincount(part, residual**2, parts) / np.maximum(np.bincount(part, minlength=parts), 1)
    sd = np.sqrt(noise[:, None] * np.diagonal(covariance, axis1=1, axis2=2))
    determined = (np.bincount(part, minlength=parts)[:, None] >= MIN_PART_SAMPLES) & (sd > 0.0)
    weight = np.where(determined, 1.0 / np.maximum(sd, 1e-12) ** 2, 0.0)
    mean = (weight * value).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-300)
    return AmplitudeChanges(value - mean, np.where(determined, sd, np.inf))
