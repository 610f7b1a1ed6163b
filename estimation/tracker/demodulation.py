"""Block demodulation: least-squares projection of a channel on harmonics, block by block, in one pass.

The samples y of a block are projected on the columns of B: a constant, and cosine and sine of every harmonic (line).
The harmonics of two axes are not orthogonal over a block, so that both the projection s = B'y and the Gram matrix
G = B'B are kept. Together they are sufficient statistics for everything that is linear in the lines. One table of B
serves all blocks as long as the reference's frequency is constant, which makes the projection one matrix product on the
stored samples. A block with missing samples has a Gram matrix of its remaining samples.

The information of clipped samples depends on the track (``clipping``). Until there is one, their conditional mean under
a normal distribution is imputed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import accumulate, repeat
from typing import NamedTuple

import numpy as np
from numba import njit

from estimation.clipped_samples import find_rails
from scanner.arrays import Array, Index
from scanner.channel import MIN_CLIPPED_RUN_SAMPLES, Channel
from scanner.lock_in import BLOCKS_PER_PASS, block_products, contiguous_samples

CHUNK_SAMPLES = 1 << 18
"""Samples read at a time: half a megabyte of 16-bit integers, which a second-level cache holds."""

MAX_TABLE_SLIP_CYCLES = 0.03
"""Cycles by which the highest harmonic may slip against its table over a block, before a new table is made.

