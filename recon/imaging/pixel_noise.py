"""The standard deviation of every pixel of a picture of means, from the scatter of the samples in it.

The variance of a sample is modelled as a + b · intensity, read noise and photon noise. Both are measured from pairs of
crossings of one pixel in different passes of the beam. The pixel is the same for both, so half of the squared
difference of their means is the variance of a mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from recon.imaging.gridding import find_sample_pixels
from recon.imaging.picture import Grid, Picture
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import AXES
from scanner.motion import Motion

MAX_NOISE_SAMPLES = 1 << 20
"""Samples from which the noise is measured: 10^5 pairs determine a variance to 0.5 %."""

MIN_PASS_SAMPLES = 8
"""Samples from one crossing of a pair to the other at least: neighbours within one pass share the noise of a slow
detector."""

LEVELS = 16
"""Levels of intensity at which the variance is compared with the model a + b · intensity."""


class SampleNoise(NamedTuple):
    """Variance of a sample: ``floor + slope * (intensity - dark)``, in the square of the intensity's unit.

    ``relative_sd`` is the standard error of that variance, relative to it.
    """

    floor: float
    slope: float
    dark: float
    relative_sd: float = 0.0

    def scaled(self, factor: float) -> SampleNoise:
        """The noise with a variance that is larger by a factor."""
        return self._replace(floor=factor * self.floor, slope=factor * self.slope)

    def variance(self, intensity: Array) -> Array:
        """Variance of a sample of the mean ``intensity``, of any shape."""
        return self.floor + self.slope * np.maximum(intensity - self.dark, 0.0)


class Crossings(NamedTuple):
    """Crossings of pixels by the beam, each of consecutive samples in one pixel, in the order of time.

    Attributes:
        pixel: that is crossed, shape (n,).
        mean: of the samples, shape (n,).
        size: number of samples, shape (n,).
        first: number of the first sample, shape (n,).
    """

    pixel: NDArray[np.integer[Any]]
    mean: Array
    size: NDArray[np.intp]
    first: NDArray[np.intp]

    def select(self, part: NDArray[Any]) -> Crossings:
        """Return those of the crossings that an index selects."""
        return Crossings(self.pixel[part], self.mean[part], self.size[part], self.first[part])


def find_crossings(pixel: NDArray[np.integer[Any]], intensity: Array) -> Crossings:
    """Return the crossings of a scan; arguments as for :func:`measure_sample_noise`, with at least one sample used."""
    used = np.flatnonzero((pixel >= 0) & np.isfinite(intensity))
    starts = np.flatnonzero(np.r_[True, (np.diff(pixel[used]) != 0) | (np.diff(used) != 1)])
    size = np.diff(np.r_[starts, used.size])
    return Crossings(pixel[used[starts]], np.add.reduceat(intensity[used], starts) / size, size, used[starts])


def measure_sample_noise(pixel: NDArray[np.integer[Any]], intensity: Array) -> SampleNoise | None:
    """Noise of a sample from pairs of crossings of one pixel; None without pairs.

    It is the variance that makes the mean of n samples vary by a n-th of it from crossing to crossing. What the samples
    of a crossing have in common, the noise of a slow detector and detail within the pixel, is thus a part of it.

    The variance found at a level of intensity counts by its standard error: the scatter of the squared differences in
    it, at least that of normal noise under a first fit. A standard error in proportion to the variance found itself
    would favour the levels where it is too small by chance. Detail within pixels is not a function of the level, so the
    fit is scaled to the mean of the variances found.

    Args:
        pixel: number of the pixel of each sample, negative outside the field, shape (n,).
        intensity: shape (n,); samples that are not finite are left out.
    """
    if not np.any((pixel >= 0) & np.isfinite(intensity)):
        return None
    crossings = find_crossings(pixel, intensity)
    order = np.argsort(crossings.pixel, kind="stable")
    one, two = crossings.select(order[:-1]), crossings.select(order[1:])
    paired = (one.pixel == two.pixel) & (two.first - one.first - one.size >= MIN_PASS_SAMPLES - 1)
    if paired.sum() < 2 * LEVELS:
        return None
    one, two = one.select(paired), two.select(paired)
    mean, variance = 0.5 * (one.mean + two.mean), (one.mean - two.mean) ** 2 / (1.0 / one.size + 1.0 / two.size)
    dark = float(mean.min())
    by_level = [part for part in np.array_split(np.argsort(mean), LEVELS) if part.size]
    level = np.array([mean[part].mean() - dark for part in by_level])
    found, scatter = np.array([(variance[part].mean(), variance[part].std()) for part in by_level]).T
    if not found.any():
        return SampleNoise(0.0, 0.0, dark)
    root = np.sqrt([part.size for part in by_level])
    floor, slope = _fit_line(level, found, 1.0 / root)
    normal_scatter = np.sqrt(2.0) * np.maximum(floor + slope * level, found.mean() * 1e-6)
    floor, slope = _fit_line(level, found, np.maximum(scatter, normal_scatter) / root)
    factor = float(variance.mean() / np.mean(floor + slope * (mean - dark)))
    relative_sd = float(variance.std() / (variance.mean() * np.sqrt(variance.size)))
    return SampleNoise(factor * floor, factor * slope, dark, relative_sd)


def _fit_line(level: Array, found: Array, sd: Array) -> tuple[float, float]:
    """Floor and slope, neither negative, of the variances ``found``; ``sd``: of these. All have the shape (n,)."""
    (floor, slope), _ = nnls(np.column_stack([np.ones_like(level), level]) / sd[:, None], found / sd)
    return float(floor), float(slope)


def measure_noise(
    beam: Motion, intensity: Channel, grid: Grid, samples: int = MAX_NOISE_SAMPLES, first: int = 0
) -> tuple[SampleNoise | None, ...]:
    """Noise of a sample of each detector; None where too few pixels were visited twice.

    Args:
        beam: motion whose angles are on the intensity's clock.
        intensity: shape (n,) or (n, detectors).
        grid: the pixels.
        samples: number of samples from ``first`` on that are used.
        first: first sample that is used.
    """
    stop = min(intensity.size, first + samples)
    x, y = (beam.axes[axis].angle.read(first, stop) for axis in AXES)
    pixel = find_sample_pixels(x, y, grid)
    values = intensity.read(first, stop).reshape(stop - first, -1)
    return tuple(measure_sample_noise(pixel, detector) for detector in values.T)


def pixel_sd(picture: Picture, noise: Sequence[SampleNoise | None]) -> NDArray[np.float32]:
    """Standard deviation of each pixel's mean, of the shape of the picture and in its unit.

    The photon noise is that of the expected level of the pixel: the mean of few photons is often 0 by chance. NaN where
    a pixel was never visited, and for a detector without a measured noise.

    Args:
        picture: of means.
        noise: of a sample, by detector.
    """
    means = picture.image.reshape(*picture.coverage.shape, -1)
    sd = np.full(means.shape, np.nan, np.float32)
    counts = picture.coverage.astype(np.float32)
    visited = counts > 0
    for detector, sample in enumerate(noise):
        if sample is not None:
            variance = sample.variance(_expected_levels(means[..., detector].astype(np.float64), counts, sample))
            np.sqrt(np.divide(variance, counts, where=visited, out=variance), where=visited, out=sd[..., detector])
    return sd.reshape(picture.image.shape)


def _expected_levels(means: Array, counts: NDArray[np.float32], noise: SampleNoise) -> Array:
    """Expected level of each pixel, given its mean and the distribution of all pixels, of the shape of ``means``.

    It is the best linear estimate: the mean of all samples, and the pixel's deviation from it in the ratio of the
    variance of the scene to that of scene and noise.

    Args:
        means: of the samples of each pixel, not finite where there is none. counts: of these samples.
    """
    known = (counts > 0) & np.isfinite(means)
    number = counts[known].astype(np.float64)
    if not number.size:
        return means
    level = float(np.average(means[known], weights=number))
    of_noise = float(noise.variance(np.array(level)))
    spread = float(np.sum(number * (means[known] - level) ** 2))
    of_scene = max(spread - (number.size - 1) * of_noise, 0.0) / float(number.sum())
    of_both = of_scene + of_noise / np.maximum(counts, 1.0)
    share = np.divide(of_scene, of_both, where=of_both > 0.0, out=np.ones_like(means))
    return np.asarray(np.where(known, level + share * (means - level), means))
