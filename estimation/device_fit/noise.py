"""Noise spectrum of the residual, and the whitening of residuals.

Coloured noise, hum and a wrong stated noise level are not unmodelled effects. The spectrum is a running median over
frequency without the harmonics of motion and drive, where a misfit concentrates, so that it estimates the noise only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct

from scanner.arrays import Array

MEDIAN_TO_MEAN_POWER = float(np.log(2.0))
"""Median over mean of a bin of the periodogram of Gaussian noise, which has an exponential distribution."""

MEDIAN_RELATIVE_SPREAD = 1.44
"""Relative standard deviation of a noise level from the median of n bins, times the root of n: 1 / ln 2 for an
exponential distribution."""

MIN_BINS_PER_BAND = 14
"""Smallest number of bins in a band of the running median; it determines the noise level to 40 %."""

EXTRAPOLATION_SLOPE_SD = 0.3
"""Standard deviation of the power-law exponent with which the spectrum is extrapolated below its first band. It widens
the noise there by the mean of a log-normal level, so that slow noise is not reported as a drift."""

WIDE_EXCLUSION_BINS, NARROW_EXCLUSION_BINS = 3.0, 2.5
"""Bins on either side of a line that are excluded, and where these cover the whole compared band. The main lobe of the
window is two bins wide on either side."""

EXCLUDED_LOW_HALF_BINS = 6
"""Number of half bins, from 0 Hz on, in which no noise is measured: such slow variation may be an effect, a drift."""


@dataclass(frozen=True)
class Whitener:
    """Turns a residual into samples of unit variance, limited to the compared band.

    Attributes:
        size: samples of the residual.
        weights: one over the noise's standard deviation in every half bin that is compared, shape (samples,).
        keep: mask of the whitened samples that are compared, shape (2 (m - 1),).
        guard: samples at the start and end of the residual that are not compared.
        psd: variance of every bin, shape (m,).
        first: lowest bin whose noise was measured; the spectrum is extrapolated below it. 0 if all bins were measured.
        noisy_share: variance of every whitened sample of the noise, below 1 where a clipped signal has none, shape
            (samples,).
    """

    size: int
    weights: Array
    keep: NDArray[np.bool_]
    guard: tuple[int, int]
    psd: Array
    first: float
    noisy_share: Array

    @property
    def samples(self) -> int:
        """Number of whitened samples, including the guards."""
        return int(self.weights.size)

    @property
    def noise_variance(self) -> float:
        """Variance of the noise of a sample, with the level of the last bin in those above the compared band.

        It is an upper limit, because the spectrum below the lowest measured bin is.
        """
        beyond = max(self.size // 2 - self.psd.size, 0)
        return float(np.sum(self.psd) + beyond * self.psd[-1]) * 2.0 / self.size**2

    @property
    def measured_noise_variance(self) -> float:
        """The same with the level of the lowest measured bin below it."""
        lowest = int(np.ceil(self.first))
        extrapolated = float(np.sum(self.psd[:lowest])) - lowest * float(self.psd[lowest])
        return self.noise_variance - extrapolated * 2.0 / self.size**2

    @property
    def time(self) -> Array:
        """Position of every whitened sample as a fraction of the recording."""
        return sample_times(self.samples)

    def __call__(self, residual: Array) -> Array:
        """Whitened residual, shape (samples,).

        The compared part is continued by its mirror image at both ends (a cosine transform). A periodic continuation
        would create a step for red noise, whose whitened form extends far into the recording and resembles a drift.
        """
        first, last = self.guard
        inside = residual[first : residual.size - last]
        mirrored = np.concatenate([inside[:first][::-1], inside, inside[inside.size - last :][::-1]])
        return np.asarray(idct(dct(mirrored, norm="ortho")[: self.samples] * self.weights, norm="ortho"))


def sample_times(samples: int) -> Array:
    """Middle of every sample of a channel as a fraction of the recording, shape (samples,)."""
    return (np.arange(samples) + 0.5) / samples


def make_whitener(
    psd: Array, size: int, guard: tuple[int, int], first: float = 0.0, noisy_share: Array | None = None
) -> Whitener:
    """Whitener for noise of variance ``psd``, shape (m,), in the bins of a residual of ``size`` samples.

    Args:
        noisy_share: of every sample of the residual that contains noise, shape (size,); None for all of it.
    """
    samples = 2 * (psd.size - 1)
    weights = np.sqrt(size) * np.exp(-0.5 * np.interp(0.5 * np.arange(samples), np.arange(psd.size), np.log(psd)))
    time = sample_times(samples)
    keep = (time >= guard[0] / size) & (time < 1.0 - guard[1] / size)
    share = np.ones(samples) if noisy_share is None else np.interp(time, sample_times(size), noisy_share)
    return Whitener(size, weights, keep, guard, psd, first, share)


def flat_psd(data: Array, bins: int) -> Array:
    """Flat noise spectrum with the level of a band at 60 to 68 % of a signal's bandwidth, shape (bins,)."""
    power = periodogram(data)
    level = float(np.median(power[int(0.6 * power.size) : int(0.68 * power.size)]) / MEDIAN_TO_MEAN_POWER)
    if level <= 0.0:
        level = 1e-12 * max(float(np.mean(power)), 1e-300)
    return np.full(bins, level)


