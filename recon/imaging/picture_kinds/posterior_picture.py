"""The picture as posterior mean under a smoothness prior that adapts to the scene, with standard deviations.

The prior is a Gaussian random field whose gradients have a covariance that varies over the picture:

1. A kernel-weighted picture with the width that held-out samples choose.
2. The covariance of the gradient in a window around each cell, from the picture smoothed a little: smooth parts are
   smoothed more than others, and edges along their direction only.
3. The posterior mean under this prior, for several strengths. The held-out samples give the weight of each strength.
   Steps 2 and 3 are repeated.
4. The average with the posterior mean under a stationary prior (:mod:`recon.imaging.picture_kinds.stationary_prior`),
   whose weight is the one with the least error in the held-out samples. It serves textures and scenes that are smooth
   everywhere.
5. The standard deviation (:mod:`recon.imaging.picture_kinds.posterior_sd`).

Held-out samples are used only for the last mean, and never to find the gradients.
Source: Knutsson, Westin & Andersson 2011, "Representing local structure using tensors II".
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.imaging.picture_kinds.held_out import (
    SplitSums,
    log_average,
    pixel_means,
    representative_weights,
    shrunk_weight,
)
from recon.imaging.picture_kinds.kernel_picture import PictureEstimate, choose_width, find_reached
from recon.imaging.picture_kinds.posterior_sd import measure_scale, variance_at_centres, variance_from_neighbours
from recon.imaging.picture_kinds.posterior_solver import LANES, Fields, Stencil, build_stencil, solve
from recon.imaging.picture_kinds.scene_covariance import measure_covariance, unresolved_variance
from recon.imaging.picture_kinds.stationary_prior import fit_spectrum, measure_centre_detail, stationary_mean
from recon.imaging.pixel_noise import SampleNoise
from recon.imaging.smoothing import kernel_mean, smooth
from scanner.arrays import Array

GRADIENT_SMOOTHING = 0.6
"""Smoothing of the picture before its gradients are measured, in widths of the kernel."""

WINDOW = 1.5
"""Window in which the covariance of the gradient is measured, in widths of the kernel."""

GLOBAL_FRACTION = 0.05
"""Fraction of the mean gradient variance that is added everywhere: no part of the picture is perfectly flat."""

MEAN_POWER = 1.0
"""Power of the inverse gradient covariance in the prior of the mean."""

SD_POWER = 0.5
"""Power of the inverse gradient covariance in the prior of the standard deviation. The covariance is itself uncertain;
its root errs less in flat parts. With 1 the 95 % intervals of twelve scenes held 65 % to 97 % of the pixels before
scaling."""

REFINEMENTS = 1
"""Repetitions of gradients and mean before the last mean. A second gains less than 0.05 dB in the mean."""

STRENGTH_STEP = 1.0
"""Step between the logarithms of the prior's strengths. The ``LANES`` of them span a factor of 20, and each repetition
is centred on the best strength of the one before."""

MIN_NOISE_LEVEL_WIDTH_PX = 1.5
"""Least smoothing of the intensity by which the noise of a sample is computed [px]."""

NOISE_LEVEL_PHOTONS = 50.0
"""Photons over which that intensity is averaged at least: a sample that is bright by chance has a smaller weight by its
share in them, which makes the picture darker by this share, 2 %. With 200 the weights no longer follow the scene where
photons are few, and a brightness that rises steadily is up to 1 dB less accurate."""

MIN_RELATIVE_VARIANCE = 0.02
"""Lower bound on the variance of a sample, relative to that at the mean intensity: dark pixels have noise too."""

MIN_VARIANCE_OF_SCENE = 1e-4
"""The same relative to the variance of the pixels' means: for recordings without noise."""

SMALLEST_FLOAT32 = float(np.finfo(np.float32).tiny)
"""Least variance whose inverse is held in single precision."""

MIN_REACH_WIDTH_PX = 4.0
"""Width of the kernel within whose reach of a sample, 16 pixels, a pixel has a value even where the best kernel is
narrower: gaps between the lines of a scan are seldom wider."""

MIN_STATIONARY_WEIGHT = 0.05
"""Weight of the picture under the stationary prior below which it is left out: it gains less than 1 %."""

CURVATURE_WIDTH_PX = 1.5
"""Window in which the squared difference of the pixels' centres and means is averaged: the picture determines its size
nearby, but its value in no pixel [px]."""

