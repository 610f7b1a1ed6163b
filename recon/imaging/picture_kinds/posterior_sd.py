"""The variance of a posterior picture, its scale measured from the recording.

1. Random solutions of a prior with the gradients of the scene give the variance of each pixel given all others: where
   the error is large, and where it is small.
2. The scale of that variance follows from the errors of held-out samples, in pixels that no other sample visited. In
   recordings of few photons they hardly exceed the noise, so the variance that a fit of the scene's covariance leaves
   unresolved is the prior of the scale.
3. The pixel's own samples reduce the variance. They lie anywhere in the pixel, and the picture is the value at its
   centre.

Source: Papandreou & Yuille 2010, "Gaussian sampling by local perturbations"; Sidén et al. 2018, "Efficient covariance
approximations for large sparse precision matrices" (Rao-Blackwellised variances).
"""

from __future__ import annotations

import numba
import numpy as np

from recon.imaging.picture_kinds.held_out import (
    CORRELATED_ERRORS,
    LOG_SCALES,
    SplitSums,
    pixel_means,
    sample_distance,
    scale_with_prior,
)
from recon.imaging.picture_kinds.posterior_solver import LANES, build_stencil, multiply, solve
from recon.imaging.picture_kinds.stationary_prior import CentreDetail
from recon.imaging.smoothing import smooth
from scanner.arrays import Array

NEIGHBOUR_WIDTH_PX = 1.2
"""Smoothing of the variance that the neighbours leave, which ``LANES`` random solutions determine to 70 % only [px]."""

DISTANCE_POWER = 0.2
"""Power of the distance to the nearest sample with which the variance grows beyond that of the prior. The prior's
gradients are independent, those of a scene are alike over a few pixels. Without it, 95 % intervals of sixteen scenes
held 96.3 to 97.0 % of the pixels beside a sample, but 91.6 to 94.2 % of those more than 3 pixels away."""

DRAW_TOLERANCE = 0.1
"""Relative residual of the random solutions: smaller than their scatter."""

PRIOR_LOG_SD = 0.4
"""Standard deviation of the logarithm of a picture's variance about that of the fitted covariance. It was 0.4 to 0.5 in
ten scenes with 10 photons a sample."""

DENSITY_WIDTH_PX = 8.0
"""Window in which the density of the scan is measured [px]."""


def variance_from_neighbours(weights: tuple[Array, Array, Array], precision: Array, strength: float) -> Array:
    """Return the variance of each pixel given all samples but its own, shape (height, width).

    It is the variance given the neighbours' values, and that of the weighted mean of the neighbours, from ``LANES``
    random solutions. Both grow with the distance to the nearest sample.

    Args:
        weights: of the prior by cell, see :mod:`recon.imaging.picture_kinds.posterior_solver`.
        precision: of the samples' means by pixel.
        strength: of the prior.
    """
    stencil = build_stencil(*weights)
    scaled = np.repeat(np.pad(precision / strength, 1).astype(np.float32)[None], LANES, axis=0)
    bits = np.random.default_rng(0).integers(0, 256, (4, *precision.shape), np.uint8)
    noise = draw_noise(*weights, scaled, bits)
    drawn, coupled = solve(stencil, scaled, noise, np.zeros_like(noise), DRAW_TOLERANCE), np.zeros_like(noise)
    multiply(stencil, np.zeros_like(scaled), drawn, coupled)
    own = stencil[0, 1:-1, 1:-1]
    neighbours = drawn[:, 1:-1, 1:-1] - coupled[:, 1:-1, 1:-1] / own
    spread = smooth(np.mean(neighbours**2, axis=0), NEIGHBOUR_WIDTH_PX)
    distance = np.maximum(sample_distance(precision), 1.0)
    return distance**DISTANCE_POWER * (1.0 / own + spread) / strength


