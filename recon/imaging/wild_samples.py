"""Single samples of a detector far from all others: electric pulses, cosmic rays, errors of a transfer."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.special import pdtrc

from scanner.arrays import Array

MAX_CHECKED_SAMPLES = 1_000_000
"""Samples from the start of the intensity that are checked: 0.2 s at 5 MS/s. Sorting takes 0.1 s."""

TAIL_QUANTILE = 0.01
"""Share of the samples beyond the tail that scales the limit: fewer wild samples leave it unchanged."""

LIMIT_IN_TAILS = 10.0
"""Distance of a wild sample from the median, over that of the tail. An exponential distribution of intensities exceeds
it with a probability of 1e-17."""

NEARBY_PX = 5
"""Side of the square around a sample in which further ones of the same bright point are expected, odd [px]. A point
whose spot has a standard deviation of 1 pixel has a seventh of its peak at 2 pixels from it."""

MAX_CHANCE = 0.01
"""Probability that as many far samples as a place shows meet there by chance, up to which they are a point of the
scene: so many of the electric pulses, at most, count as points."""


class WildLimits(NamedTuple):
    """Median, and the values below and above which a single sample is wild; each of shape (detectors,)."""

    middle: Array
    low: Array
    high: Array


def wild_limits(values: Array) -> WildLimits:
    """The limits from samples of shape (n,) or (n, detectors).

    A scene with bright points has samples beyond them, too. Points are as wide as the beam's spot and mostly crossed in
    several samples, so that there is no limit where most of the samples beyond it have others beside them.
    """
    columns = values.reshape(len(values), -1).astype(float)
    columns = np.where(np.isfinite(columns), columns, np.nan)
    columns[:, np.isnan(columns).all(axis=0)] = 0.0
    low, middle, high = np.nanquantile(columns, [TAIL_QUANTILE, 0.5, 1.0 - TAIL_QUANTILE], axis=0)
    sides = []
    for sign, tail in ((-1.0, middle - low), (1.0, high - middle)):
        distance = LIMIT_IN_TAILS * np.where(tail > 0.0, tail, np.inf)
        far, alone = _find_far(sign * (columns - middle), distance)
        is_scene = alone.sum(axis=0) < 0.5 * far.sum(axis=0)
        sides.append(middle + sign * np.where(is_scene, np.inf, distance))
    return WildLimits(middle, *sides)


def usable_samples(values: Array, limits: WildLimits) -> NDArray[np.bool_]:
    """Whether each sample is finite and not wild, shape (n, detectors); arguments as :func:`find_wild_samples`."""
    return np.isfinite(values).reshape(len(values), -1) & ~find_wild_samples(values, limits)


def find_wild_samples(values: Array, limits: WildLimits) -> NDArray[np.bool_]:
    """Whether each sample is far from the median and the samples beside it are not, shape (n, detectors).

    Args:
        values: shape (n,) or (n, detectors).
        limits: of the detectors.
    """
    columns = values.reshape(len(values), -1).astype(float)
    below, above = (
        _find_far(sign * (columns - limits.middle), sign * (limit - limits.middle))[1]
        for sign, limit in ((-1.0, limits.low), (1.0, limits.high))
    )
    return (below | above) & np.isfinite(columns)


def find_repeated(
    values: Array, limits: WildLimits, pixel: NDArray[np.int32], shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """Whether more samples near the place of each are far from the median than chance brings there, (n, detectors).

    Electric pulses come at any time, and thus at any place. A bright point smaller than the step of the beam between
    two samples is far in single samples, too, but in several passes of the beam over the same pixels.

    Args:
        values, limits: as for :func:`find_wild_samples`.
        pixel: number of the pixel of each sample, row by row, negative outside the field, shape (n,).
        shape: height and width of the picture.
    """
    columns = values.reshape(len(values), -1).astype(float)
    inside = pixel >= 0
    repeated = np.zeros(columns.shape, bool)
    number = _count_nearby(pixel[inside], shape)[pixel[inside]] - 1.0
    for column, low, high, out in zip(columns.T, limits.low, limits.high, repeated.T, strict=True):
        far = (column < low) | (column > high)
        others = _count_nearby(pixel[inside & far], shape)[pixel[inside]] - far[inside]
        chance = np.where(others > 0.0, pdtrc(others - 1.0, number * far.mean()), 1.0)
        out[inside] = chance < MAX_CHANCE
    return repeated


def _count_nearby(pixel: NDArray[np.int32], shape: tuple[int, int]) -> Array:
    """Number of samples within the square of ``NEARBY_PX`` around each pixel, shape (height * width,)."""
    counts = np.bincount(pixel, minlength=shape[0] * shape[1]).reshape(shape).astype(float)
    return np.asarray(np.rint(NEARBY_PX**2 * uniform_filter(counts, NEARBY_PX, mode="constant"))).ravel()


def _find_far(distance: Array, limit: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether samples lie beyond a limit, and whether they do while those beside them are not even in the tail.

    Args:
        distance: of each sample from the median, shape (n, detectors).
        limit: shape (detectors,).
    """
    far, in_tail = distance > limit, distance > limit / LIMIT_IN_TAILS
    beside = np.zeros_like(far)
    beside[1:] |= in_tail[:-1]
    beside[:-1] |= in_tail[1:]
    return far, far & ~beside
