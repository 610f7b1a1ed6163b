"""The picture as a weighted mean of the samples around each pixel, with a Gaussian width chosen by cross-validation.

Source: Nadaraya 1964 and Watson 1964, kernel regression; cross-validated width as in Härdle & Marron 1985.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.imaging.picture_kinds.held_out import SplitSums, log_average, pixel_means, sample_distance
from recon.imaging.picture_kinds.kernel_sd import detail_variance, weigh_samples
from recon.imaging.pixel_noise import SampleNoise
from recon.imaging.smoothing import REACH, centre_weight, kernel_mean, mean_of_weighted, smooth
from scanner.arrays import Array

WIDTHS_PX = np.geomspace(0.5, 16.0, 11)
"""Standard deviations of the kernel that are compared [px]. At 0.5 a pixel hardly uses its neighbours."""


LEFT_OUT_WEIGHT = 0.3
"""Weight of a sample that is predicted from all pixels but its own, relative to a held-out one. These are ten times as
many, but have neighbours of the same pass, nearer and with more in common than the samples around an unvisited pixel.
With 0, the width of a scene of few large parts is open by a factor of 3 at 10 photons; with 1, that of the lines of an
AFM spiral is too small, and the picture errs by 11 % more."""

ROUNDING = 1e-4
"""Relative rounding errors of smoothed sums at most."""


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


def choose_width(samples: SplitSums, noise: SampleNoise) -> float:
    """Return the kernel's width [px] by the held-out samples, and by each pixel's samples left out of its own value."""
    summed = np.dstack([samples.kept_sums, samples.kept_counts]).astype(np.float32)
    sums, counts = summed[..., 0], summed[..., 1]
    kept, held = (pixel_means(*each) for each in ((sums, counts), (samples.held_sums, samples.held_counts)))
    visited, judged = np.nonzero(counts), np.nonzero(samples.held_counts)
    mean = float(samples.kept_sums.sum() / samples.kept_counts.sum())
    misfits = np.zeros(WIDTHS_PX.size)
    for k, width in enumerate(WIDTHS_PX):
        total, weight = np.moveaxis(smooth(summed, width), -1, 0)
        errors = held[judged] - mean_of_weighted(total[judged], weight[judged], mean)
        own = centre_weight(width) * counts[visited]
        others = np.where(weight[visited] > (1.0 + ROUNDING) * own, weight[visited] - own, 0.0)
        predicted = mean_of_weighted(total[visited] - own * kept[visited], others, mean)
        misfits[k] = samples.held_counts[judged] @ errors**2
        misfits[k] += LEFT_OUT_WEIGHT * (counts[visited] @ (kept[visited] - predicted) ** 2)
    variance = float(noise.variance(np.asarray(samples.sums.sum() / samples.counts.sum())))
    least = 1e-12 * float(np.sum(samples.held_counts * held**2)) + 1e-300
    return log_average(WIDTHS_PX, misfits / max(variance, least))[0]


def find_reached(counts: Array, width: float) -> NDArray[np.bool_]:
    """Return the pixels with a sample within the kernel's reach, shape (height, width)."""
    return np.asarray(sample_distance(counts) <= REACH * width)


def kernel_picture(samples: SplitSums, noise: SampleNoise, width: float | None = None) -> PictureEstimate:
    """Return the picture under the kernel that predicts the held-out samples best.

    Its variance is that of the weighted noise, and that of the detail that the kernel removes.

    Args:
        samples: of one detector by pixel.
        noise: of a sample.
        width: of the kernel [px]; by default that of ``choose_width``.
    """
    width = choose_width(samples, noise) if width is None else width
    full = weigh_samples(samples.sums, samples.counts, noise, width)
    sd = np.sqrt(full.noise + detail_variance(samples, noise, width, full))
    reached = np.isfinite(full.noise)
    return PictureEstimate(np.where(reached, full.image, np.nan), np.where(reached, sd, np.nan), full.share, width)


def kernel_image(samples: SplitSums, width: float) -> Array:
    """Return the image of ``kernel_picture`` alone, with the kernel's width [px]."""
    image = kernel_mean(samples.sums, samples.counts, width)
    return np.where(find_reached(samples.counts, width), image, np.nan)
