"""Films of a resonant raster scan with a known line phase: photon counts along lines of both directions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.arrays import Array

SAMPLES_PER_PIXEL = 4
"""Places of the beam that are averaged over a pixel's width."""


def scan_raster_frame(picture: Array, size: tuple[int, int], shift: float, fill: float, ramp: float = 0.0) -> Array:
    """Mean brightness of the pixels of one frame, shape ``size``, with the lines of odd number already reversed.

    The beam is at A sin(α) along a line and the instrument assumes A sin(α - d): its pixels are equal steps of the
    assumed place. With ``fill`` 0 they are equal steps of time in a sweep of constant speed.

    Args:
        picture: brightness over the field, shape (h, w), with a border as wide as the beam leaves the field.
        size: lines and columns.
        shift: distance of the directions' lines at the middle [px].
        fill: W/(2A), fraction of the sweep's width that the columns cover.
        ramp: 0 if the slow axis rests during a line, 1 if it moves at constant speed.
    """
    from scipy.ndimage import map_coordinates

    rows, columns = size
    places = (np.arange(columns * SAMPLES_PER_PIXEL) + 0.5) / SAMPLES_PER_PIXEL - columns / 2
    middle = np.arange(rows) - (rows - 1) / 2
    frame = np.empty(size)
    scale_y, scale_x = picture.shape[0] / (1.1 * rows), picture.shape[1] / (1.1 * columns)
    for first, sign in ((0, 1.0), (1, -1.0)):
        if fill > 0.0:
            half_width = 0.5 * columns / fill
            angle = np.arcsin(places / half_width)
            x = half_width * np.sin(angle + sign * shift / (2.0 * half_width))
            along = sign * ramp * angle / np.pi
        else:
            x = places + 0.5 * sign * shift
            along = sign * ramp * places / columns
        y = middle[first::2, None] + along
        at = [
            (y * scale_y + picture.shape[0] / 2 - 0.5).ravel(),
            (np.broadcast_to(x * scale_x + picture.shape[1] / 2 - 0.5, y.shape)).ravel(),
        ]
        values = map_coordinates(picture, at, order=1, mode="nearest").reshape(y.shape)
        frame[first::2] = values.reshape(len(y), columns, SAMPLES_PER_PIXEL).mean(axis=-1)
    return frame


def count_photons(frame: Array, mean: float, seed: int) -> NDArray[np.uint16]:
    """Poisson counts of a frame with ``mean`` photons a pixel."""
    return np.random.default_rng(seed).poisson(frame * (mean / frame.mean())).astype(np.uint16)