The line's amplitude is then reduced by less than 0.2 %; the slip itself is part of the measurement model.
"""


@dataclass(frozen=True)
class Projections:
    """Projected blocks of one channel; m = 1 + 2 lines: constant, then cosine and sine of each line.

    Attributes:
        sums: s = B'y, shape (blocks, m).
        grams: B'T^nB for n = 0, 1, 2, where T is diagonal with the samples' times from the block's middle [s], shape
            (geometries, 3, m, m): the projections of a line, of its derivative and of its second derivative.
        geometry: index of each block's Gram matrices, shape (blocks,).
        squares: y'y, shape (blocks,). counts: samples used, shape (blocks,).
        table_w: angular frequency of each block's table, shape (blocks, references) [rad/s].
        rails: limits of the measured range, infinite where nothing is clipped, shape (blocks, 2).
        clipped_counts: samples beyond the rails, shape (blocks,).
    """

    sums: Array
    grams: Array
    geometry: Index
    squares: Array
    counts: Index
    table_w: Array
    rails: Array
    clipped_counts: Index


class NoiseSpectrum(NamedTuple):
    """Noise of a block's projections, relative to the variance of the samples.

    Attributes:
        white: variance of the white part.
        excess: variances of a line's coefficients in a block by the noise near it that exceeds the white part,
            shape (m,).
    """

    white: float
    excess: Array


def harmonic_basis(length: int, rate: float, lines: Index, table_w: Array) -> Array:
    """B' of one block about its middle, shape (1 + 2 lines, length).

    Args:
        lines: (reference, order) of each line, shape (lines, 2).
        table_w: angular frequency of each reference, shape (references,) [rad/s].
    """
    lowest = max(int(np.gcd.reduce(lines[:, 1])), 1)  # all orders are multiples of it
    first = np.exp(1j * np.outer(lowest * table_w, sample_offsets(length, rate)))
    powers = list(accumulate(repeat(first, lines[:, 1].max(initial=1) // lowest), np.multiply))
    out = np.ones((1 + 2 * len(lines), length))
    for row, (reference, order) in zip(range(1, len(out), 2), lines, strict=True):
        phasor = powers[order // lowest - 1][reference]
        out[row], out[row + 1] = phasor.real, phasor.imag
    return out


def sum_lines(lines: Array, table: Array, offset: Array) -> Array:
    """Signal of lines that change within a block, shape (n,).

    Args:
        lines: coefficients, and their first and half their second derivatives by time, shape (3, m).
        table: B' at the samples, shape (m, n). offset: times from the block's middle, shape (n,) [s].
    """
    constant, linear, quadratic = lines @ table
    return np.asarray(constant + offset * (linear + offset * quadratic))


def project_blocks(
    channel: Channel,
    starts: Index,
    length: int,
    lines: Index,
    omega: Array,
    settling: int = 0,
    squared: bool = False,
    may_clip: bool = True,
) -> Projections:
    """Project a channel's blocks, reading it chunk by chunk.

    Args:
        starts: first sample of each block, increasing, shape (blocks,). length: of every block [samples].
        lines: as in ``harmonic_basis``.
        omega: angular frequency of each reference in each block, shape (blocks, references) [rad/s].
        settling: samples at the channel's beginning that are not used.
        squared: project the squares of the samples.
        may_clip: treat runs of equal samples at a block's extremes as clipped. False for drives, whose flat tops are
            the true signal.
    """
    blocks, m = starts.size, 1 + 2 * len(lines)
    sums, squares, table_w = np.zeros((blocks, m)), np.zeros(blocks), np.empty_like(omega)
    geometry, counts = np.zeros(blocks, np.int64), np.full(blocks, length)
    clipped_counts = np.zeros(blocks, np.int64)
    rails = np.tile([-np.inf, np.inf], (blocks, 1))
    grams: list[Array] = []
    offset = sample_offsets(length, channel.sample_rate)
    by_parity = np.r_[0, 1:m:2, 2:m:2]  # a constant and cosines are even about the block's middle, sines are odd
    highest = np.array([max(lines[lines[:, 0] == i, 1], default=1) for i in range(omega.shape[1])])
    max_slip = 2 * np.pi * MAX_TABLE_SLIP_CYCLES * channel.sample_rate / length
    for group in _frequency_groups(omega * highest, max_slip):
        table_w[group] = 0.5 * (omega[group].min(axis=0) + omega[group].max(axis=0))
        table = harmonic_basis(length, channel.sample_rate, lines, table_w[group.start])
        whole = len(grams)
        grams.append(_gram_moments(table, offset))
        folded = table[by_parity]
        for part in _chunks(starts, length, group):
            first = int(starts[part.start])
            stored = contiguous_samples(channel.stored(first, int(starts[part.stop - 1]) + length))
            part_starts = starts[part] - first
            products, squares[part] = block_products(
                stored, part_starts, folded, 1 + len(lines), channel.gain, channel.offset, squared
            )
            sums[part.start : part.stop, by_parity] = products
            geometry[part] = whole
            irregular = ~np.isfinite(squares[part]) | (starts[part] < settling)
            if may_clip:
                irregular |= _find_clipped(stored, part_starts, length)
            for i in np.flatnonzero(irregular):
                k, row = part.start + int(i), stored[part_starts[i] : part_starts[i] + length]
                used = np.isfinite(row)
                if may_clip:
                    rails[k] = np.sort(channel.scaled(find_rails(row)))
                used[: max(settling - int(starts[k]), 0)] = False
                columns, measured = table[:, used], channel.scaled(row[used])
                values = measured**2 if squared else _impute_clipped(measured, rails[k])
                sums[k], squares[k], counts[k] = columns @ values, values @ values, values.size
                clipped_counts[k] = np.sum((measured < rails[k, 0]) | (measured > rails[k, 1]))
                if not used.all():
                    geometry[k] = len(grams)
                    grams.append(_gram_moments(columns, offset[used]))
    return Projections(sums, np.array(grams), geometry, squares, counts, table_w, rails, clipped_counts)


def _impute_clipped(values: Array, rails: Array) -> Array:
    """Samples, shape (n,), with those beyond the ``rails``, shape (2,), replaced by their conditional mean.

    Mean and standard deviation of the normal distribution are those that exceed the rails as often as the samples do.
    A rail itself would be a poor substitute: it may be a tenth of the values beyond it.
    """
    from scipy.special import ndtri

    sides = values < rails[0], values > rails[1]
    if not (rails[0] < rails[1] and all(side.any() for side in sides)):
        return values
    fractions = np.array([side.mean() for side in sides])
    z = ndtri([fractions[0], 1.0 - fractions[1]])
    sd = (rails[1] - rails[0]) / (z[1] - z[0])
    mean, excess = rails[1] - sd * z[1], sd * np.exp(-0.5 * z * z) / (np.sqrt(2.0 * np.pi) * fractions)
    return np.select(sides, [mean - excess[0], mean + excess[1]], values)


def _gram_moments(table: Array, offset: Array) -> Array:
    """B'T^nB for n = 0, 1, 2, shape (3, m, m); ``table`` is B'."""
    return np.stack([table @ table.T, (table * offset) @ table.T, (table * offset * offset) @ table.T])


def sample_offsets(length: int, rate: float) -> Array:
    """Times of a block's samples from its middle, shape (length,) [s]."""
    return (np.arange(length, dtype=np.float64) - 0.5 * (length - 1)) / rate


def least_squares_coefficients(projections: Projections) -> Array:
    """Least-squares coefficients of every block, shape (blocks, m); of minimal norm where samples are missing."""
    out = np.empty_like(projections.sums)
    for g, gram in enumerate(projections.grams[:, 0]):
        mine = projections.geometry == g
        out[mine] = projections.sums[mine] @ np.linalg.pinv(gram, hermitian=True)
    return out


