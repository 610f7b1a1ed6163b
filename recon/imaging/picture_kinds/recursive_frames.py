"""Posterior pictures of successive frames, each of which uses the samples of those before it where they still agree.

Sum and count of the samples by pixel are carried from frame to frame. The scene may have changed in between. A change
of variance q lowers the information B of the carried samples by the factor 1 / (1 + q B), the prediction step of a
Kalman filter for a random walk, so sum and count are multiplied by it. The variance q varies over the picture and is
estimated from each frame:

1. The residual of a block of pixels is the mean of the frame's own samples in it less the picture of the frame before.
   Its variance without a change follows from the noise of the samples and the standard deviation of that picture.
2. A block has one of the variances ``RELATIVE_CHANGES``. Expectation maximisation over all blocks gives the fraction of
   the blocks that has each of them, and with it the probabilities for each block.
3. Steps 1 and 2 are done for blocks of several sizes. Small blocks find small parts that change much, and large blocks
   find weak changes. The factors are multiplied.

Held-out samples of the frame itself are not used here; they judge the resulting picture as that of a single frame.
Source: Mehra 1972, "Approaches to adaptive filtering"; Dempster, Laird & Rubin 1977, expectation maximisation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from recon.imaging.picture_kinds.held_out import SplitSums
from recon.imaging.picture_kinds.kernel_picture import PictureEstimate
from recon.imaging.picture_kinds.posterior_picture import (
    MIN_NOISE_LEVEL_WIDTH_PX,
    MIN_VARIANCE_OF_SCENE,
    posterior_picture,
)
from recon.imaging.pixel_noise import SampleNoise
from recon.imaging.smoothing import smooth
from scanner.arrays import Array

BLOCK_WIDTHS_PX = (1.5, 3.0, 6.0)
"""Standard deviations of the windows that are the blocks [px]: from one pass of the beam through a sparse frame to the
size of an object."""

RELATIVE_CHANGES = np.concatenate([[0.0], 4.0 ** np.arange(-6, 2)])
"""Variances of a change relative to the variance of the scene. Contrast that vanishes or appears has about 4; steps of
a factor of 4 are as fine as a single residual determines a variance."""

PRIOR_UNCHANGED = 0.5
"""Fraction of unchanged blocks in the prior of the fractions. The changes share the rest equally."""

PRIOR_WEIGHT = 0.05
"""Weight of that prior in the estimated fractions. It keeps a change possible in a scene that was at rest so far. With
0.2, ten earlier frames gain 0.3 dB less at rest, and changes that nothing showed make the intervals too wide."""

ITERATIONS = 10
"""Iterations of expectation maximisation. More of them change the fractions by less than the prior does."""

LEAST_INFORMATION = 1e-6
"""Information added to that of each block, relative to the inverse variance of the scene: a block without samples has a
residual of unlimited variance."""


class CarriedFrames(NamedTuple):
    """What a frame of one detector takes over from those before it.

    Attributes:
        sums, counts: of the samples by pixel, with those of earlier frames reduced, shape (height, width).
        estimate: picture of the last frame.
    """

    sums: Array
    counts: Array
    estimate: PictureEstimate


def recursive_picture(
    own: SplitSums, noise: SampleNoise, before: CarriedFrames | None
) -> tuple[PictureEstimate, CarriedFrames]:
    """Return the posterior picture of a frame, and what the next frame takes over.

    Args:
        own: samples of the frame, by pixel.
        noise: of a sample.
        before: from the frame before; None for the first frame.
    """
    if before is None:
        estimate = posterior_picture(own, noise)
        return estimate, CarriedFrames(own.sums, own.counts, estimate)
    factor, excess = _compare(own, noise, before)
    sums, counts = own.sums + factor * before.sums, own.counts + factor * before.counts
    estimate = posterior_picture(
        SplitSums(sums, counts, own.held_sums, own.held_counts), noise, before.estimate.strength
    )
    # A pixel also errs by a change of its neighbours, so the share is that of the samples around it.
    part, whole = (smooth(each, estimate.width) for each in (factor * before.counts, counts))
    share = np.divide(part, whole, out=np.zeros_like(part), where=whole > 0)
    estimate = estimate._replace(sd=np.sqrt(estimate.sd**2 + share**2 * excess))
    return estimate, CarriedFrames(sums, counts, estimate)


def _compare(own: SplitSums, noise: SampleNoise, before: CarriedFrames) -> tuple[Array, Array]:
    """Compare the samples of a frame with the picture of the frame before.

    Returns:
        By pixel, the factor on the carried samples, and the variance of the change beyond what it accounts for.
    """
    import cv2

    known = np.isfinite(before.estimate.image)
    image, sd = (np.where(known, each, 0.0) for each in (before.estimate.image, before.estimate.sd))
    unit = max(float(image[known].var()), float(np.finfo(np.float64).tiny))
    variance = noise.variance(smooth(image, MIN_NOISE_LEVEL_WIDTH_PX)) / unit
    precision = known / np.maximum(variance, MIN_VARIANCE_OF_SCENE)
    information = own.kept_counts * precision
    deviation = (own.kept_sums - own.kept_counts * image) * precision / np.sqrt(unit)
    fields = np.dstack([deviation, information, before.counts * precision, sd**2 / unit])
    factor, excess = np.ones(image.shape), np.zeros(image.shape)
    for width in BLOCK_WIDTHS_PX:
        step, area = (
            min(round(width), *image.shape),
            4.0 * np.pi * width**2,
        )  # (sum of weights)^2 / sum of their squares
        blocks = (slice(step // 2, None, step),) * 2
        total, weight, carried, spread = np.moveaxis(smooth(fields, width)[blocks], -1, 0)
        weight = weight + LEAST_INFORMATION
        noise_variance = smooth(information, width / np.sqrt(2.0))[blocks] + LEAST_INFORMATION  # the squared window
        independent = min(before.estimate.resolution**2 / area, 1.0)
        unchanged = noise_variance / (area * weight**2) + independent * spread
        found = _estimate_change(total / weight, unchanged, area * carried)
        block_factor, block_excess = (cv2.resize(each, image.shape[::-1]) for each in found)
        factor, excess = factor * block_factor, excess + block_excess
    return factor, unit * excess


def _estimate_change(residual: Array, unchanged: Array, carried: Array) -> tuple[Array, Array]:
    """Estimate the change of blocks of one size by expectation maximisation.

    Args:
        residual: of each block.
        unchanged: its variance if the block did not change.
        carried: information of the carried samples of each block.

    Returns:
        Factor on that information, and the variance of the change beyond what the factor accounts for, by block.
    """
    prior = np.full(RELATIVE_CHANGES.size, (1.0 - PRIOR_UNCHANGED) / (RELATIVE_CHANGES.size - 1))
    prior[0] = PRIOR_UNCHANGED
    expected = unchanged[..., None] + RELATIVE_CHANGES
    log_likelihood = -0.5 * (np.log(expected) + residual[..., None] ** 2 / expected)
    likelihood = np.exp(log_likelihood - log_likelihood.max(-1, keepdims=True))
    fractions = probability = prior
    for _ in range(ITERATIONS):
        probability = likelihood * fractions
        probability /= probability.sum(-1, keepdims=True)
        fractions = (1.0 - PRIOR_WEIGHT) * probability.mean((0, 1)) + PRIOR_WEIGHT * prior
    carried = carried + LEAST_INFORMATION
    factor = np.sum(probability / (1.0 + carried[..., None] * RELATIVE_CHANGES), axis=-1)
    excess = np.maximum(probability @ RELATIVE_CHANGES - (1.0 / factor - 1.0) / carried, 0.0)
    return factor, excess
