"""Single samples of a detector far from all others: electric pulses, cosmic rays, errors of a transfer."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.special import pdtrc

from recon.imaging.gridding import find_sample_pixels
from recon.imaging.picture import Grid
from scanner.arrays import Array
from scanner.channel import Channel, LazySamples
from scanner.device import AXES
from scanner.motion import Motion

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
    """Whether each sample is finite and within the limits, shape (n, detectors).

    Wild samples with a bright one beside them are left out too: a single one determines a standard deviation.

    Args:
        values, limits: as for :func:`find_wild_samples`.
    """
    columns = values.reshape(len(values), -1).astype(float)
    return np.isfinite(columns) & (columns >= limits.low) & (columns <= limits.high)


def without_wild_samples(intensity: Channel, beam: Motion, grid: Grid) -> Channel:
    """The intensity with NaN in the place of electric pulses, for what compares samples of one place.

    Left out is what lies beyond the limits and is no point of the scene, also beside a bright sample. It is the channel
    itself if the samples that are checked hold no wild one.

    Args:
        intensity: shape (n,) or (n, detectors).
        beam: motion whose angles are on the intensity's clock.
        grid: the pixels.
    """
    values = intensity.read(0, MAX_CHECKED_SAMPLES)
    limits = wild_limits(values)
    if not find_wild_in_place(values, limits, beam, grid).any():
        return intensity
    pulses = [np.empty((0, 2), np.int64)]
    for first in range(0, intensity.size, MAX_CHECKED_SAMPLES):
        values = intensity.read(first, first + MAX_CHECKED_SAMPLES).reshape(-1, limits.middle.size)
        far = np.isfinite(values) & ~usable_samples(values, limits)
        pulses.append(np.argwhere(far & ~_find_repeated_at(values, limits, beam, grid, first)) + np.array([first, 0]))
    row, column = np.concatenate(pulses).T

    def fetch(first: int, stop: int) -> Array:
        part = intensity.read(first, stop)
        low, high = np.searchsorted(row, [first, stop])
        part.reshape(len(part), -1)[row[low:high] - first, column[low:high]] = np.nan
        return part

    samples = LazySamples(intensity.shape, np.dtype(np.float64), fetch)
    return replace(intensity, raw=samples, first=0, stop=intensity.size, gain=1.0, offset=0.0)


def find_wild_in_place(values: Array, limits: WildLimits, beam: Motion, grid: Grid) -> NDArray[np.bool_]:
    """As :func:`find_wild_samples`, without points of the scene: samples near whose place others are far too.

    Args:
        values: the first samples of an intensity, shape (n,) or (n, detectors).
        limits: of the detectors.
        beam: motion whose angles are on the intensity's clock.
        grid: the pixels.
    """
    wild = find_wild_samples(values, limits)
    return wild & ~_find_repeated_at(values, limits, beam, grid, 0) if wild.any() else wild


def _find_repeated_at(values: Array, limits: WildLimits, beam: Motion, grid: Grid, first: int) -> NDArray[np.bool_]:
    """:func:`find_repeated` at the places of the samples from ``first`` on."""
    x, y = (beam.axes[axis].angle.read(first, first + len(values)) for axis in AXES)
    return find_repeated(values, limits, find_sample_pixels(x, y, grid), (grid.height, grid.width))


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
