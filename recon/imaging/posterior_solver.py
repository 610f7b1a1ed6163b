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
"""Systems solved at once. Four numbers of single precision fill one register, so four cost little more than one."""

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
"""``LANES`` pictures with a border of zeros, shape (height + 2, width + 2, LANES)."""


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


@numba.njit(cache=True, forceinline=True, fastmath=True)
def _add_coupled(stencil, x, i, j, total):  # type: ignore[no-untyped-def]
    """Set ``total`` to the couplings of a pixel to its eight neighbours."""
    c0, c1, c2, c3 = stencil[1, i, j], stencil[1, i, j - 1], stencil[2, i, j], stencil[2, i - 1, j]
    c4, c5, c6, c7 = stencil[3, i, j], stencil[3, i - 1, j - 1], stencil[4, i, j], stencil[4, i - 1, j + 1]
    for k in range(LANES):
        total[k] = (
            c0 * x[i, j + 1, k]
            + c2 * x[i + 1, j, k]
            + c3 * x[i - 1, j, k]
            + c4 * x[i + 1, j + 1, k]
            + c5 * x[i - 1, j - 1, k]
            + c6 * x[i + 1, j - 1, k]
            + c7 * x[i - 1, j + 1, k]
            + c1 * x[i, j - 1, k]
        )


@numba.njit(cache=True, fastmath=True)
def multiply(stencil, precision, x, out):  # type: ignore[no-untyped-def]
    """Write (prior + data precision) x into ``out``."""
    total = np.empty(LANES, np.float32)
    for i in range(1, x.shape[0] - 1):
        for j in range(1, x.shape[1] - 1):
            _add_coupled(stencil, x, i, j, total)
            own = stencil[0, i, j]
            for k in range(LANES):
                out[i, j, k] = total[k] + (own + precision[i, j, k]) * x[i, j, k]


@numba.njit(cache=True, fastmath=True)
def _relax(stencil, inverse, b, x, forward):  # type: ignore[no-untyped-def]
    """One Gauss-Seidel sweep; ``inverse``: of the diagonal."""
    total = np.empty(LANES, np.float32)
    height, width = x.shape[0], x.shape[1]
    for row in range(1, height - 1):
        i = row if forward else height - 1 - row
        for column in range(1, width - 1):
            j = column if forward else width - 1 - column
            _add_coupled(stencil, x, i, j, total)
            for k in range(LANES):
                x[i, j, k] = (b[i, j, k] - total[k]) * inverse[i, j, k]


