"""Missing samples of a position signal: short gaps are interpolated, and long ones are left out."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from scanner.arrays import Array, Index
from scanner.channel import READ_CHUNK_SAMPLES, Channel

MAX_FILLED_GAP_PERIODS = 1.0 / 16.0
"""Length of a gap over the period of the motion up to which it is interpolated: the polynomial is then off by less than
5e-5 of a sine's amplitude, 0.01 of 400 pixels."""

DEGREE = 5
"""Degree of the polynomial that interpolates a gap. It is fitted to as many samples on either side as are missing, and
at least to the three that determine it. The noise of an interpolated sample is 1.2 times that of a measured one for
single samples, twice for three, and less than that of a measured one from seven on."""

MIN_SIDE_SAMPLES = (DEGREE + 1) // 2
"""Known samples on either side that determine the polynomial."""

MAX_SPAN_GAPS = 3
"""Span of the samples of a polynomial over the longest gap that is interpolated, or over ``DEGREE`` samples if that is
shorter: other gaps nearby do not make it wider than the longest gap alone would."""


class Filled(NamedTuple):
    """What stands in the place of missing samples.

    Attributes:
        at: numbers of the missing samples, increasing, shape (m,).
        values: interpolated in short gaps, on a straight line in long ones, shape (m,).
        filled: number of samples that were interpolated.
        left_out: long gaps, and short ones without enough samples around: increasing ranges (first, stop).
    """

    at: Index
    values: Array
    filled: int
    left_out: list[tuple[int, int]]


def fill_missing(channel: Channel, longest: int) -> Filled:
    """Fill the samples that are not finite.

    Args:
        channel: of shape (n,), at least one sample of it finite.
        longest: gap that is interpolated [samples]; 0 for none.
    """
    pieces = (
        (first, channel.stored(first, first + READ_CHUNK_SAMPLES))
        for first in range(0, channel.size, READ_CHUNK_SAMPLES)
    )
    missing = np.concatenate([first + np.flatnonzero(~np.isfinite(piece)) for first, piece in pieces])
    if not missing.size:
        return Filled(missing, np.zeros(0), 0, [])
    values = channel.read()
    usable = np.delete(np.arange(values.size), missing)
    values[missing] = np.interp(missing, usable, values[usable])
    filled, left_out = 0, list[tuple[int, int]]()
    for gap in np.split(missing, 1 + np.flatnonzero(np.diff(missing) > 1)):
        first, stop = int(gap[0]), int(gap[-1]) + 1
        reach = MAX_SPAN_GAPS * max(longest, DEGREE)
        around = None if stop - first > longest else _samples_around(usable, first, stop, reach)
        if around is None:
            left_out.append((first, stop))
            continue
        values[first:stop] = _weights(tuple((around - first).tolist()), stop - first) @ values[around]
        filled += stop - first
    return Filled(missing, values[missing], filled, left_out)


def _samples_around(usable: Index, first: int, stop: int, reach: int) -> Index | None:
    """The samples by which a gap is interpolated; None if they span more than ``reach`` samples, or are too few."""
    at, side = int(np.searchsorted(usable, first)), max(stop - first, MIN_SIDE_SAMPLES)
    around = usable[max(at - side, 0) : at + side]
    if min(at, usable.size - at) < MIN_SIDE_SAMPLES or around[-1] - around[0] > reach:
        return None
    return around


@lru_cache(maxsize=1024)
def _weights(around: tuple[int, ...], gap: int) -> Array:
    """Weights of known samples in the polynomial through them, by least squares, at each missing sample of a gap.

    Most gaps of a recording are alike, so that the weights are kept.

    Args:
        around: numbers of the known samples, counted from the first missing one.
        gap: number of missing samples.

    Returns:
        shape (gap, known samples).
    """
    at = np.array(around, float)
    middle, half = 0.5 * (at[0] + at[-1]), 0.5 * (at[-1] - at[0])
    known, wanted = (
        np.polynomial.legendre.legvander((each - middle) / half, DEGREE) for each in (at, np.arange(gap, dtype=float))
    )
    return np.asarray(wanted @ np.linalg.pinv(known), np.float64)
