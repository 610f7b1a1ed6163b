"""The noise first: its spectrum from what the model leaves, and the whitening that every comparison goes through.

Coloured noise, hum and a wrong stated level are no missing physics. The spectrum is a running median over frequency
that leaves out the harmonics of motion and drive, where misfit stands, so that it follows the noise and not the misfit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct
from scipy.optimize import minimize_scalar

Array = NDArray[np.float64]

MEDIAN_OF_POWER = float(np.log(2.0))
"""Median of a periodogram's bin over its mean, for Gaussian noise (an exponential variable)."""


MEDIAN_SPREAD = 1.44
"""Relative standard deviation of a level from the median of n bins, times the root of n."""

LEAST_BINS = 14

SLOPE_SD = 0.3
"""Standard deviation of the power law that continues the spectrum below its first window."""

SLOWEST = 6
"""Half bins, from 0 Hz on, of which no noise is measured: wandering so slow is physics to judge."""

STEEPER = 0.6
"""By how much it may really rise more steeply: two medians of fourteen bins tell no better."""


@dataclass(frozen=True)
class Whitener:
    """Turns a residual into samples of unit variance, thinned to the band that is compared.

    Attributes:
        size: samples of the residual.
        weights: one over the noise's standard deviation in every half bin that is compared, shape (samples,).
        keep: which whitened samples are compared, shape (2 (m - 1),).
        guard: samples at the start and end of the residual that are not compared.
        psd: variance of every bin, shape (m,).
        first: the slowest bin whose noise was measured; below it the spectrum is continued. 0 where all was.
    """

    size: int
    weights: Array
    keep: NDArray[np.bool_]
    guard: tuple[int, int]
    psd: Array
    first: float = 0.0

    @property
    def samples(self) -> int:
        """Number of whitened samples, guards included."""
        return int(self.weights.size)

    @property
    def time(self) -> Array:
        """Position of every whitened sample as a fraction of the recording."""
        return (np.arange(self.samples) + 0.5) / self.samples

    def __call__(self, residual: Array) -> Array:
        """Whitened residual, shape (samples,).

        At both ends of what is compared it goes on as its mirror image (a cosine transform): taken round in a circle,
        red noise would end in a step, whose half derivative reaches far into the recording and passes for a drift.
        """
        first, last = self.guard
        seen = residual[first : residual.size - last]
        mirrored = np.concatenate([seen[:first][::-1], seen, seen[seen.size - last :][::-1]])
        return np.asarray(idct(dct(mirrored, norm="ortho")[: self.samples] * self.weights, norm="ortho"))

    def excused(self, residual: Array) -> float:
        """By how much -2 log likelihood falls if noise slower than was measured rises more steeply than was assumed.

        Args:
            residual: whitened, zero where it does not count, shape (samples,).
        """
        bins = 0.5 * np.arange(1, 2 * int(np.ceil(self.first)) - 1)
        reach = np.log(self.first / bins)
        power = dct(residual, norm="ortho")[1 : bins.size + 1] ** 2
        share = np.count_nonzero(residual) / residual.size

        def worse(slope: float) -> float:
            return float(power @ np.expm1(-slope * reach) + share * slope * reach.sum() + (slope / STEEPER) ** 2)

        return -min(0.0, minimize_scalar(worse, bounds=(0.0, 4.0), method="bounded").fun)


def whitener(psd: Array, size: int, guard: tuple[int, int], first: float = 0.0) -> Whitener:
    """The whitening for a noise of variance ``psd`` in the bins 0 ... m - 1 of a residual of ``size`` samples."""
    samples = 2 * (psd.size - 1)
    weights = np.sqrt(size) * np.exp(-0.5 * np.interp(0.5 * np.arange(samples), np.arange(psd.size), np.log(psd)))
    time = (np.arange(samples) + 0.5) / samples
    keep = (time >= guard[0] / size) & (time < 1.0 - guard[1] / size)
    return Whitener(size, weights, keep, guard, psd, first)


