"""The covariance of a scene, measured from the samples, and the variance that samples leave unresolved under it.

The covariance at each lag is the mean product of the pixels' deviations from the mean, over all pairs of visited pixels
at that lag. The noise of different pixels is independent, so it adds nothing.

Source: Cressie 1993, "Statistics for spatial data", chapter 2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from recon.imaging.picture_kinds.held_out import pixel_means
from recon.imaging.smoothing import smooth
from scanner.arrays import Array

MAX_LAG_PX = 24
"""Largest lag at which the covariance is measured: gaps of a sparse frame are narrower [px]."""

MIN_PAIRS = 8.0
"""Pairs of pixels below which a lag is left out."""

EXPONENTIAL_LENGTHS_PX = 2.0 ** np.arange(-0.5, 7.1, 0.75)
"""Correlation lengths of the exponential covariances, for each direction [px]."""

MODES = 64
"""Wave numbers in each direction at which a spectrum is summed. With 128 the sum changes by less than 2 %."""

PRECISION_STEPS = np.geomspace(1e-3, 30.0, 14)
"""Precisions relative to the mean at which the unresolved variance is computed; others are interpolated."""

LOCAL_WIDTH_PX = 4.0
"""Window whose samples resolve the scene at a pixel [px]: from gap to gap of a sparse frame."""


class SceneCovariance(NamedTuple):
    """Covariance of a scene by lag.

    Attributes:
        covariance: shape (lags down, lags across); lags of both signs as one. Lag 0 includes the noise.
        pairs: number of pairs of pixels, of the same shape.
        shape: of the picture.
    """

    covariance: Array
    pairs: Array
    shape: tuple[int, ...]

    @property
    def distance(self) -> Array:
        """Distance of each lag from 0 [px]."""
        down, across = (np.arange(size) for size in self.pairs.shape)
        return np.hypot(down[:, None], across)

    @property
    def used(self) -> NDArray[np.bool_]:
        """Lags at which the covariance is fitted."""
        return (self.pairs >= MIN_PAIRS) & (self.distance > 0) & (self.distance <= MAX_LAG_PX)

    @property
    def standard_error(self) -> float:
        """Standard error of a covariance that is the same at all lags."""
        return float(self.covariance[0, 0] / np.sqrt(max(self.pairs[self.used].sum(), 1.0)))

    def fit(self, basis: Array) -> Array:
        """Return the non-negative factors of covariances whose sum fits this one, shape (n,).

        Lag 0 is not used. A lag counts by its number of pairs and the inverse square of its distance: the values near a
        pixel determine it. All factors are 0 where no lag has enough pairs.

        Args:
            basis: covariances by lag, shape (lags down, lags across, n).
        """
        from scipy.optimize import nnls  # here because it takes 0.1 s to import

        used = self.used
        if not used.any():
            return np.zeros(basis.shape[-1])
        weight = np.sqrt(self.pairs[used]) / (1.0 + self.distance[used])
        factors, _ = nnls(basis[used] * weight[:, None], self.covariance[used] * weight, maxiter=30 * basis.shape[-1])
        return np.asarray(factors)


def measure_covariance(sums: Array, counts: Array) -> SceneCovariance:
    """Return the covariance of the scene.

    Args:
        sums, counts: of the samples by pixel, shape (height, width), at least one sample.
    """
    visited = counts > 0
    deviation = np.where(visited, pixel_means(sums, counts) - sums.sum() / counts.sum(), 0.0)
    lags = [min(MAX_LAG_PX, size - 1) + 1 for size in counts.shape]
    shape = [fft.next_fast_len(size + lag, real=True) for size, lag in zip(counts.shape, lags, strict=True)]

    def correlate(image: Array) -> Array:
        full = fft.irfft2(np.abs(fft.rfft2(image, shape)) ** 2, shape)
        return np.asarray((full + np.roll(full[::-1], 1, 0))[: lags[0], : lags[1]])

    products, pairs = correlate(deviation), np.maximum(np.rint(correlate(visited.astype(float))), 0.0)
    covariance = np.divide(products, pairs, out=np.zeros_like(products), where=pairs > 0)
    return SceneCovariance(covariance, pairs, counts.shape)


def unresolved_variance(scene: SceneCovariance, precision: Array) -> Array:
    """Return the variance that the samples leave unresolved at each pixel, shape (height, width).

    The covariance is fitted by a sum of exponentials of the distance. Their spectrum falls slowly, as that of scenes
    with edges does; a sum of Gaussians has next to no power beyond the lags at which it was measured. A mode of power S
    has the variance S / (1 + S p) given samples of the precision p. The standard error of the covariance is added.

    Args:
        scene: covariance.
        precision: of the samples' means by pixel.
    """
    down, across = (np.arange(size)[:, None] / EXPONENTIAL_LENGTHS_PX for size in scene.covariance.shape)
    distance = np.hypot(down[:, None, :, None], across[None, :, None, :])
    factors = scene.fit(np.exp(-distance).reshape(*scene.covariance.shape, -1))
    lengths = np.stack(np.meshgrid(EXPONENTIAL_LENGTHS_PX, EXPONENTIAL_LENGTHS_PX, indexing="ij"), -1).reshape(-1, 2)
    wave_number = np.pi * (np.arange(MODES) + 0.5) / MODES
    spectrum = np.zeros((MODES, MODES))
    for factor, (length_down, length_across) in zip(factors, lengths, strict=True):
        if factor > 0:
            squares = np.add.outer((wave_number * length_down) ** 2, (wave_number * length_across) ** 2)
            spectrum += 2.0 * np.pi * factor * length_down * length_across * (1.0 + squares) ** -1.5
    steps = precision.mean() * PRECISION_STEPS
    variances = [np.mean(spectrum / (1.0 + spectrum * step)) for step in steps]
    local = np.clip(smooth(precision, LOCAL_WIDTH_PX), steps[0], steps[-1])
    return np.interp(np.log(local), np.log(steps), variances) + scene.standard_error
