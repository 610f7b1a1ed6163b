"""Phase and amplitude from samples: least squares against a sine, block by block."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Phasors = NDArray[np.complex128]

ROWS = 4  # blocks multiplied together, so that each value of the table is loaded once for all of them
TILE = 256  # samples of a block folded at a time: what they become stays in the first cache
COMPILED = (np.dtype(np.int16), np.dtype(np.float32), np.dtype(np.float64))  # types that are taken as they are stored


def block_phasors(
    values: NDArray[Any], rate: float, start: float, frequency: float, block: int, gain: float = 1.0
) -> tuple[Array, Phasors]:
    """Amplitude and phase of ``gain * values`` near ``frequency`` in consecutive blocks.

    Every block is fitted, under a Hann window, with an offset and a sine: values = c + Im(Z exp(2 pi i f (t - tc))), so
    that a signal A sin(Phi(t)) gives Z = A exp(i Phi(tc)) at the block's centre tc. The fit is exact for one pure sine
    whatever the block's length; the window keeps harmonics and slopes out.

    Args:
        values: shape (n,).
        rate: [Hz]. start: time of the first sample [s]. frequency: [Hz]. block: samples; a rest at the end is left.

    Returns:
        (centre times [s], Z), both of shape (n // block,).
    """
    starts = np.arange(values.size // block) * block
    fitted, _ = block_products(values, starts, _phasor_weights(block, frequency / rate), 1, gain)
    centres = start + (starts + 0.5 * (block - 1)) / rate
    return np.asarray(centres, np.float64), np.asarray(fitted[:, 1] + 1j * fitted[:, 0], np.complex128)


@lru_cache(maxsize=4)
def _phasor_weights(block: int, turns: float) -> Array:
    """Each sample's share in cosine and sine, shape (2, block), of a line that makes ``turns`` a sample."""
    turn = 2 * np.pi * turns * (np.arange(block) - 0.5 * (block - 1))
    basis = np.stack([np.ones(block), np.cos(turn), np.sin(turn)])
    windowed = basis * np.sin(np.pi * (np.arange(block) + 0.5) / block) ** 2
    return np.asarray(np.linalg.inv(windowed @ basis.T)[1:] @ windowed)


def plain(values: NDArray[Any]) -> NDArray[Any]:
    """The values in one stretch of memory, in a type that compiled code takes: their own if it is in ``COMPILED``."""
    return np.ascontiguousarray(values if values.dtype in COMPILED else values.astype(np.float64))


def block_products(
    values: NDArray[Any],
    starts: NDArray[np.int64],
    table: Array,
    evens: int,
    gain: float = 1.0,
    offset: float = 0.0,
    squared: bool = False,
) -> tuple[Array, Array]:
    """Blocks of ``gain * values + offset``, or of its square, times each row of a table and times themselves.

    Args:
        values: samples as they are stored, shape (n,); a block with one that is not finite has no finite square.
        starts: first sample of each block, shape (blocks,).
        table: shape (rows, length); about its middle the first ``evens`` rows are even, the others odd.

    Returns:
        (products, shape (blocks, rows); squares, shape (blocks,)).
    """
    values = plain(values)
    padded = -(-starts.size // ROWS) * ROWS
    products, squares = np.zeros((padded, len(table))), np.zeros(padded)
    if starts.size:
        _block_products(values, starts, np.ascontiguousarray(table), evens, gain, offset, squared, products, squares)
    return products[: starts.size], squares[: starts.size]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _block_products(values, starts, table, evens, gain, offset, squared, products, squares):  # type: ignore[no-untyped-def]
    """A block is folded about its middle into its even and its odd part, so that each product is half as long."""
    length = table.shape[1]
    half, middle = length // 2, length // 2 + length % 2
    even, odd = np.empty((ROWS, TILE)), np.empty((ROWS, TILE))
    for group in range(0, starts.size, ROWS):
        for at in range(0, half, TILE):
            n = min(TILE, half - at)
            for r in range(ROWS):
                first = starts[min(group + r, starts.size - 1)]  # what is too many goes into the padding
                before = values[first + half - at - n : first + half - at]
                after = values[first + middle + at : first + middle + at + n]
                a, b, total, last = even[r], odd[r], 0.0, np.uintp(n - 1)
                for j in range(n):
                    p, q = gain * before[last - np.uintp(j)] + offset, gain * after[j] + offset  # unsigned: no wrapping
                    if squared:
                        p, q = p * p, q * q
                    a[j], b[j] = p + q, q - p
                    total += p * p + q * q
                squares[group + r] += total
            rows = products[group : group + ROWS]
            _add_products(even, table, 0, evens, middle + at, n, rows)
            _add_products(odd, table, evens, table.shape[0], middle + at, n, rows)
    if middle > half:
        for i in range(starts.size):
            p = gain * values[starts[i] + half] + offset
            p = p * p if squared else p
            squares[i] += p * p
            for c in range(evens):
                products[i, c] += p * table[c, half]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"}, inline="always")
def _add_products(x, table, first, stop, at, n, products):  # type: ignore[no-untyped-def]
    """Rows ``first`` up to ``stop`` of the table, two at a time, times ROWS blocks: as many sums as fit registers."""
    x0, x1, x2, x3 = x[0], x[1], x[2], x[3]
    for c in range(first, stop, 2):
        d = min(c + 1, stop - 1)
        u, v = table[c, at : at + n], table[d, at : at + n]
        s0, s1, s2, s3, t0, t1, t2, t3 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(n):
            s0 += x0[j] * u[j]
            s1 += x1[j] * u[j]
            s2 += x2[j] * u[j]
            s3 += x3[j] * u[j]
            t0 += x0[j] * v[j]
            t1 += x1[j] * v[j]
            t2 += x2[j] * v[j]
            t3 += x3[j] * v[j]
        products[0, c] += s0
        products[1, c] += s1
        products[2, c] += s2
        products[3, c] += s3
        if d > c:
            products[0, d] += t0
            products[1, d] += t1
            products[2, d] += t2
            products[3, d] += t3


def block_length(frequency: float, rate: float, cycles: float) -> int:
    """Samples in a block of about ``cycles`` cycles."""
    return max(4, round(cycles * rate / frequency))


def unwrapped(phase: Array) -> Array:
    """Phase without jumps, each step continuing the slope before it, so that a frequency that runs away is followed."""
    bend = np.diff(np.diff(phase), prepend=0.0)
    slope = np.cumsum(bend - 2 * np.pi * np.round(bend / (2 * np.pi)))
    return np.concatenate([phase[:1], phase[0] + np.cumsum(slope)])