COARSE_TOLERANCE, FINE_TOLERANCE = 0.15, 0.03
"""Relative residuals of the solutions: for the comparison of strengths, and for the picture."""

MAX_ITERATIONS = 8
"""Iterations of a solution at most. With 40, four scenes change by 0.01 dB, and one takes 1.2 times as long."""


def posterior_picture(samples: SplitSums, noise: SampleNoise, initial_strength: float | None = None) -> PictureEstimate:
    """Return the posterior mean of the scene and its standard deviation.

    Args:
        samples: of one detector by pixel.
        noise: of a sample.
        initial_strength: of the prior, at which its search begins; None for one by the width of the kernel.
    """
    width = choose_width(samples, noise)
    kept_counts, held_counts = samples.kept_counts, samples.held_counts
    kept, held = pixel_means(samples.kept_sums, kept_counts), pixel_means(samples.held_sums, held_counts)
    means = pixel_means(samples.sums, samples.counts)
    scene_variance = float(means[samples.counts > 0].var())
    judged = representative_weights(samples)
    mean = kernel_mean(samples.kept_sums, kept_counts, width)
    gradients = _gradient_covariance(mean, 0.0, WINDOW * width)
    level_width = _noise_level_width(samples, noise)
    precision = _sample_precision(mean, level_width, noise, scene_variance)
    strength = initial_strength or width**2 * float((kept_counts * precision).mean())
    start: Fields = np.repeat(_bordered(mean)[None], LANES, axis=0).astype(np.float32)
    for _ in range(REFINEMENTS):
        strengths = strength * np.exp(STRENGTH_STEP * (np.arange(LANES) - 0.5 * (LANES - 1)))
        stencil = build_stencil(*_weights(gradients, MEAN_POWER))
        start = _posterior_means(stencil, kept, kept_counts * precision, strengths, start, COARSE_TOLERANCE)
        errors = held - _inner(start)
        misfits = np.einsum("ij,kij->k", judged * precision, errors**2)
        strength, weights = log_average(strengths, misfits)
        mean = np.tensordot(weights, _inner(start), 1)
        gradients = _gradient_covariance(mean, GRADIENT_SMOOTHING * width, WINDOW * width)
        precision = _sample_precision(mean, level_width, noise, scene_variance)
    stencil = build_stencil(*_weights(gradients, MEAN_POWER))
    solved = _posterior_means(stencil, means, samples.counts * precision, strengths, start, FINE_TOLERANCE)
    image = np.tensordot(weights, _inner(solved), 1)
    scene = measure_covariance(samples.kept_sums, kept_counts)
    data, spectrum = samples.counts * precision, fit_spectrum(scene)
    image, mean, weight = _add_stationary(image, mean, samples, judged, precision, spectrum)

    predicted = variance_from_neighbours(_weights(gradients, SD_POWER), kept_counts * precision, strength)
    expected = float(unresolved_variance(scene, data).mean() / predicted.mean())
    predicted *= measure_scale(samples, mean, precision, predicted, expected)
    detail = measure_centre_detail(spectrum, float(data.mean())).damped(weight)
    variance, share = variance_at_centres(predicted, data, detail)
    curvature = smooth((_mean_over_pixel(image) - image) ** 2, CURVATURE_WIDTH_PX)
    reached = find_reached(samples.counts, max(width, MIN_REACH_WIDTH_PX))
    sd = np.sqrt(variance + (1.0 - weight) * curvature)
    image, sd = np.where(reached, image, np.nan), np.where(reached, sd, np.nan)
    return PictureEstimate(image, sd, share, width, strength)


def _add_stationary(
    image: Array, mean: Array, samples: SplitSums, judged: Array, precision: Array, spectrum: Array
) -> tuple[Array, Array, float]:
    """Average pictures with those under the stationary prior.

    Args:
        image, mean: of all samples, and of those that are not held out.
        samples: by pixel.
        judged: weight of each held-out pixel.
        precision: of a sample.
        spectrum: of the stationary prior.

    Returns:
        Both averages, and the weight of the stationary prior.
    """
    kept, kept_counts = pixel_means(samples.kept_sums, samples.kept_counts), samples.kept_counts
    scene_mean = float(samples.kept_sums.sum() / kept_counts.sum())
    stationary = stationary_mean(kept, kept_counts * precision, spectrum, scene_mean)
    difference = stationary - mean
    residual = pixel_means(samples.held_sums, samples.held_counts) - mean
    weight = shrunk_weight(judged * difference, difference, residual)
    if weight < MIN_STATIONARY_WEIGHT:
        return image, mean, 0.0
    means, data = pixel_means(samples.sums, samples.counts), samples.counts * precision
    stationary = stationary_mean(means, data, spectrum, scene_mean, stationary)
    return image + weight * (stationary - image), mean + weight * difference, weight