def residual_variance(projections: Projections) -> Array:
    """Variance of the samples about their block's least-squares fit, shape (blocks,); NaN without spare samples."""
    freedom = projections.counts - projections.sums.shape[1]
    rest = projections.squares - np.einsum("ij,ij->i", projections.sums, least_squares_coefficients(projections))
    return np.where(freedom > 0, np.maximum(rest, 0.0) / np.maximum(freedom, 1), np.nan)


def whiten_projections(
    sums: Array, grams: Array, geometry: Index, spectrum: NoiseSpectrum
) -> tuple[Array, Array, Array, Array]:
    """Whiten projections by their noise, so that their errors are independent and of the samples' variance.

    White noise of variance c gives the projections the covariance c G with the Gram matrix G. With its eigenvalues and
    eigenvectors, R = V diag(1/sqrt(lambda)) satisfies R'GR = 1; directions without samples are zero. Noise near a line
    that exceeds the white noise acts as random coefficients of the line, of variances E in a block: the covariance is
    c G + G E G. With the eigenvectors U and eigenvalues S of c + R'G E G R, W = S^-1/2 U'R' whitens it.

    Args:
        sums, grams, geometry: as in ``Projections``.
        spectrum: c and E relative to the variance of the samples.

    Returns:
        (W s, shape (blocks, m); W B'T^nB, shape (geometries, 3, m, m); W, shape (geometries, m, m); the matrix that
        gives the least-squares coefficients from W s, shape (geometries, m, m)).
    """
    values, vectors = np.linalg.eigh(grams[:, 0])
    valid = values > 1e-9 * np.maximum(values[:, -1:], 1.0)
    roots = vectors * np.where(valid, 1.0 / np.sqrt(np.where(valid, values, 1.0)), 0.0)[:, None, :]
    projected = np.sqrt(spectrum.excess)[:, None] * (grams[:, 0] @ roots)
    scales, turns = np.linalg.eigh(spectrum.white * np.eye(values.shape[1]) + np.swapaxes(projected, 1, 2) @ projected)
    turned = roots @ turns
    whiteners = np.swapaxes(turned / np.sqrt(scales)[:, None, :], 1, 2)
    out = np.empty_like(sums)
    for g, whitener in enumerate(whiteners):
        mine = geometry == g
        out[mine] = sums[mine] @ whitener.T
    solvers = np.ascontiguousarray(turned * np.sqrt(scales)[:, None, :])
    return out, whiteners[:, None] @ grams, whiteners, solvers


def _frequency_groups(omega: Array, max_range: float) -> Iterator[slice]:
    """Runs of blocks whose frequencies, shape (blocks, references), have a range of at most ``max_range`` [rad/s]."""
    edges = [*_group_starts(omega, max_range), len(omega)]
    yield from map(slice, edges[:-1], edges[1:])


@njit(cache=True)
def _group_starts(omega, max_range):  # type: ignore[no-untyped-def]
    """First block of each run of ``_frequency_groups``."""
    starts = [0]
    low, high = omega[0].copy(), omega[0].copy()
    for k in range(1, len(omega)):
        low, high = np.minimum(low, omega[k]), np.maximum(high, omega[k])
        if (high - low > max_range).any():
            starts.append(k)
            low, high = omega[k].copy(), omega[k].copy()
    return starts


def _chunks(starts: Index, length: int, group: slice) -> Iterator[slice]:
    """Parts of a group of blocks of about CHUNK_SAMPLES samples."""
    step = max(1, CHUNK_SAMPLES // length // BLOCKS_PER_PASS) * BLOCKS_PER_PASS
    for first in range(group.start, group.stop, step):
        yield slice(first, min(first + step, group.stop))


@njit(cache=True, nogil=True)
def _find_clipped(values, starts, length):  # type: ignore[no-untyped-def]
    """Blocks with a run of MIN_CLIPPED_RUN_SAMPLES equal samples at an extreme, shape (blocks,).

    Pairs half a minimum run apart are compared first: a run contains at least one such pair.
    """
    out, spacing = np.zeros(starts.size, np.bool_), MIN_CLIPPED_RUN_SAMPLES // 2
    for i in range(starts.size):
        row = values[starts[i] : starts[i] + length]
        known, low, high = False, row[0], row[0]
        for j in range(0, length - spacing, spacing):
            if row[j] != row[j + spacing]:
                continue
            first, stop = j, j + 1
            while first > 0 and row[first - 1] == row[j]:
                first -= 1
            while stop < length and row[stop] == row[j]:
                stop += 1
            if stop - first >= MIN_CLIPPED_RUN_SAMPLES:
                if not known:
                    known, low, high = True, row.min(), row.max()
                if row[j] == low or row[j] == high:
                    out[i] = True
                    break
    return out
