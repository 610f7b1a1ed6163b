"""The picture as a weighted mean of the samples around each pixel, with a Gaussian width that held-out samples choose.

Source: Nadaraya 1964 and Watson 1964, kernel regression; cross-validated width as in Härdle & Marron 1985.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.imaging.held_out import (
    SplitSums,
    excess_variance,
    log_average,
    pixel_means,
    positive_mean,
    representative_weights,
)
from recon.imaging.pixel_noise import SampleNoise
from scanner.arrays import Array

WIDTHS_PX = np.geomspace(0.5, 16.0, 11)
"""Standard deviations of the kernel that are compared [px]. At 0.5 a pixel hardly uses its neighbours."""

REACH = 4.0
"""Reach of the kernel in standard deviations. A pixel without a sample within it has no value."""

MIN_WIDTH_BLOCKS = 3.0
"""Least standard deviation of a Gaussian on blocks of pixels, in blocks: linear interpolation between them errs by 1 %
of its peak."""

BLOCK_VARIANCE = 0.25
"""Variance that the mean over a block, 1/12, and the interpolation between blocks, 1/6, add [square of a block]."""

MIN_WEIGHT = 1e-6
"""Weight, relative to that of a sample at the pixel itself, below which a pixel has no value."""

PRIOR_SCALE = 1.0
"""Removed detail relative to the squared slope where no held-out sample measures it."""

GLOBAL_FRACTION = 0.2
"""Fraction of the mean squared slope that is added everywhere: a flat part may hold detail that the kernel removed."""

TAIL_FACTOR = 1.3
"""Factor on the variance of the removed detail, which has heavier tails than a normal distribution."""


class PictureEstimate(NamedTuple):
    """An estimated picture of one detector.

    Attributes:
        image: shape (height, width); NaN where the samples determine no value.
        sd: standard deviation of ``image`` as an estimate of the scene.
        data_share: weight of the pixel's own samples in its value, 0 where it was not visited.
        width: standard deviation of the kernel [px].
        strength: of the smoothness prior; None without one.
    """

    image: Array
    sd: Array
    data_share: Array
    width: float
    strength: float | None = None

    @property
    def resolution(self) -> float:
        """Distance between independent values [px]: the root of the pixels per value that the samples determine."""
        return float(np.sqrt(self.image.size / max(float(np.nansum(self.data_share)), 1.0)))


def smooth(image: NDArray[Any], width: float) -> Array:
    """Return the image, shape (height, width) or (height, width, n), under a Gaussian; its edges are mirrored.

    A wide Gaussian acts on means over blocks of pixels, and the result is interpolated linearly between them.
    """
    import cv2

    values: Any = image.astype(np.float32)
    height, across = image.shape[:2]
    block = 2 ** int(max(np.log2(max(width, MIN_WIDTH_BLOCKS) / MIN_WIDTH_BLOCKS), 0.0))
    if block > 1:
        blocks = -(-across // block), -(-height // block)
        values = cv2.resize(values, blocks, interpolation=cv2.INTER_AREA)
        width = float(np.sqrt((width / block) ** 2 - BLOCK_VARIANCE))
    size = 2 * max(int(REACH * width + 0.5), 1) + 1
    values = cv2.GaussianBlur(values, (size, size), width, borderType=cv2.BORDER_REFLECT)
    values = cv2.resize(values, (across, height)) if block > 1 else values
    return np.asarray(values).reshape(image.shape)


def kernel_mean(sums: Array, counts: Array, width: float) -> Array:
    """Return the kernel-weighted mean of the samples; where none is in reach, the mean of all."""
    spread = smooth(np.dstack([sums, counts]), width)
    return np.where(spread[..., 1] > 0, spread[..., 0] / np.maximum(spread[..., 1], 1e-30), sums.sum() / counts.sum())


def choose_width(samples: SplitSums, noise: SampleNoise) -> float:
    """Return the kernel's width [px] by the held-out samples."""
    held, kept_sums, kept = pixel_means(samples.held_sums, samples.held_counts), samples.kept_sums, samples.kept_counts
    variance = noise.variance(np.asarray(samples.sums.sum() / samples.counts.sum()))
    misfits = np.array(
        [np.sum(samples.held_counts * (held - kernel_mean(kept_sums, kept, width)) ** 2) for width in WIDTHS_PX]
    ) / max(float(variance), 1e-12 * float(np.sum(samples.held_counts * held**2)) + 1e-300)
    return log_average(WIDTHS_PX, misfits)[0]


def find_reached(counts: Array, width: float) -> NDArray[np.bool_]:
    """Return the pixels with a sample within the kernel's reach, shape (height, width)."""
    import cv2

    distance = cv2.distanceTransform((counts <= 0).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    return np.asarray(distance <= REACH * width)


def kernel_picture(samples: SplitSums, noise: SampleNoise, width: float | None = None) -> PictureEstimate:
    """Return the picture under the kernel that predicts the held-out samples best.

    Its variance is that of the weighted noise, and that of the detail that the kernel removes. The latter is taken as
    proportional to the square of the picture's slope nearby; the held-out samples give the factor.

    Args:
        samples: of one detector by pixel.
        noise: of a sample.
        width: of the kernel [px]; by default that of ``choose_width``.
    """
    width = choose_width(samples, noise) if width is None else width
    image = kernel_mean(samples.sums, samples.counts, width)
    centre, weight, squares = _weights(samples.counts, width)
    reached = weight > MIN_WEIGHT * centre
    variance = np.divide(noise.variance(image) * squares, weight**2, out=np.full(image.shape, np.inf), where=reached)

    kept = kernel_mean(samples.kept_sums, samples.kept_counts, width)
    _, kept_weight, kept_squares = _weights(samples.kept_counts, width)
    held = (samples.held_counts > 0) & (kept_weight > MIN_WEIGHT * centre)
    scale = PRIOR_SCALE
    if held.any():
        of_samples = noise.variance(kept[held])
        spread = of_samples / samples.held_counts[held] + of_samples * kept_squares[held] / kept_weight[held] ** 2
        residual = pixel_means(samples.held_sums, samples.held_counts)[held] - kept[held]
        removed = _slope_energy(kept, width)[held]
        scale = positive_mean(*excess_variance(residual, spread, removed, representative_weights(samples)[held]))
    sd = np.sqrt(variance + TAIL_FACTOR * scale * _slope_energy(image, width))
    share = np.divide(samples.counts * centre, weight, out=np.zeros(image.shape), where=reached)
    return PictureEstimate(np.where(reached, image, np.nan), np.where(reached, sd, np.nan), share, width)


def kernel_image(samples: SplitSums, width: float) -> Array:
    """Return the image of ``kernel_picture`` alone, with the kernel's width [px]."""
    image = kernel_mean(samples.sums, samples.counts, width)
    return np.where(find_reached(samples.counts, width), image, np.nan)


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
