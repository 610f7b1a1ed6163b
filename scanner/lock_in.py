"""Lock-in demodulation: amplitude and phase of a signal, by least squares against a sine in consecutive blocks."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scanner.arrays import Array

Phasors = NDArray[np.complex128]

BLOCKS_PER_PASS = 4
"""Blocks that are multiplied together: each value of the table is loaded once for all of them."""

TILE_SAMPLES = 256
"""Samples of a block that are folded at a time: their sums, 16 kB, fit the first-level cache."""

MIN_BLOCK_CYCLES = 0.75
"""Cycles of a block that distinguish a sine from an offset: noise has 1.4 times the effect of that in one cycle."""

COMPILED_DTYPES = (np.dtype(np.int16), np.dtype(np.float32), np.dtype(np.float64))
"""Types of samples for which there is a compiled kernel; other types are converted to float64 first."""


def block_phasors(
    values: NDArray[Any], rate: float, start: float, frequency: float, block: int, gain: float = 1.0
) -> tuple[Array, Phasors]:
    """Return amplitude and phase of ``gain * values`` near ``frequency`` in consecutive blocks.

    Every block is fitted, under a Hann window, with an offset and a sine: values = c + Im(Z exp(2 pi i f (t - tc))), so
    that a signal A sin(Phi(t)) gives Z = A exp(i Phi(tc)) at the block's centre tc. The fit is exact for one pure sine
    for any block length; the window suppresses harmonics and slopes.

    Args:
        values: shape (n,).
        rate: of the samples [Hz].
        start: time of the first sample [s].
        frequency: of the sine [Hz].
        block: samples in a block; a remainder at the end is not used.
        gain: factor on the values.

    Returns:
        (centre times [s], Z), both of shape (n // block,); Z is NaN where a sample of the block is not finite.
    """
    starts = np.arange(values.size // block) * block
    fitted, _ = block_products(values, starts, _phasor_weights(block, frequency / rate), 1, gain)
    centres = start + (starts + 0.5 * (block - 1)) / rate
    phasors = np.full(starts.size, np.nan, np.complex128)
    finite = np.isfinite(fitted).all(axis=1)
    phasors[finite] = fitted[finite, 1] + 1j * fitted[finite, 0]
    return np.asarray(centres, np.float64), phasors


def phasor_noise(rate: float, frequency: float, block: int) -> float:
    """Return the sd of the component of Z that white noise of sd 1 affects most, for ``block_phasors``' arguments."""
    return float(np.sqrt((_phasor_weights(block, frequency / rate) ** 2).sum(axis=1).max()))


@lru_cache(maxsize=4)
def _phasor_weights(block: int, turns: float) -> Array:
    """Weights of the samples in the cosine and sine, shape (2, block), of a tone of ``turns`` cycles a sample."""
    turn = 2 * np.pi * turns * (np.arange(block) - 0.5 * (block - 1))
    basis = np.stack([np.ones(block), np.cos(turn), np.sin(turn)])
    windowed = basis * np.sin(np.pi * (np.arange(block) + 0.5) / block) ** 2
    return np.asarray(np.linalg.inv(windowed @ basis.T)[1:] @ windowed)


def contiguous_samples(values: NDArray[Any]) -> NDArray[Any]:
    """Return the values contiguous in memory, converted to float64 unless their type is in ``COMPILED_DTYPES``."""
    return np.ascontiguousarray(values if values.dtype in COMPILED_DTYPES else values.astype(np.float64))


def block_products(
    values: NDArray[Any],
    starts: NDArray[np.int64],
    table: Array,
    evens: int,
    gain: float = 1.0,
    offset: float = 0.0,
    squared: bool = False,
) -> tuple[Array, Array]:
    """Return the products of blocks of ``gain * values + offset``, or of its square, with a table and with themselves.

    Args:
        values: samples as they are stored, shape (n,); a block with one that is not finite has no finite square.
        starts: first sample of each block, shape (blocks,).
        table: shape (rows, length); about its middle the first ``evens`` rows are even, the others odd.

    Returns:
        (products, shape (blocks, rows); squares, shape (blocks,)).
    """
    values = contiguous_samples(values)
    padded = -(-starts.size // BLOCKS_PER_PASS) * BLOCKS_PER_PASS
    products, squares = np.zeros((padded, len(table))), np.zeros(padded)
    if starts.size:
        _block_products(values, starts, np.ascontiguousarray(table), evens, gain, offset, squared, products, squares)
    return products[: starts.size], squares[: starts.size]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _block_products(values, starts, table, evens, gain, offset, squared, products, squares):  # type: ignore[no-untyped-def]
    """A block is folded about its middle into its even and its odd part, so that each product is half as long."""
    length = table.shape[1]
    half, middle = length // 2, length // 2 + length % 2
    even, odd = np.empty((BLOCKS_PER_PASS, TILE_SAMPLES)), np.empty((BLOCKS_PER_PASS, TILE_SAMPLES))
    for group in range(0, starts.size, BLOCKS_PER_PASS):
        for at in range(0, half, TILE_SAMPLES):
            n = min(TILE_SAMPLES, half - at)
            for r in range(BLOCKS_PER_PASS):
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
            rows = products[group : group + BLOCKS_PER_PASS]
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
    """Add products of table rows ``first`` up to ``stop`` with four blocks, two rows at a time."""
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
    """Return the number of samples in a block of about ``cycles`` cycles."""
    return max(4, round(cycles * rate / frequency))


def slow_clock_block(frequency: float, rate: float, cycles: float, samples: int) -> int:
    """Return the number of samples in a block of about ``cycles`` cycles, of which ``samples`` hold two.

    Few samples are divided into two blocks of at least ``MIN_BLOCK_CYCLES``; fewer do not hold two.
    """
    block = block_length(frequency, rate, cycles)
    if samples >= 2 * block:
        return block
    return max(block_length(frequency, rate, MIN_BLOCK_CYCLES), min(samples // 2, block))


def unwrap_phase(phase: Array) -> Array:
    """Return the phase (n,) [rad] without jumps of 2 pi. Its second difference is taken as small, not its slope."""
    bend = np.diff(np.diff(phase), prepend=0.0)
    slope = np.cumsum(bend - 2 * np.pi * np.round(bend / (2 * np.pi)))
    return np.concatenate([phase[:1], phase[0] + np.cumsum(slope)])
