"""Sums and counts of the samples by pixel, with a tenth of the samples held out to choose widths and judge errors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from recon.imaging.normal_density import normal_log_density
from scanner.arrays import Array

HELD_OUT_FRACTION = 0.1
"""Fraction of the samples that are held out: enough to judge a picture by, few enough to leave it as it is."""

HELD_OUT_SAMPLES = 32
"""Consecutive samples that are held out together. Their pixels then have no neighbour of the same pass, and errors in
them are as large as in pixels that the scan did not visit."""

MAX_HELD_OUT_SEGMENTS = 512
"""Segments that are held out at most: 32 768 samples judge a picture to 1 %, and the cost remains bounded."""

MIN_RELATIVE_DISTANCE = 0.5
"""Mean distance of held-out pixels to the nearest sample, relative to that of all pixels, from which they represent the
gaps of the scan. They had 0.1 in a frame whose two directions nearly retrace each other, and 0.4 to 1.5 in others."""

HELD_OUT_TILE_PX = 16
"""Size of the squares of a chequerboard in half of which the neighbours of held-out pixels are held out too: a sixth of
the samples and not a third [px]."""

MAX_DISTANCE_PX = 16
"""Distances to the nearest sample from here on are counted as one: gaps of a scan are seldom wider [px]."""

MAX_WEIGHT = 10.0
"""Bound on the weight of a held-out pixel and its inverse, so that a few of them never judge a picture alone."""

GOLDEN_RATIO = 0.618
"""Step of the segments' position within their part of the scan, which no period of the scan is in step with."""

CORRELATED_ERRORS = 2.0
"""Factor on the scatter of squared errors. Those of neighbouring held-out pixels are similar; their noise is not."""

LOG_SCALES = np.linspace(-6.0, 7.0, 521)
"""Logarithms of the scales of a variance that are compared."""


class SplitSums(NamedTuple):
    """Samples of one detector by pixel.

    Attributes:
        sums, counts: of all samples, shape (height, width).
        held_sums, held_counts: of the samples held out, which are part of ``sums`` and ``counts``.
    """

    sums: Array
    counts: Array
    held_sums: Array
    held_counts: Array

    @property
    def kept_sums(self) -> Array:
        """Sums of the samples that are not held out."""
        return self.sums - self.held_sums

    @property
    def kept_counts(self) -> Array:
        """Counts of the samples that are not held out, none negative.

        Rounding may place a sample at the edge of a pixel in its neighbour where a part of the scan is gridded.
        """
        return np.maximum(self.counts - self.held_counts, 0.0)


def held_out_ranges(first: int, stop: int) -> list[tuple[int, int]]:
    """Return the samples that are held out of ``first`` up to ``stop``, in segments spread over all of them."""
    size = stop - first
    count = min(int(HELD_OUT_FRACTION * size / HELD_OUT_SAMPLES), MAX_HELD_OUT_SEGMENTS)
    free = size / count - HELD_OUT_SAMPLES if count else 0.0
    begins = [first + int(k * size / count + free * (GOLDEN_RATIO * k % 1.0)) for k in range(count)]
    return [(begin, begin + HELD_OUT_SAMPLES) for begin in begins]