def flat_psd(data: Array, bins: int) -> Array:
    """White noise of the level that the upper third of a signal's spectrum shows, shape (bins,): a first guess."""
    power = periodogram(data)
    level = float(np.median(power[int(0.6 * power.size) : int(0.68 * power.size)]) / MEDIAN_OF_POWER)
    if level <= 0.0:
        level = 1e-12 * max(float(np.mean(power)), 1e-300)
    return np.full(bins, level)


def periodogram(residual: Array) -> Array:
    """Power of every bin, as the plain transform of as many samples of noise would have it: behind a Hann window."""
    window = np.hanning(residual.size)
    return np.abs(np.fft.rfft(residual * window)) ** 2 * (residual.size / np.sum(window**2))


def noise_psd(
    residual: Array, bins: int, step: float, lines: Sequence[float] | Array, width: float
) -> tuple[Array, float]:
    """Variance of every bin of a residual's transform that is noise.

    Args:
        residual: shape (n,).
        bins: number of bins wanted, from 0 Hz on.
        step: between samples [s].
        lines: frequencies at which motion or drive, not noise, may stand [Hz].
        width: to either side of a line [Hz].

    Returns:
        variances, shape (bins,), and the slowest bin that was measured.
    """
    power = periodogram(_without_slow(residual))
    frequency = np.arange(power.size) / (residual.size * step)
    spoilt = near_lines(frequency, lines, max(width, 3.0 / (residual.size * step)))
    spoilt[: SLOWEST // 2] = True  # their noise is continued from above
    good = np.flatnonzero(~spoilt)
    if good.size < 16:
        good = np.arange(1, power.size)
    return _running_median(good.astype(float), power[good], np.arange(bins, dtype=float))


def _without_slow(residual: Array) -> Array:
    """A residual without its slowest wandering: a strong one leaks through any window into what is measured."""
    cosines = dct(residual, norm="ortho")
    cosines[:SLOWEST] = 0.0
    return np.asarray(idct(cosines, norm="ortho"))


def near_lines(frequency: Array, lines: Sequence[float] | Array, width: float) -> NDArray[np.bool_]:
    """Which frequencies lie within ``width`` of a line, shape of ``frequency`` (increasing)."""
    marks = np.zeros(frequency.size + 1)
    for line in np.asarray(lines, float):
        low, high = np.searchsorted(frequency, [line - width, line + width])
        marks[low] += 1
        marks[high] -= 1
    return np.cumsum(marks[:-1]) > 0


def _running_median(position: Array, power: Array, wanted: Array) -> tuple[Array, float]:
    """Mean power from medians over windows that widen with frequency, at the wanted positions.

    Windows hold at least ``LEAST_BINS`` bins and a quarter of their frequency.
    Below the first window the spectrum goes on rising as it did between the first two: red noise taken for flat there
    would pass for a baseline that drifts.
    """
    edges = [0]
    while edges[-1] < power.size:
        edges.append(min(power.size, edges[-1] + max(LEAST_BINS, int(0.25 * edges[-1]))))
    if len(edges) > 2 and edges[-1] - edges[-2] < LEAST_BINS:
        edges.pop(-2)
    centres, levels = [], []
    for low, high in pairwise(edges):
        centres.append(np.mean(position[low:high]))
        # A level found too low makes every residual there too large, on average by its own relative variance; the
        # median of few bins is itself too high.
        doubt = 1.0 + (MEDIAN_SPREAD**2 - 0.72) / (high - low)
        levels.append(np.median(power[low:high]) / MEDIAN_OF_POWER * doubt)
    floor = max(max(levels) * 1e-14, 1e-300)
    heights = np.log(np.maximum(levels, floor))
    smooth = np.interp(wanted, centres, heights)
    if heights.size > 1:
        slope = np.clip((heights[0] - heights[1]) / np.log(centres[1] / centres[0]), 0.0, 2.0)
        below = wanted < centres[0]
        distance = np.log(centres[0] / np.maximum(wanted[below], 0.5))
        smooth[below] += slope * distance + 0.5 * (SLOPE_SD * distance) ** 2  # mean of a log-normal level
    return np.exp(smooth), float(centres[0])
