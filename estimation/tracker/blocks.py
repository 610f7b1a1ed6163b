"""Block demodulation: the information of thousands of samples brought together, in one pass and flat memory.

A block's samples are projected on a constant and on cosine and sine of every harmonic that can be there. The harmonics
of two axes are not orthogonal over a block, so what is kept is the projection s = B'y and the Gram matrix G = B'B, of
which whatever is linear in the harmonics loses nothing. One table of B serves all blocks as long as the reference's
frequency stays, which makes the projection one matrix product, taken from the samples as they are stored; a block with
missing samples gets a Gram matrix of its own from the samples that are left. What samples beyond a converter's rails
tell depends on the track (``censored``); until there is one, the mean of what may lie beyond stands for them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scanner.channel import Channel
from scanner.demodulate import ROWS, block_products, plain

Array = NDArray[np.float64]
Index = NDArray[np.int64]

CHUNK = 1 << 18  # samples read at a time
CLIPPED_RUN = 8  # equal samples in a row at a block's extreme: noise would not let them be equal
TABLE_REACH = 0.03  # cycles that the highest harmonic may slip against its table over a block


@dataclass(frozen=True)
class Projections:
    """Blocks of one channel, projected. m = 1 + 2 lines: constant, then cosine and sine of each line.

    Attributes:
        sums: B'y, shape (blocks, m).
        grams: B'T^nB for n = 0, 1, 2, T the samples' times from the block's middle [s], shape (geometries, 3, m, m):
            what a line, its rate and its rate's rate give. geometry: which of them is a block's, shape (blocks,).
        squares: y'y, shape (blocks,). counts: samples used, shape (blocks,).
        tuned: angular frequency that the table of each block is made for, shape (blocks, references) [rad/s].
        rails: between which samples were measured, infinite for none, shape (blocks, 2). beyond: how many were not.
    """

    sums: Array
    grams: Array
    geometry: Index
    squares: Array
    counts: Index
    tuned: Array
    rails: Array
    beyond: Index


def basis(length: int, rate: float, lines: Index, tuned: Array) -> Array:
    """B' of one block about its middle, shape (1 + 2 lines, length).

    Args:
        lines: (reference, order) of each line, shape (lines, 2). tuned: of each reference [rad/s].
    """
    turn = np.exp(1j * np.outer(tuned, offsets(length, rate)))
    powers = np.cumprod(np.broadcast_to(turn, (lines[:, 1].max(initial=1), *turn.shape)), axis=0)
    turned = powers[lines[:, 1] - 1, lines[:, 0]]
    rows = np.stack([turned.real, turned.imag], axis=1).reshape(-1, length)
    return np.concatenate([np.ones((1, length)), rows])


def project(
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
        starts: first sample of each block, increasing, shape (blocks,). length: of every block.
        lines: as in ``basis``. omega: angular frequency of each reference in each block, shape (blocks, references).
        settling: samples at the channel's beginning that are left out.
        squared: the samples' squares are projected.
        may_clip: runs of equal samples at a block's extremes are a converter's rails, and the signal was beyond them.
            A drive's flat tops are what the mirror feels.
    """
    blocks, m = starts.size, 1 + 2 * len(lines)
    sums, squares, tuned = np.zeros((blocks, m)), np.zeros(blocks), np.empty_like(omega)
    geometry, counts, beyond = np.zeros(blocks, np.int64), np.full(blocks, length), np.zeros(blocks, np.int64)
    rails = np.tile([-np.inf, np.inf], (blocks, 1))
    grams: list[Array] = []
    offset = offsets(length, channel.sample_rate)
    by_parity = np.r_[0, 1:m:2, 2:m:2]  # a constant and cosines are even about the block's middle, sines odd
    highest = np.array([max(lines[lines[:, 0] == i, 1], default=1) for i in range(omega.shape[1])])
    for group in _steady_groups(omega * highest, 2 * np.pi * TABLE_REACH * channel.sample_rate / length):
        tuned[group] = 0.5 * (omega[group].min(axis=0) + omega[group].max(axis=0))
        table = basis(length, channel.sample_rate, lines, tuned[group.start])
        whole = len(grams)
        grams.append(_moments(table, offset))
        folded = table[by_parity]
        for part in _chunks(starts, length, group):
            first = int(starts[part.start])
            stored = plain(channel.stored(first, int(starts[part.stop - 1]) + length))
            own_starts = starts[part] - first
            products, squares[part] = block_products(
                stored, own_starts, folded, 1 + len(lines), channel.gain, channel.offset, squared
            )
            sums[part.start : part.stop, by_parity] = products
            geometry[part] = whole
            odd = ~np.isfinite(squares[part]) | (starts[part] < settling)
            if may_clip:
                odd |= _clipped(stored, own_starts, length)
            for i in np.flatnonzero(odd):
                k, row = part.start + int(i), stored[own_starts[i] : own_starts[i] + length]
                used = np.isfinite(row)
                if may_clip:
                    rails[k] = np.sort(channel.scaled(_rails(row)))
                used[: max(settling - int(starts[k]), 0)] = False
                own, measured = table[:, used], channel.scaled(row[used])
                left = measured**2 if squared else _filled(measured, rails[k])
                sums[k], squares[k], counts[k] = own @ left, left @ left, left.size
                beyond[k] = np.sum((measured < rails[k, 0]) | (measured > rails[k, 1]))
                if not used.all():
                    geometry[k] = len(grams)
                    grams.append(_moments(own, offset[used]))
    return Projections(sums, np.array(grams), geometry, squares, counts, tuned, rails, beyond)


