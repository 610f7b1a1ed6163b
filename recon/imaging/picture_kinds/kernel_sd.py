"""The variance of a kernel-weighted picture: weighted noise, and the detail that the kernel removes.

The variance of the detail is taken as proportional to the square of the picture's slope nearby. A pixel's own samples
have the share a in its value and reduce it by (1 - a)^2: without them, the picture would be 1 / (1 - a) times as far
from their mean. Two measurements give the factor:

1. The means of all visited pixels less the picture, whose noise is known. They are many, but the neighbours of a
   visited pixel were visited in the same pass, and share with it what the samples of a pass have in common.
2. The means of the held-out samples less the picture without them, in pixels that no other sample visited. They are
   few, but lie as far from the other samples as unvisited pixels do.

The first gives the factor of visited pixels. That of the others is the mean of both by a model of random effects: what
they differ by beyond their errors is an error of the first for unvisited pixels.

Source: Mallows 1973, "Some comments on C_p"; DerSimonian & Laird 1986, "Meta-analysis in clinical trials".
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from recon.imaging.picture_kinds.held_out import (
    SplitSums,
    error_variance_ratio,
    pixel_means,
    positive_mean,
    representative_weights,
)
from recon.imaging.picture_kinds.scene_covariance import measure_covariance
from recon.imaging.picture_kinds.stationary_prior import fit_spectrum, relate_to_centres
from recon.imaging.pixel_noise import SampleNoise
from recon.imaging.smoothing import REACH, kernel_mean, smooth
from scanner.arrays import Array

MIN_WEIGHT = 1e-6
"""Weight, relative to that of a sample at the pixel itself, below which a pixel has no value."""

GLOBAL_FRACTION = 0.2
"""Fraction of the mean squared slope that is added everywhere: a flat part may hold detail that the kernel removed."""


class KernelMean(NamedTuple):
    """Kernel-weighted mean of samples, by pixel.

    Attributes:
        image: shape (height, width).
        noise: variance of ``image`` by the noise of the samples, infinite where the kernel reaches none.
        share: weight of the pixel's own samples.
    """

    image: Array
    noise: Array
    share: Array


def weigh_samples(sums: Array, counts: Array, noise: SampleNoise, width: float) -> KernelMean:
    """Return the kernel-weighted mean of samples.

    Args:
        sums, counts: of the samples by pixel, shape (height, width).
        noise: of a sample.
        width: of the kernel [px].
    """
    image = kernel_mean(sums, counts, width)
    centre, weight, squares = _weights(counts, width)
    reached = weight > MIN_WEIGHT * centre
    variance = np.divide(noise.variance(image) * squares, weight**2, out=np.full(image.shape, np.inf), where=reached)
    share = np.divide(counts * centre, weight, out=np.zeros(image.shape), where=reached)
    return KernelMean(image, variance, share)


def detail_variance(samples: SplitSums, noise: SampleNoise, width: float, full: KernelMean) -> Array:
    """Return the variance of the detail that the kernel removes, shape (height, width).

    Args:
        samples: of one detector by pixel.
        noise: of a sample.
        width: of the kernel [px].
        full: picture of all samples.
    """
    removed = _removed_energy(full, width)
    of_visited, of_gaps = _scale_of_visited(samples, noise, full, removed), _scale_of_gaps(samples, noise, width)
    of_unvisited = _combine(of_gaps, of_visited) if of_gaps else of_visited
    scale = np.where(samples.counts > 0, positive_mean(*of_visited), positive_mean(*of_unvisited))
    spectrum = fit_spectrum(measure_covariance(samples.sums, samples.counts))
    passed = [np.exp(-0.5 * (np.pi * width * np.arange(size) / size) ** 2) for size in full.image.shape]
    at_centres = relate_to_centres(spectrum * (1.0 - np.outer(*passed)) ** 2).variance
    return at_centres * scale * removed


def _scale_of_visited(samples: SplitSums, noise: SampleNoise, full: KernelMean, removed: Array) -> tuple[float, float]:
    """Removed detail relative to ``removed`` by the residuals of all visited pixels, and its standard deviation."""
    visited = samples.counts > 0
    residual = (pixel_means(samples.sums, samples.counts) - full.image)[visited]
    own = (noise.variance(full.image)[visited] * (1.0 - 2.0 * full.share[visited])) / samples.counts[visited]
    return _measure_scale(residual, own + full.noise[visited], removed[visited], np.ones(residual.size), noise)


def _scale_of_gaps(samples: SplitSums, noise: SampleNoise, width: float) -> tuple[float, float] | None:
    """The same by the held-out samples in pixels without others; None without such pixels."""
    kept = weigh_samples(samples.kept_sums, samples.kept_counts, noise, width)
    held = (samples.held_counts > 0) & (samples.kept_counts == 0) & np.isfinite(kept.noise)
    if not held.any():
        return None
    residual = (pixel_means(samples.held_sums, samples.held_counts) - kept.image)[held]
    of_residual = noise.variance(kept.image[held]) / samples.held_counts[held] + kept.noise[held]
    weight = representative_weights(samples)[held]
    return _measure_scale(residual, of_residual, _removed_energy(kept, width)[held], weight, noise)


def _measure_scale(
    residual: Array, of_residual: Array, removed: Array, weight: Array, noise: SampleNoise
) -> tuple[float, float]:
    """Excess of squared residuals over their noise as a multiple of ``removed``, and its standard deviation."""
    found, sd = error_variance_ratio(residual, of_residual, removed, weight)
    return found, float(np.hypot(sd, noise.relative_sd * (weight @ of_residual) / (weight @ removed)))


def _combine(of_gaps: tuple[float, float], of_visited: tuple[float, float]) -> tuple[float, float]:
    """Scale of unvisited pixels by both measurements, and its standard deviation."""
    (found, sd), (other, other_sd) = of_gaps, of_visited
    between = max((found - other) ** 2 - sd**2 - other_sd**2, 0.0)
    weight = sd**2 / (sd**2 + other_sd**2 + between)
    return found + weight * (other - found), float(np.sqrt(weight * (other_sd**2 + between)))


def _removed_energy(mean: KernelMean, width: float) -> Array:
    """Variance of the removed detail up to a factor."""
    return (1.0 - mean.share) ** 2 * _slope_energy(mean.image, width)


def _slope_energy(image: Array, width: float) -> Array:
    """Mean square of the change of the picture over the kernel's width, with a fraction of its mean added."""
    down, across = np.gradient(image)
    energy = width**2 * smooth(np.asarray(down**2 + across**2), width)
    return energy + GLOBAL_FRACTION * energy.mean() + np.finfo(float).tiny


def _weights(counts: Array, width: float) -> tuple[float, Array, Array]:
    """Weight of the kernel's centre, and the sums over all samples of their weights and of the squares of those."""
    import cv2

    size = 2 * max(int(REACH * width + 0.5), 1) + 1
    line = cv2.getGaussianKernel(size, width)
    values = counts.astype(np.float64)
    sums = (cv2.sepFilter2D(values, cv2.CV_64F, k, k, borderType=cv2.BORDER_REFLECT) for k in (line, line**2))
    weight, squares = (np.maximum(np.asarray(each), 0.0) for each in sums)
    return float(line.max() ** 2), weight, squares
