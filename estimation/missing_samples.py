"""Missing samples of a position signal: short gaps are interpolated, and long ones are left out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scanner.arrays import Array, Index

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
    """A signal without missing samples.

    Attributes:
        values: interpolated in short gaps, on a straight line in long ones, shape (n,).
        filled: number of samples that were interpolated.
        left_out: long gaps, and short ones without enough samples around: increasing ranges (first, stop).
    """

    values: Array
    filled: int
    left_out: list[tuple[int, int]]


def fill_missing(values: Array, longest: int) -> Filled:
    """Fill the samples that are not finite.

    Args:
        values: shape (n,), at least one of them finite.
        longest: gap that is interpolated [samples]; 0 for none.
    """
    known = np.isfinite(values)
    if known.all():
        return Filled(values, 0, [])
    at = np.arange(values.size)
    usable = at[known]
    out = np.interp(at, usable, values[known])
    filled, left_out = 0, list[tuple[int, int]]()
    edges = np.flatnonzero(np.diff(np.concatenate([[True], known, [True]])))
    for first, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        around = _samples_around(usable, first, stop, MAX_SPAN_GAPS * max(longest, DEGREE))
        if around is None or stop - first > longest:
            left_out.append((first, stop))
            continue
        out[first:stop] = _polynomial(around, values[around], at[first:stop])
        filled += stop - first
    return Filled(out, filled, left_out)


def _samples_around(usable: Index, first: int, stop: int, reach: int) -> Index | None:
    """The samples by which a gap is interpolated; None if they span more than ``reach`` samples, or are too few."""
    at, side = int(np.searchsorted(usable, first)), max(stop - first, MIN_SIDE_SAMPLES)
    around = usable[max(at - side, 0) : at + side]
    if min(at, usable.size - at) < MIN_SIDE_SAMPLES or around[-1] - around[0] > reach:
        return None
    return around


def _polynomial(at: Index, values: Array, wanted: Index) -> Array:
    """The polynomial through values at some samples, by least squares, at the ``wanted`` ones."""
    middle, half = 0.5 * (at[0] + at[-1]), 0.5 * (at[-1] - at[0])
    basis = np.polynomial.legendre.legvander((at - middle) / half, DEGREE)
    coefficients = np.linalg.lstsq(basis, values, rcond=None)[0]
    return np.polynomial.legendre.legval((wanted - middle) / half, coefficients)