@numba.njit(cache=True, fastmath=True)
def _relax_from_zero(stencil, inverse, b):  # type: ignore[no-untyped-def]
    """Return the result of a forward Gauss-Seidel sweep that begins at zero; ``inverse``: of the diagonal."""
    x = np.zeros_like(b)
    for i in range(1, x.shape[0] - 1):
        for j in range(1, x.shape[1] - 1):
            c1, c3, c5, c7 = (
                stencil[1, i, j - 1],
                stencil[2, i - 1, j],
                stencil[3, i - 1, j - 1],
                stencil[4, i - 1, j + 1],
            )
            for k in range(LANES):
                coupled = c3 * x[i - 1, j, k] + c5 * x[i - 1, j - 1, k] + c7 * x[i - 1, j + 1, k] + c1 * x[i, j - 1, k]
                x[i, j, k] = (b[i, j, k] - coupled) * inverse[i, j, k]
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
    height, width = fine.shape[0] - 2, fine.shape[1] - 2
    coarse = np.zeros(((height + 1) // 2 + 2, (width + 1) // 2 + 2, LANES), np.float32)
    for i in range(height):
        for j in range(width):
            for k in range(LANES):
                coarse[i // 2 + 1, j // 2 + 1, k] += fine[i + 1, j + 1, k]
    return coarse


@numba.njit(cache=True, fastmath=True)
def _residual_blocks(stencil, x):  # type: ignore[no-untyped-def]
    """Sums over blocks of 2 x 2 pixels of the residual that a forward sweep from zero leaves.

    A sweep satisfies the equation of each pixel with the values after it still zero: these alone are the residual.
    """
    height, width = x.shape[0] - 2, x.shape[1] - 2
    coarse = np.zeros(((height + 1) // 2 + 2, (width + 1) // 2 + 2, LANES), np.float32)
    for i in range(1, height + 1):
        for j in range(1, width + 1):
            c0, c2, c4, c6 = stencil[1, i, j], stencil[2, i, j], stencil[3, i, j], stencil[4, i, j]
            for k in range(LANES):
                coupled = c0 * x[i, j + 1, k] + c2 * x[i + 1, j, k] + c4 * x[i + 1, j + 1, k] + c6 * x[i + 1, j - 1, k]
                coarse[(i + 1) // 2, (j + 1) // 2, k] -= coupled
    return coarse


@numba.njit(cache=True, fastmath=True)
def _add_blocks(x, coarse):  # type: ignore[no-untyped-def]
    """Add to each pixel the value of its block."""
    for i in range(1, x.shape[0] - 1):
        for j in range(1, x.shape[1] - 1):
            for k in range(LANES):
                x[i, j, k] += coarse[(i + 1) // 2, (j + 1) // 2, k]


@numba.njit(cache=True)
def _inverse_diagonal(stencil, precision):  # type: ignore[no-untyped-def]
    inverse = np.zeros_like(precision)
    for i in range(1, precision.shape[0] - 1):
        for j in range(1, precision.shape[1] - 1):
            for k in range(LANES):
                inverse[i, j, k] = np.float32(1.0) / max(stencil[0, i, j] + precision[i, j, k], np.float32(1e-30))
    return inverse


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
    total = np.zeros(LANES)
    for i in range(1, a.shape[0] - 1):
        row = np.zeros(LANES, np.float32)
        for j in range(1, a.shape[1] - 1):
            for k in range(LANES):
                row[k] += a[i, j, k] * b[i, j, k]
        for k in range(LANES):
            total[k] += row[k]
    return total


@numba.njit(cache=True, fastmath=True)
def _step(size, direction, product, x, residual):  # type: ignore[no-untyped-def]
    """Advance the solution and the residual along the search direction; return the squared residual."""
    total = np.zeros(LANES)
    for i in range(1, x.shape[0] - 1):
        row = np.zeros(LANES, np.float32)
        for j in range(1, x.shape[1] - 1):
            for k in range(LANES):
                x[i, j, k] += size[k] * direction[i, j, k]
                residual[i, j, k] -= size[k] * product[i, j, k]
                row[k] += residual[i, j, k] * residual[i, j, k]
        for k in range(LANES):
            total[k] += row[k]
    return total


@numba.njit(cache=True, fastmath=True)
def _turn(ratio, conditioned, direction):  # type: ignore[no-untyped-def]
    """Set the next search direction."""
    for i in range(1, direction.shape[0] - 1):
        for j in range(1, direction.shape[1] - 1):
            for k in range(LANES):
                direction[i, j, k] = conditioned[i, j, k] + ratio[k] * direction[i, j, k]


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


@numba.njit(cache=True)
def draw_noise(xx, xy, yy, precision, bits):  # type: ignore[no-untyped-def]
    """Return right-hand sides whose solutions have the covariance of the posterior.

    Their covariance is the matrix of the system. They are sums of independent random signs: the variance of the
    solutions needs no normal numbers.

    Args:
        xx, xy, yy: cell weights, shape (height - 1, width - 1).
        precision: of the data, shape (height + 2, width + 2, LANES).
        bits: random bytes, a bit for each lane, shape (4, height, width).

    Returns:
        Shape (height + 2, width + 2, LANES).
    """
    height, width = bits.shape[1], bits.shape[2]
    noise = np.zeros((height + 2, width + 2, LANES), np.float32)
    for i in range(height):
        for j in range(width):
            for k in range(LANES):
                sign = np.float32(2 * ((bits[3, i, j] >> k) & 1)) - np.float32(1.0)
                noise[i + 1, j + 1, k] += sign * np.sqrt(precision[i + 1, j + 1, k])
    for i in range(height - 1):
        for j in range(width - 1):
            # The energy of a cell is (p, q) W (p, q)' / 4 + (xx + yy) r^2 / 4, where p and q are the sums of its two
            # horizontal and its two vertical differences, and r is the difference of its two diagonal sums.
            r00 = np.sqrt(xx[i, j])
            r01 = xy[i, j] / r00
            r11 = np.sqrt(max(yy[i, j] - r01 * r01, 0.0))
            r22 = np.sqrt(xx[i, j] + yy[i, j])
            for k in range(LANES):
                a = (bits[0, i, j] >> k & 1) - 0.5
                b = (bits[1, i, j] >> k & 1) - 0.5
                c = (bits[2, i, j] >> k & 1) - 0.5
                across, down, twist = r00 * a, r01 * a + r11 * b, r22 * c
                noise[i + 1, j + 1, k] += twist - across - down
                noise[i + 1, j + 2, k] += across - down - twist
                noise[i + 2, j + 1, k] += down - across - twist
                noise[i + 2, j + 2, k] += across + down + twist
    return noise