def measure_scale(samples: SplitSums, mean: Array, precision: Array, predicted: Array, expected: float) -> float:
    """Return the factor on the predicted variance by which it is that of the picture's errors.

    All parts of the picture count alike, except for those in which the noise hides the errors: dense parts of the scan
    hold most of the held-out pixels, and few of the unvisited ones.

    Args:
        samples: by pixel.
        mean: picture without the held-out samples.
        precision: of a sample by pixel.
        predicted: variance of each pixel given all samples but its own.
        expected: factor by the covariance of the scene.
    """
    weights = _area_weights(samples)
    used = weights > 0
    if not used.any():
        return expected
    residual = (pixel_means(samples.held_sums, samples.held_counts) - mean)[used]
    noise, variance = 1.0 / (samples.held_counts * precision)[used], predicted[used]
    own = 1.0 + (samples.kept_counts * precision)[used] * expected * variance
    weight = weights[used] / (own**2 * (noise + expected * variance))
    slope = weight @ (variance / own**2)
    found = expected + weight @ (residual**2 - noise - expected * variance / own) / slope
    of_noise, of_errors = weight * noise, CORRELATED_ERRORS * weight * variance / own
    scale = np.exp(LOG_SCALES)
    squares = of_noise @ of_noise + scale * (2.0 * of_noise @ of_errors + scale * (of_errors @ of_errors))
    return scale_with_prior(float(found), 2.0 * squares / slope**2, expected, PRIOR_LOG_SD)


def _area_weights(samples: SplitSums) -> Array:
    """Weight of each held-out pixel, 0 in others, by which they represent the area of the picture.

    Pixels with and without further samples count as visited and unvisited pixels of the picture, and within each of the
    two by the inverse density of the scan.
    """
    area = 1.0 / np.maximum(smooth(samples.counts, DENSITY_WIDTH_PX), np.finfo(np.float32).tiny)
    weights = np.zeros(area.shape)
    for in_held, in_picture in (
        (samples.kept_counts > 0, samples.counts > 0),
        (samples.kept_counts == 0, samples.counts == 0),
    ):
        part = in_held & (samples.held_counts > 0)
        weights[part] = in_picture.mean() * area[part] / max(area[part].sum(), 1e-300)
    return weights


def variance_at_centres(variance: Array, data: Array, detail: CentreDetail) -> tuple[Array, Array]:
    """Return the variance of a picture at the pixels' centres, and the weight of a pixel's own samples in its value.

    The picture is the posterior mean m of the expectation of a pixel's samples. Given all samples, let that have the
    variance v, the value c at the centre R v, and both the covariance C v. Without the pixel's own samples, v is larger
    by 1 / (1 - share), and the best estimate of c moves by C times as much as m for them. The error of m as an estimate
    of c follows, except for the difference of the two that other pixels determine.

    Args:
        variance: of the expectation, given all samples but those of the pixel.
        data: precision of the mean of the pixel's samples, 0 without.
        detail: R and C.
    """
    share = data * variance / (1.0 + data * variance)
    ratio = detail.variance * (1.0 - share) + share * (detail.covariance - 1.0) ** 2
    return variance * ratio, share


@numba.njit(cache=True)
def draw_noise(xx, xy, yy, precision, bits):  # type: ignore[no-untyped-def]
    """Return right-hand sides whose solutions have the covariance of the posterior.

    Their covariance is the matrix of the system. They are sums of independent random signs: the variance of the
    solutions needs no normal numbers.

    Args:
        xx, xy, yy: cell weights, shape (height - 1, width - 1).
        precision: of the data, shape (LANES, height + 2, width + 2).
        bits: random bytes, a bit for each lane, shape (4, height, width).

    Returns:
        Shape (LANES, height + 2, width + 2).
    """
    height, width = bits.shape[1], bits.shape[2]
    noise = np.zeros((LANES, height + 2, width + 2), np.float32)
    for i in range(height):
        for j in range(width):
            for k in range(LANES):
                sign = np.float32(2 * ((bits[3, i, j] >> k) & 1)) - np.float32(1.0)
                noise[k, i + 1, j + 1] += sign * np.sqrt(precision[k, i + 1, j + 1])
    for i in range(height - 1):
        for j in range(width - 1):
            # The energy of a cell is (p, q) W (p, q)' / 4 + (xx + yy) r^2 / 4, where p and q are the sums of its two
            # horizontal and its two vertical differences, and r is the difference of its two diagonal sums.
            r00 = np.sqrt(xx[i, j])
            r01 = xy[i, j] / r00
            r11 = np.sqrt(max(yy[i, j] - r01 * r01, 0.0))
            r22 = np.sqrt(xx[i, j] + yy[i, j])
            for k in range(LANES):
                a = (bits[0, i, j] >> k & 1) - 0.5
                b = (bits[1, i, j] >> k & 1) - 0.5
                c = (bits[2, i, j] >> k & 1) - 0.5
                across, down, twist = r00 * a, r01 * a + r11 * b, r22 * c
                noise[k, i + 1, j + 1] += twist - across - down
                noise[k, i + 1, j + 2] += across - down - twist
                noise[k, i + 2, j + 1] += down - across - twist
                noise[k, i + 2, j + 2] += across + down + twist
    return noise
