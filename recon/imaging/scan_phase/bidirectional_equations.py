"""Normal equations of the bidirectional phase (the model is in :mod:`recon.imaging.scan_phase.bidirectional_phase`)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from recon.imaging.picture import Grid
from recon.imaging.scan_phase.bidirectional_search import RegistrationSamples
from scanner.arrays import Array

SMOOTHING_SD_CELLS = 1.5
"""Standard deviation of the Gaussian that smooths the picture, in cells."""

BLOCKS_PER_SLICE = 64
"""Blocks of time in a slice. The errors of blocks of about one period of an axis are independent, except for what
repeats at the same place."""

TILES_ACROSS = 16
"""Tiles of the field in each direction, whose errors are independent: a tile is wider than the detail that the cells do
not resolve, and the scatter of 256 tiles determines a standard error to 5 %."""


class NormalEquations(NamedTuple):
    """Normal equations of the module's model.

    Attributes:
        score: of each block, shape (slices, BLOCKS_PER_SLICE, 2).
        information: of each slice, shape (slices, 2, 2).
        block_information: its diagonal by block, shape (slices, BLOCKS_PER_SLICE, 2).
        tile_score: of each tile of the field, shape (slices, TILES_ACROSS², 2).
    """

    score: Array
    information: Array
    block_information: Array
    tile_score: Array


def normal_equations(samples: RegistrationSamples, error: Array, grid: Grid, cell: float) -> NormalEquations:
    """Map with the given phase errors, smooth over cells of one size [px], and compare each sample with the map at its
    position."""
    import cv2

    shape = (math.ceil(grid.height / cell) + 1, math.ceil(grid.width / cell) + 1)
    fields = np.zeros((*shape, 8))  # sums of count, intensity, x, y, dx, dy; then the picture's gradient
    cos, sin = np.cos(error), np.sin(error)
    _splat(samples, cos, sin, cell, fields)
    size = 2 * math.ceil(3 * SMOOTHING_SD_CELLS) + 1
    cv2.GaussianBlur(fields, (size, size), SMOOTHING_SD_CELLS, dst=fields, borderType=cv2.BORDER_CONSTANT)
    counts, sums = fields[..., 0], fields[..., 1]
    picture = np.divide(sums, counts, out=np.full(shape, np.nan), where=counts > 1e-9)
    fields[..., 7], fields[..., 6] = np.nan_to_num(np.gradient(picture)) / cell
    score, information = np.zeros((len(error), BLOCKS_PER_SLICE, 2)), np.zeros((len(error), 2, 2))
    equations = NormalEquations(score, information, np.zeros_like(score), np.zeros((len(error), TILES_ACROSS**2, 2)))
    _accumulate_normal(samples, cos, sin, cell, fields, equations)
    return equations


@numba.njit(cache=True, inline="always")
def _locate(place, motion, cos, sin, cell, n):  # type: ignore[no-untyped-def]
    """Corrected position, its change with the phase, the cell below it (-1 outside) and the fraction to the next."""
    corrected = place * cos + motion * sin
    position = corrected / cell + 0.5 * (n - 1)
    inside = 0.0 <= position < n - 1
    index = int(position) if inside else -1
    return corrected, motion * cos - place * sin, index, position - index


@numba.njit(cache=True, nogil=True)
def _splat(samples, cos, sin, cell, fields):  # type: ignore[no-untyped-def]
    """Spread count, intensity, position and its change of each sample over the four cells around its position."""
    height, width, _ = fields.shape
    for i in range(samples.x.size):
        s = samples.block[i] // BLOCKS_PER_SLICE
        x, dx, column, right = _locate(samples.x[i], samples.dx[i], cos[s, 0], sin[s, 0], cell, width)
        y, dy, row, down = _locate(samples.y[i], samples.dy[i], cos[s, 1], sin[s, 1], cell, height)
        if column < 0 or row < 0:
            continue
        for r in range(2):
            for c in range(2):
                weight = (down if r else 1.0 - down) * (right if c else 1.0 - right)
                place = fields[row + r, column + c]
                place[0] += weight
                place[1] += weight * samples.intensity[i]
                place[2] += weight * x
                place[3] += weight * y
                place[4] += weight * dx
                place[5] += weight * dy


@numba.njit(cache=True, nogil=True)
def _accumulate_normal(samples, cos, sin, cell, fields, equations):  # type: ignore[no-untyped-def]
    score, information, block_information, tile_score = equations
    height, width, _ = fields.shape
    mean = np.empty(8)
    for i in range(samples.x.size):
        s, block = divmod(samples.block[i], BLOCKS_PER_SLICE)
        x, dx, column, right = _locate(samples.x[i], samples.dx[i], cos[s, 0], sin[s, 0], cell, width)
        y, dy, row, down = _locate(samples.y[i], samples.dy[i], cos[s, 1], sin[s, 1], cell, height)
        if column < 0 or row < 0:
            continue
        for k in range(8):
            above = (1.0 - right) * fields[row, column, k] + right * fields[row, column + 1, k]
            below = (1.0 - right) * fields[row + 1, column, k] + right * fields[row + 1, column + 1, k]
            mean[k] = (1.0 - down) * above + down * below
        count, slope_x, slope_y = mean[0], mean[6], mean[7]
        residual = samples.intensity[i] - mean[1] / count
        residual -= slope_x * (x - mean[2] / count) + slope_y * (y - mean[3] / count)
        z_x, z_y = slope_x * (dx - mean[4] / count), slope_y * (dy - mean[5] / count)
        tile = TILES_ACROSS * row // height * TILES_ACROSS + TILES_ACROSS * column // width
        score[s, block, 0] += z_x * residual
        score[s, block, 1] += z_y * residual
        tile_score[s, tile, 0] += z_x * residual
        tile_score[s, tile, 1] += z_y * residual
        information[s, 0, 0] += z_x * z_x
        information[s, 0, 1] += z_x * z_y
        information[s, 1, 0] += z_x * z_y
        information[s, 1, 1] += z_y * z_y
        block_information[s, block, 0] += z_x * z_x
        block_information[s, block, 1] += z_y * z_y