def periodogram(residual: Array) -> Array:
    """Hann-windowed power of every bin, scaled so that white noise of variance 1 has ``residual.size`` in each."""
    window = _hann(residual.size)
    return np.abs(np.fft.rfft(residual * window)) ** 2 * (residual.size / np.sum(window**2))


@lru_cache(maxsize=4)
def _hann(samples: int) -> Array:
    """Hann window; it takes as long as the transform, and the channels of a recording have few lengths."""
    return np.hanning(samples)


def noise_psd(
    residual: Array,
    bins: int,
    step: float,
    lines: Sequence[float] | Array,
    width: float,
    noisy_share: Array | None = None,
) -> tuple[Array, float]:
    """Variance of the noise in every bin of the Fourier transform of a residual.

    Args:
        residual: shape (n,).
        bins: number of bins of the result, from 0 Hz on.
        step: between samples [s].
        lines: frequencies of motion and drive, which are excluded [Hz].
        width: excluded on either side of a line [Hz].
        noisy_share: of every sample that contains noise, shape (n,); None for all of it.

    Returns:
        variances of noise in all samples, shape (bins,), and the lowest bin that was measured.
    """
    power = periodogram(_remove_slow_variation(residual))
    bin_width = 1.0 / (residual.size * step)
    frequency = np.arange(power.size, dtype=np.float64) * bin_width
    usable = _bins_off_lines(frequency, lines, max(width, WIDE_EXCLUSION_BINS * bin_width))
    if not np.any(usable < bins):  # the lines of a multisine over few periods
        usable = _bins_off_lines(frequency, lines, NARROW_EXCLUSION_BINS * bin_width)
    if usable.size < 16:
        usable = np.arange(1, power.size)
    if noisy_share is not None:
        power /= max(np.average(noisy_share, weights=_hann(residual.size) ** 2), 1.0 / residual.size)
    psd, first = _running_median(usable.astype(float), power[usable], np.arange(bins, dtype=float))
    return psd, min(first, bins - 1.0)


def _bins_off_lines(frequency: Array, lines: Sequence[float] | Array, width: float) -> NDArray[np.intp]:
    """Bins in which noise is measured: farther than ``width`` from all lines and above the lowest ones, whose noise is
    extrapolated."""
    excluded = near_lines(frequency, lines, width)
    excluded[: EXCLUDED_LOW_HALF_BINS // 2] = True
    return np.flatnonzero(~excluded)


def _remove_slow_variation(residual: Array) -> Array:
    """A residual without its slowest variation, which would leak through the window into the measured bins."""
    cosines = dct(residual, norm="ortho")
    cosines[:EXCLUDED_LOW_HALF_BINS] = 0.0
    return np.asarray(idct(cosines, norm="ortho"))


def near_lines(frequency: Array, lines: Sequence[float] | Array, width: float) -> NDArray[np.bool_]:
    """Which frequencies lie within ``width`` of a line, shape of ``frequency`` (increasing)."""
    marks = np.zeros(frequency.size + 1)
    for line in np.asarray(lines, float):
        low, high = np.searchsorted(frequency, [line - width, line + width])
        marks[low] += 1
        marks[high] -= 1
    return np.cumsum(marks[:-1]) > 0


def _running_median(position: Array, power: Array, targets: Array) -> tuple[Array, float]:
    """Mean power at the target positions, from medians over bands whose width grows with frequency.

    Bands contain at least ``MIN_BINS_PER_BAND`` bins and span at least a quarter of their frequency.

    Below the first band the spectrum is extrapolated with the slope between the first two. If red noise were assumed
    flat there, it would be reported as a drift of the baseline.
    """
    edges = [0]
    while edges[-1] < power.size:
        edges.append(min(power.size, edges[-1] + max(MIN_BINS_PER_BAND, int(0.25 * edges[-1]))))
    if len(edges) > 2 and edges[-1] - edges[-2] < MIN_BINS_PER_BAND:
        edges.pop(-2)
    centres, levels = [], []
    for low, high in pairwise(edges):
        centres.append(np.mean(position[low:high]))
        # Two biases: the inverse of a noisy level is too large by its relative variance; the median of few bins is
        # too high.
        bias_correction = 1.0 + (MEDIAN_RELATIVE_SPREAD**2 - 0.72) / (high - low)
        levels.append(np.median(power[low:high]) / MEDIAN_TO_MEAN_POWER * bias_correction)
    floor = max(max(levels) * 1e-14, 1e-300)
    log_levels = np.log(np.maximum(levels, floor))
    smooth = np.interp(targets, centres, log_levels)
    if log_levels.size > 1:
        slope = np.clip((log_levels[0] - log_levels[1]) / np.log(centres[1] / centres[0]), 0.0, 2.0)
        below = targets < centres[0]
        distance = np.log(centres[0] / np.maximum(targets[below], 0.5))
        smooth[below] += slope * distance + 0.5 * (EXTRAPOLATION_SLOPE_SD * distance) ** 2  # mean of a log-normal level
    return np.exp(smooth), float(centres[0])