def _noise_level_width(samples: SplitSums, noise: SampleNoise) -> float:
    """Standard deviation of the kernel that averages the intensity over ``NOISE_LEVEL_PHOTONS`` [px]."""
    above_dark = float(samples.kept_sums.mean() - noise.dark * samples.kept_counts.mean())
    photons = above_dark / noise.slope if noise.slope > 0.0 else np.inf
    area = NOISE_LEVEL_PHOTONS / photons if photons > 0.0 else 0.0
    return min(max(math.sqrt(area / (4.0 * math.pi)), MIN_NOISE_LEVEL_WIDTH_PX), float(max(samples.counts.shape)))


def _sample_precision(mean: Array, level_width: float, noise: SampleNoise, scene_variance: float) -> Array:
    """Inverse variance of a sample by pixel; ``level_width``: smoothing of the mean [px]."""
    variance = noise.variance(smooth(mean, level_width))
    least = max(MIN_RELATIVE_VARIANCE * variance.mean(), MIN_VARIANCE_OF_SCENE * scene_variance, SMALLEST_FLOAT32)
    return 1.0 / np.maximum(variance, least)


def _gradient_covariance(image: Array, smoothing: float, window: float) -> Array:
    """Covariance (xx, xy, yy) of the gradient around each cell of four pixels, shape (height - 1, width - 1, 3)."""
    image = smooth(image, smoothing) if smoothing else image
    across, down = np.diff(image, axis=1), np.diff(image, axis=0)
    top, bottom, left, right = across[:-1], across[1:], down[:, :-1], down[:, 1:]
    moments = [0.5 * (top**2 + bottom**2), 0.25 * (top + bottom) * (left + right), 0.5 * (left**2 + right**2)]
    return smooth(np.dstack(moments), max(window, 1.0))


def _weights(covariance: Array, power: float) -> tuple[Array, Array, Array]:
    """Cell weights (xx, xy, yy): the covariance to a negative power, with a mean log determinant of 0."""
    xx, xy, yy = (each.astype(np.float64) for each in np.moveaxis(covariance, -1, 0))
    half_trace = 0.5 * (xx + yy)
    added = GLOBAL_FRACTION * half_trace.mean()
    if not added > 0:
        return np.ones_like(xx), np.zeros_like(xx), np.ones_like(xx)
    centre, difference = half_trace + added, 0.5 * (xx - yy)
    radius = np.hypot(difference, xy)
    large, small = (1.0 / (centre + radius)) ** power, (1.0 / np.maximum(centre - radius, 0.5 * added)) ** power
    mean, slope = 0.5 * (large + small), 0.5 * (large - small) / np.maximum(radius, 1e-12 * centre)
    scale = np.exp(-0.5 * np.mean(np.log(large * small)))
    return scale * (mean + slope * difference), scale * slope * xy, scale * (mean - slope * difference)


def _posterior_means(
    stencil: Stencil, means: Array, precision: Array, strengths: Array, start: Fields, tolerance: float
) -> Fields:
    """Posterior means for several strengths of the prior, with a border.

    The prior does not depend on the mean level. It is subtracted, so that the tolerance refers to the contrast.
    """
    level = np.float32(np.vdot(precision, means) / precision.sum())
    scaled = (_bordered(precision) / strengths[:, None, None]).astype(np.float32)
    data = _bordered(means - level).astype(np.float32) * scaled
    return solve(stencil, scaled, data, start - level, tolerance, MAX_ITERATIONS) + level


def _mean_over_pixel(image: Array) -> Array:
    """Mean over each pixel of the scene that has these values at the pixels' centres and is bilinear between them.

    Samples are averaged over a pixel, so their mean differs from the value at its centre where the scene is curved.
    """
    import cv2

    weights = np.array([0.125, 0.75, 0.125])
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_64F, weights, weights, borderType=cv2.BORDER_REPLICATE))


def _bordered(image: NDArray[Any]) -> NDArray[Any]:
    """The image with a border of zeros."""
    return np.pad(image, 1)


def _inner(fields: NDArray[Any]) -> NDArray[Any]:
    """The fields without their border."""
    return fields[:, 1:-1, 1:-1]