def _filled(values: Array, rails: Array) -> Array:
    """Samples with the mean of what a normal signal has beyond two rails in place of what lies there, shape (n,).

    That signal leaves the rails, (2,), as often as the samples do: a rail's own value may be a tenth of what is beyond.
    """
    from scipy.special import ndtri

    sides = values < rails[0], values > rails[1]
    if not (rails[0] < rails[1] and all(side.any() for side in sides)):
        return values
    shares = np.array([side.mean() for side in sides])
    z = ndtri([shares[0], 1.0 - shares[1]])
    sd = (rails[1] - rails[0]) / (z[1] - z[0])
    middle, reach = rails[1] - sd * z[1], sd * np.exp(-0.5 * z * z) / (np.sqrt(2.0 * np.pi) * shares)
    return np.select(sides, [middle - reach[0], middle + reach[1]], values)


def _moments(table: Array, offset: Array) -> Array:
    return np.stack([table @ table.T, (table * offset) @ table.T, (table * offset * offset) @ table.T])


def offsets(length: int, rate: float) -> Array:
    """Times of a block's samples from its middle [s]."""
    return (np.arange(length, dtype=np.float64) - 0.5 * (length - 1)) / rate


def solved(projections: Projections) -> Array:
    """Least-squares coefficients of every block, shape (blocks, m); of the smallest norm where samples are missing."""
    out = np.empty_like(projections.sums)
    for g, gram in enumerate(projections.grams[:, 0]):
        mine = projections.geometry == g
        out[mine] = projections.sums[mine] @ np.linalg.pinv(gram, hermitian=True)
    return out


def residual_variance(projections: Projections) -> Array:
    """Variance of the samples about their block's least-squares fit, shape (blocks,); NaN where too few are left."""
    freedom = projections.counts - projections.sums.shape[1]
    rest = projections.squares - np.einsum("ij,ij->i", projections.sums, solved(projections))
    return np.where(freedom > 0, np.maximum(rest, 0.0) / np.maximum(freedom, 1), np.nan)


def _steady_groups(omega: Array, reach: float) -> Iterator[slice]:
    """Runs of blocks whose frequencies stay within ``reach`` of each other."""
    edges = [*_group_starts(omega, reach), len(omega)]
    yield from map(slice, edges[:-1], edges[1:])


@njit(cache=True)
def _group_starts(omega, reach):  # type: ignore[no-untyped-def]
    starts = [0]
    low, high = omega[0].copy(), omega[0].copy()
    for k in range(1, len(omega)):
        low, high = np.minimum(low, omega[k]), np.maximum(high, omega[k])
        if (high - low > reach).any():
            starts.append(k)
            low, high = omega[k].copy(), omega[k].copy()
    return starts


def _chunks(starts: Index, length: int, group: slice) -> Iterator[slice]:
    step = max(1, CHUNK // length // ROWS) * ROWS
    for first in range(group.start, group.stop, step):
        yield slice(first, min(first + step, group.stop))


@njit(cache=True, nogil=True)
def _clipped(values, starts, length):  # type: ignore[no-untyped-def]
    """Blocks in which equal samples in a row lie at an extreme, shape (blocks,): such a run covers a pair looked at."""
    out, apart = np.zeros(starts.size, np.bool_), CLIPPED_RUN // 2
    for i in range(starts.size):
        row = values[starts[i] : starts[i] + length]
        known, low, high = False, row[0], row[0]
        for j in range(0, length - apart, apart):
            if row[j] != row[j + apart]:
                continue
            first, stop = j, j + 1
            while first > 0 and row[first - 1] == row[j]:
                first -= 1
            while stop < length and row[stop] == row[j]:
                stop += 1
            if stop - first >= CLIPPED_RUN:
                if not known:
                    known, low, high = True, row.min(), row.max()
                if row[j] == low or row[j] == high:
                    out[i] = True
                    break
    return out


@njit(cache=True)
def _rails(row):  # type: ignore[no-untyped-def]
    """Values (2,) between which samples were measured, infinite where no run of equal ones lies at that extreme.

    A rail is taken half way to the value nearest to it: with few bits the extreme is itself measured by as much, and a
    comparator's two values have its threshold between them.
    """
    out, known = np.array([-np.inf, np.inf]), row[np.isfinite(row)]
    if known.size == 0 or known.min() == known.max():
        return out
    for i, extreme in ((0, known.min()), (1, known.max())):
        run, longest = 0, 0
        for j in range(row.size):
            run = run + 1 if row[j] == extreme else 0
            longest = max(longest, run)
        if longest >= CLIPPED_RUN:
            rest = known[known != extreme]
            out[i] = 0.5 * (float(extreme) + float(rest.min() if i == 0 else rest.max()))
    return out
