"""Compiled solver for posterior pictures: several right-hand sides at once, conjugate gradients on a multigrid cycle.

The prior energy of a picture x is the sum over cells (squares of four neighbouring pixels) of g' W g, where g is the
gradient in the cell and W its weight, a symmetric 2 x 2 matrix. Its matrix couples a pixel to its eight neighbours and
is stored as five arrays of shape (height + 2, width + 2): the diagonal and the coupling to the right, below, below
right and below left. One row and column of zeros on every side replace comparisons at the edges.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

LANES = 4
"""Systems solved at once. In a sweep, each pixel waits for the one before; four independent systems fill that time."""

COARSEST_PIXELS = 8
"""Width or height of the coarsest grid: few enough for relaxation to solve it."""

COARSEST_SWEEPS = 8
"""Symmetric relaxations on the coarsest grid."""

GRADIENT_SCALE = np.float32(0.5)
"""A picture that is constant in blocks of 2 x 2 pixels has twice the gradient energy of the smooth picture that it
stands for, so couplings between blocks are halved on each coarser grid."""

Stencil = NDArray[np.float32]
"""Five coupling arrays with a border of zeros, shape (5, height + 2, width + 2)."""

Fields = NDArray[np.float32]
"""``LANES`` pictures with a border of zeros, shape (LANES, height + 2, width + 2)."""


@numba.njit(cache=True)
def build_stencil(xx, xy, yy):  # type: ignore[no-untyped-def]
    """Return the stencil of cell weights W = [[xx, xy], [xy, yy]], each of shape (height - 1, width - 1)."""
    height, width = xx.shape[0] + 1, xx.shape[1] + 1
    stencil = np.zeros((5, height + 2, width + 2), np.float32)
    for i in range(height - 1):
        for j in range(width - 1):
            across, down, diagonal = 0.5 * xx[i, j], 0.5 * yy[i, j], 0.5 * xy[i, j]
            top, left = i + 1, j + 1
            stencil[1, top, left] -= across
            stencil[1, top + 1, left] -= across
            stencil[2, top, left] -= down
            stencil[2, top, left + 1] -= down
            stencil[3, top, left] -= diagonal
            stencil[4, top, left + 1] += diagonal
            stencil[0, top, left] += across + down + diagonal
            stencil[0, top + 1, left + 1] += across + down + diagonal
            stencil[0, top, left + 1] += across + down - diagonal
            stencil[0, top + 1, left] += across + down - diagonal
    return stencil


@numba.njit(cache=True, fastmath=True)
def _couple_row_above(stencil, x, i, total):  # type: ignore[no-untyped-def]
    """Set ``total``, shape (width,), to the couplings of the pixels of row i to the row above, of one lane."""
    above, to_left, to_above, to_right = x[i - 1], stencil[3, i - 1], stencil[2, i - 1], stencil[4, i - 1]
    for j in range(total.size):
        total[j] = to_left[j] * above[j] + to_above[j + 1] * above[j + 1] + to_right[j + 2] * above[j + 2]


@numba.njit(cache=True, fastmath=True)
def _add_row_below(stencil, x, i, total):  # type: ignore[no-untyped-def]
    """Add to ``total``, shape (width,), the couplings of the pixels of row i to the row below, of one lane."""
    below, to_left, to_below, to_right = x[i + 1], stencil[4, i], stencil[2, i], stencil[3, i]
    for j in range(total.size):
        total[j] += to_left[j + 1] * below[j] + to_below[j + 1] * below[j + 1] + to_right[j + 1] * below[j + 2]


@numba.njit(cache=True, fastmath=True)
def multiply(stencil, precision, x, out):  # type: ignore[no-untyped-def]
    """Write (prior + data precision) x into ``out``."""
    n = x.shape[2] - 2
    total = np.empty(n, np.float32)
    for i in range(1, x.shape[1] - 1):
        own, beside = stencil[0, i], stencil[1, i]
        for k in range(LANES):
            _couple_row_above(stencil, x[k], i, total)
            _add_row_below(stencil, x[k], i, total)
            row, data, product = x[k, i], precision[k, i], out[k, i]
            for j in range(n):
                neighbours = total[j] + beside[j] * row[j] + beside[j + 1] * row[j + 2]
                product[j + 1] = neighbours + (own[j + 1] + data[j + 1]) * row[j + 1]


@numba.njit(cache=True, fastmath=True)
def _substitute(values, factors, forward):  # type: ignore[no-untyped-def]
    """Subtract from each value the result beside it times its factor, in place, along rows of shape (LANES, width).

    The lanes are written out, so that their last results stay in registers.
    """
    a = b = c = d = np.float32(0.0)
    n = values.shape[1]
    for step in range(n):
        j = step if forward else n - 1 - step
        a = values[0, j] - factors[0, j] * a
        b = values[1, j] - factors[1, j] * b
        c = values[2, j] - factors[2, j] * c
        d = values[3, j] - factors[3, j] * d
        values[0, j], values[1, j], values[2, j], values[3, j] = a, b, c, d


@numba.njit(cache=True, fastmath=True)
def _relax(stencil, inverse, b, x, forward):  # type: ignore[no-untyped-def]
    """One Gauss-Seidel sweep; ``inverse``: of the diagonal."""
    height, n = x.shape[1] - 2, x.shape[2] - 2
    values, factors = np.empty((LANES, n), np.float32), np.empty((LANES, n), np.float32)
    for step in range(1, height + 1):
        i = step if forward else height + 1 - step
        beside = stencil[1, i]
        old, new = (1, 0) if forward else (0, 1)
        for k in range(LANES):
            value, factor = values[k], factors[k]
            _couple_row_above(stencil, x[k], i, value)
            _add_row_below(stencil, x[k], i, value)
            row, target, scale = x[k, i], b[k, i], inverse[k, i]
            for j in range(n):
                value[j] = (target[j + 1] - value[j] - beside[j + old] * row[j + 2 * old]) * scale[j + 1]
                factor[j] = beside[j + new] * scale[j + 1]
        _substitute(values, factors, forward)
        for k in range(LANES):
            for j in range(n):
                x[k, i, j + 1] = values[k, j]


@numba.njit(cache=True, fastmath=True)
def _relax_from_zero(stencil, inverse, b):  # type: ignore[no-untyped-def]
    """Return the result of a forward Gauss-Seidel sweep that begins at zero; ``inverse``: of the diagonal."""
    n = b.shape[2] - 2
    x = np.zeros_like(b)
    values, factors = np.empty((LANES, n), np.float32), np.empty((LANES, n), np.float32)
    for i in range(1, x.shape[1] - 1):
        beside = stencil[1, i]
        for k in range(LANES):
            value, factor = values[k], factors[k]
            _couple_row_above(stencil, x[k], i, value)
            target, scale = b[k, i], inverse[k, i]
            for j in range(n):
                value[j] = (target[j + 1] - value[j]) * scale[j + 1]
                factor[j] = beside[j] * scale[j + 1]
        _substitute(values, factors, True)
        for k in range(LANES):
            for j in range(n):
                x[k, i, j + 1] = values[k, j]
    return x


@numba.njit(cache=True)
def _coarsen_stencil(stencil):  # type: ignore[no-untyped-def]
    """The stencil on blocks of 2 x 2 pixels."""
    height, width = stencil.shape[1] - 2, stencil.shape[2] - 2
    coarse = np.zeros((5, (height + 1) // 2 + 2, (width + 1) // 2 + 2), np.float32)
    for i in range(height):
        for j in range(width):
            for direction in range(1, 5):
                to_i = i + (1 if direction > 1 else 0)
                to_j = j + (0 if direction == 2 else (-1 if direction == 4 else 1))
                block_i, block_j, to_block_i, to_block_j = i // 2, j // 2, to_i // 2, to_j // 2
                coupling = GRADIENT_SCALE * stencil[direction, i + 1, j + 1]
                if coupling == 0.0 or (block_i == to_block_i and block_j == to_block_j):
                    continue
                if block_i == to_block_i:
                    coarse[1, block_i + 1, min(block_j, to_block_j) + 1] += coupling
                elif block_j == to_block_j:
                    coarse[2, block_i + 1, block_j + 1] += coupling
                elif to_block_j > block_j:
                    coarse[3, block_i + 1, block_j + 1] += coupling
                else:
                    coarse[4, block_i + 1, block_j + 1] += coupling
                coarse[0, block_i + 1, block_j + 1] -= coupling
                coarse[0, to_block_i + 1, to_block_j + 1] -= coupling
    return coarse


@numba.njit(cache=True, fastmath=True)
def _sum_blocks(fine):  # type: ignore[no-untyped-def]
    """Sums over blocks of 2 x 2 pixels."""
    height, width = fine.shape[1] - 2, fine.shape[2] - 2
    coarse = np.zeros((LANES, (height + 1) // 2 + 2, (width + 1) // 2 + 2), np.float32)
    for k in range(LANES):
        for i in range(height):
            for j in range(width):
                coarse[k, i // 2 + 1, j // 2 + 1] += fine[k, i + 1, j + 1]
    return coarse


@numba.njit(cache=True, fastmath=True)
def _residual_blocks(stencil, x):  # type: ignore[no-untyped-def]
    """Sums over blocks of 2 x 2 pixels of the residual that a forward sweep from zero leaves.

    A sweep satisfies the equation of each pixel with the values after it still zero: these alone are the residual.
    """
    height, n = x.shape[1] - 2, x.shape[2] - 2
    coarse = np.zeros((LANES, (height + 1) // 2 + 2, (n + 1) // 2 + 2), np.float32)
    coupled = np.zeros(n + n % 2, np.float32)
    for i in range(1, height + 1):
        beside = stencil[1, i]
        for k in range(LANES):
            row, blocks = x[k, i], coarse[k, (i + 1) // 2]
            for j in range(n):
                coupled[j] = beside[j + 1] * row[j + 2]
            _add_row_below(stencil, x[k], i, coupled[:n])
            for block in range(coupled.size // 2):
                blocks[block + 1] -= coupled[2 * block] + coupled[2 * block + 1]
    return coarse


@numba.njit(cache=True, fastmath=True)
def _add_blocks(x, coarse):  # type: ignore[no-untyped-def]
    """Add to each pixel the value of its block."""
    n = x.shape[2] - 2
    for k in range(LANES):
        for i in range(1, x.shape[1] - 1):
            row, blocks = x[k, i], coarse[k, (i + 1) // 2]
            for block in range(n // 2):
                row[2 * block + 1] += blocks[block + 1]
                row[2 * block + 2] += blocks[block + 1]
            if n % 2:
                row[n] += blocks[n // 2 + 1]


def _inverse_diagonal(stencil: Stencil, precision: Fields) -> Fields:
    return np.float32(1.0) / np.maximum(stencil[0] + precision, np.float32(1e-30))


Level = tuple[Any, ...]
"""Stencil, data precision and inverse diagonal of one grid."""


def _build_levels(stencil: Stencil, precision: Fields) -> list[Level]:
    """The grids from the finest to the coarsest."""
    levels = [(stencil, precision, _inverse_diagonal(stencil, precision))]
    while min(levels[-1][0].shape[1:]) - 2 > COARSEST_PIXELS:
        stencil, precision = _coarsen_stencil(levels[-1][0]), _sum_blocks(levels[-1][1])
        levels.append((stencil, precision, _inverse_diagonal(stencil, precision)))
    return levels


def _cycle(levels: list[Level], b: Fields) -> Fields:
    """One V-cycle from zero: a symmetric approximation of the inverse."""
    stencil, _, inverse = levels[0]
    x = _relax_from_zero(stencil, inverse, b)
    if len(levels) == 1:
        _relax(stencil, inverse, b, x, False)
        for _ in range(COARSEST_SWEEPS - 1):
            _relax(stencil, inverse, b, x, True)
            _relax(stencil, inverse, b, x, False)
        return x
    _add_blocks(x, _cycle(levels[1:], _residual_blocks(stencil, x)))
    _relax(stencil, inverse, b, x, False)
    return x


@numba.njit(cache=True, fastmath=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    """Inner product in each lane, shape (LANES,), of the rows in single precision."""
    total = np.zeros(LANES)
    for k in range(LANES):
        for i in range(1, a.shape[1] - 1):
            row = np.float32(0.0)
            for j in range(1, a.shape[2] - 1):
                row += a[k, i, j] * b[k, i, j]
            total[k] += row
    return total


@numba.njit(cache=True, fastmath=True)
def _step(size, direction, product, x, residual):  # type: ignore[no-untyped-def]
    """Advance the solution and the residual along the search direction; return the squared residual."""
    total = np.zeros(LANES)
    for k in range(LANES):
        for i in range(1, x.shape[1] - 1):
            for j in range(1, x.shape[2] - 1):
                x[k, i, j] += size[k] * direction[k, i, j]
            for j in range(1, x.shape[2] - 1):
                residual[k, i, j] -= size[k] * product[k, i, j]
            row = np.float32(0.0)
            for j in range(1, x.shape[2] - 1):
                row += residual[k, i, j] * residual[k, i, j]
            total[k] += row
    return total


@numba.njit(cache=True, fastmath=True)
def _turn(ratio, conditioned, direction):  # type: ignore[no-untyped-def]
    """Set the next search direction."""
    for k in range(LANES):
        for i in range(1, direction.shape[1] - 1):
            for j in range(1, direction.shape[2] - 1):
                direction[k, i, j] = conditioned[k, i, j] + ratio[k] * direction[k, i, j]


def solve(
    stencil: Stencil, precision: Fields, b: Fields, start: Fields, tolerance: float, max_iterations: int = 40
) -> Fields:
    """Solve (prior + data precision) x = b in every lane by preconditioned conjugate gradients.

    Args:
        stencil: of the prior, from :func:`build_stencil`.
        precision: of the data, by pixel and lane; not negative, and positive somewhere in every lane.
        b: right-hand sides.
        start: first guess.
        tolerance: of the residual's norm, relative to that of ``b``, in the worst lane.
        max_iterations: after which the solution is returned as it is.
    """
    levels = _build_levels(stencil, precision)
    x, product = start.copy(), np.zeros_like(b)
    multiply(stencil, precision, x, product)
    residual = b - product
    target = tolerance**2 * np.maximum(_dot(b, b), np.finfo(np.float32).tiny)
    if (_dot(residual, residual) <= target).all():
        return x
    conditioned = _cycle(levels, residual)
    direction, energy = conditioned.copy(), _dot(residual, conditioned)
    for _ in range(max_iterations):
        multiply(stencil, precision, direction, product)
        curvature = _dot(direction, product)
        size = np.divide(energy, curvature, out=np.zeros(LANES), where=curvature > 0)
        if (_step(size.astype(np.float32), direction, product, x, residual) <= target).all():
            break
        conditioned = _cycle(levels, residual)
        previous, energy = energy, _dot(residual, conditioned)
        ratio = np.divide(energy, previous, out=np.zeros(LANES), where=previous > 0)
        _turn(ratio.astype(np.float32), conditioned, direction)
    return x