def hold_out_neighbours(samples: SplitSums) -> SplitSums:
    """Hold out pixels around the held-out ones too, where those lie much nearer to samples than most pixels do.

    Where the two directions of a Lissajous scan nearly retrace each other, the gaps between its lines are wide, and a
    segment that is held out of one pass lies beside the other pass: it does not show the errors in the gaps.
    """
    held = samples.held_counts > 0
    if not held.any():
        return samples
    distance, remaining = sample_distance(samples.counts), sample_distance(samples.kept_counts)
    radius = float(distance.mean() - remaining[held].mean() / MIN_RELATIVE_DISTANCE)
    if radius < 1.0:
        return samples
    rows, columns = (np.arange(size) // HELD_OUT_TILE_PX for size in held.shape)
    chosen = (rows[:, None] + columns) % 2 == 0
    near = chosen & (samples.counts > 0) & (sample_distance(samples.held_counts) <= radius)
    if not near.any():
        return samples
    return SplitSums(
        samples.sums, samples.counts, np.where(near, samples.sums, 0.0), np.where(near, samples.counts, 0.0)
    )


def pixel_means(sums: Array, counts: Array) -> Array:
    """Return the mean of each pixel, 0 where there is no sample."""
    return np.divide(sums, counts, out=np.zeros(sums.shape), where=counts > 0)


def representative_weights(samples: SplitSums) -> Array:
    """Return the weight of each held-out pixel in judging a picture, shape (height, width), 0 in other pixels.

    A held-out segment leaves a gap that is wider than those of the scan, and dense parts of the scan hold most of the
    held-out samples. The weights make the distances of held-out pixels to the nearest sample distributed as those of
    all pixels of the picture. Their mean over the held-out pixels is 1.
    """
    held = samples.held_counts > 0
    if not held.any():
        return np.zeros(held.shape)
    distance, remaining = _rounded_distance(samples.counts), _rounded_distance(samples.kept_counts)
    wanted, found = (
        np.bincount(each.ravel(), minlength=MAX_DISTANCE_PX + 1) / each.size for each in (distance, remaining[held])
    )
    ratio = np.divide(wanted, found, out=np.zeros_like(wanted), where=found > 0)
    weight = np.where(held, np.clip(ratio, 1.0 / MAX_WEIGHT, MAX_WEIGHT)[remaining], 0.0)
    return np.asarray(weight / weight[held].mean())


def sample_distance(counts: Array) -> Array:
    """Return the distance of each pixel to the nearest visited one, 0 in that [px]."""
    import cv2

    return np.asarray(cv2.distanceTransform((counts <= 0).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5), float)


def _rounded_distance(counts: Array) -> NDArray[np.intp]:
    """Distance to the nearest visited pixel, rounded and at most ``MAX_DISTANCE_PX`` [px]."""
    return np.minimum(np.rint(sample_distance(counts)), MAX_DISTANCE_PX).astype(np.intp)


def log_average(values: Array, misfits: Array) -> tuple[float, Array]:
    """Return the average of a positive setting under its likelihood, and the weights of its values.

    An average changes less than the best value does where the samples hardly distinguish the values.

    Args:
        values: of the setting, evenly spaced in its logarithm, shape (n,).
        misfits: sum of squares of the held-out samples in units of their variance, shape (n,).
    """
    weights = np.exp(-0.5 * (misfits - misfits.min()))
    weights /= weights.sum()
    return float(np.exp(weights @ np.log(values))), weights


def shrunk_weight(judged: Array, difference: Array, residual: Array) -> float:
    """Weight in [0, 1] of ``difference`` in ``residual`` by least squares, shrunk by its error (James & Stein 1961).

    A weight within its standard deviation of 0 is 0. That deviation includes the scatter of the residuals, which is
    larger where both pictures miss an edge.

    Args:
        judged: ``difference``, weighted for the fit.
        difference, residual: by pixel.
    """
    scale = float(np.vdot(judged, difference))
    if not scale > 0.0:
        return 0.0
    weight = float(np.vdot(judged, residual)) / scale
    rest = residual - min(max(weight, 0.0), 1.0) * difference
    variance = float(np.sum((judged * rest) ** 2)) / scale**2
    return min(max(weight - variance / weight, 0.0), 1.0) if weight > 0.0 else 0.0


def error_variance_ratio(residual: Array, noise: Array, predicted: Array, weight: Array) -> tuple[float, float]:
    """Return the error variance of held-out pixels as a multiple of the predicted one, and its standard deviation.

    Args:
        residual: mean of the held-out samples less the picture without them, shape (n,).
        noise: variance of that mean, shape (n,).
        predicted: variance of the picture, shape (n,).
        weight: of each pixel, from :func:`representative_weights`, shape (n,).
    """
    total = weight @ predicted
    ratio = float(weight @ (residual**2 - noise) / total)
    scatter = weight * (noise + CORRELATED_ERRORS * max(ratio, 0.5) * predicted)
    return ratio, float(np.sqrt(2.0 * scatter @ scatter) / total)


def positive_mean(found: float, sd: float) -> float:
    """Return the posterior mean of a positive number from an estimate with normal errors, and no other knowledge."""
    ratio = found / sd
    return found + sd * float(np.exp(normal_log_density(ratio) - log_ndtr(ratio)))


def scale_with_prior(found: float, spread: Array | float, expected: float, log_sd: float) -> float:
    """Return the scale of a variance from an estimate and a lognormal prior: the posterior mean of its logarithm.

    Args:
        found: estimate, which noise may make negative.
        spread: variance of ``found`` for each of ``exp(LOG_SCALES)``, or the same for all.
        expected: median of the prior.
        log_sd: standard deviation of the logarithm in the prior.
    """
    log_density = -0.5 * ((LOG_SCALES - np.log(expected)) / log_sd) ** 2
    log_density -= 0.5 * ((found - np.exp(LOG_SCALES)) ** 2 / spread + np.log(spread))
    density = np.exp(log_density - log_density.max())
    return float(np.exp(density @ LOG_SCALES / density.sum()))
