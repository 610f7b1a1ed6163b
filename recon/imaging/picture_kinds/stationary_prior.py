"""The picture as posterior mean of a stationary Gaussian random field whose covariance is measured from the samples.

This is simple kriging. The prior of :mod:`recon.imaging.picture_kinds.posterior_picture` knows the gradients of the
scene; this one knows over which distances the scene is correlated, differently across and down. It serves textures, and
scenes as smooth as the spot of a microscope.

1. The covariance at each lag is measured from pairs of visited pixels
   (:mod:`recon.imaging.picture_kinds.scene_covariance`).
2. It is fitted by a sum of Gaussian covariances with non-negative variances, which is a valid covariance.
3. The field has the type-2 cosine transform as modes, with the power spectrum of that sum. Conjugate gradients solve
   for its posterior mean.

Source: Cressie 1993, "Statistics for spatial data", chapters 2 and 3 (variograms and kriging).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from recon.imaging.picture_kinds.scene_covariance import SceneCovariance
from scanner.arrays import Array

LENGTHS_PX = 2.0 ** np.arange(-0.5, 6.1, 0.75)
"""Correlation lengths of the Gaussian covariances, for each direction [px]: from less than a pixel to the width of a
frame. Neighbours differ by a factor of 1.7, which their sums interpolate to a few percent."""

RELATIVE_SPECTRUM_FLOOR = 1e-9
"""Least power of a mode, relative to the scene's variance: keeps the preconditioner finite."""

TOLERANCE = 0.005
"""Relative residual of the solution, in the norm of the preconditioner. With 0.001 errors change by less than 2 %."""

MAX_ITERATIONS = 40
"""Iterations after which the solution is used as it is."""


class CentreDetail(NamedTuple):
    """Unresolved detail at the pixels' centres, relative to that of the samples' means in the pixels.

    Attributes:
        variance: at the centres.
        covariance: of the centres with the means.
    """

    variance: float
    covariance: float

    def damped(self, weight: float) -> CentreDetail:
        """Return the detail of a picture that follows the stationary prior with this weight, and has none otherwise."""
        return CentreDetail(*(1.0 + weight * (each - 1.0) for each in self))


def fit_spectrum(scene: SceneCovariance) -> Array:
    """Return the power spectrum of the scene by cosine mode, shape (height, width), in the square of its unit."""
    variances = _fit_covariance(scene)
    down, across = (_mode_powers(size) for size in scene.shape)
    floor = max(RELATIVE_SPECTRUM_FLOOR * float(variances.sum()), float(np.finfo(np.float32).tiny))
    return np.asarray(down @ variances @ across.T + floor)


def stationary_mean(
    means: Array, precision: Array, spectrum: Array, scene_mean: float, start: Array | None = None
) -> Array:
    """Return the posterior mean of the scene, shape (height, width).

    The preconditioner is the inverse that the matrix would have if all pixels had the mean precision.

    Args:
        means: of the samples by pixel; not used where ``precision`` is 0.
        precision: of ``means``.
        spectrum: from :func:`fit_spectrum`.
        scene_mean: prior mean.
        start: a similar solution of the same spectrum, with which the iteration begins.
    """
    root, data = np.sqrt(spectrum).astype(np.float32), precision.astype(np.float32)
    inverse = (1.0 / (1.0 + spectrum * precision.mean())).astype(np.float32)

    def to_modes(image: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(root * fft.dctn(image, norm="ortho", overwrite_x=True))

    def to_image(modes: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(fft.idctn(root * modes, norm="ortho", overwrite_x=True))

    residual = to_modes(data * (means - scene_mean).astype(np.float32))
    target = TOLERANCE**2 * float(np.vdot(residual, inverse * residual))
    solution = np.zeros_like(residual)
    if start is not None:
        solution = fft.dctn((start - scene_mean).astype(np.float32), norm="ortho") / root
        residual -= solution + to_modes(data * to_image(solution))
    conditioned = inverse * residual
    direction, energy = conditioned, float(np.vdot(residual, conditioned))
    for _ in range(MAX_ITERATIONS):
        if energy <= target:
            break
        product = direction + to_modes(data * to_image(direction))
        step = energy / float(np.vdot(direction, product))
        solution += np.float32(step) * direction
        residual -= np.float32(step) * product
        conditioned = inverse * residual
        previous, energy = energy, float(np.vdot(residual, conditioned))
        direction = conditioned + np.float32(energy / previous) * direction
    return scene_mean + to_image(solution)


def measure_centre_detail(spectrum: Array, precision: float) -> CentreDetail:
    """Return how much larger unresolved detail is at the pixels' centres than in the samples' means.

    Args:
        spectrum: from :func:`fit_spectrum`.
        precision: mean of that of the pixels; modes of more power than its inverse are resolved.
    """
    return relate_to_centres(spectrum / (1.0 + spectrum * precision))


def relate_to_centres(unresolved: Array) -> CentreDetail:
    """Return how much larger detail is at the pixels' centres than in the samples' means.

    Samples lie anywhere in a pixel. For a scene that is linear between the centres, their mean has the response
    3/4 + cos(k)/4 at wave number k in each direction: detail as fine as the pixels is larger at the centres.

    Args:
        unresolved: power spectrum of the detail in the samples' means, by cosine mode, shape (height, width).
    """
    down, across = (0.75 + 0.25 * np.cos(np.pi * np.arange(size) / size) for size in unresolved.shape)
    of_means, response = float(unresolved.sum()), np.outer(down, across)
    covariance, variance = (float((unresolved / response**power).sum()) / of_means for power in (1, 2))
    return CentreDetail(variance, covariance)


def _fit_covariance(scene: SceneCovariance) -> Array:
    """Variances of the Gaussian covariances, shape (lengths down, lengths across)."""
    down, across = (np.arange(size)[:, None] for size in scene.covariance.shape)
    shapes = [np.exp(-0.5 * (lag / LENGTHS_PX) ** 2) for lag in (down, across)]
    basis = np.einsum("ip,jq->ijpq", *shapes).reshape(*scene.covariance.shape, -1)
    return scene.fit(basis).reshape(LENGTHS_PX.size, -1)


def _mode_powers(size: int) -> Array:
    """Power of each cosine mode under a Gaussian covariance of unit variance, shape (size, lengths)."""
    wave_number = np.pi * np.arange(size)[:, None] / size
    return np.asarray(np.sqrt(2.0 * np.pi) * LENGTHS_PX * np.exp(-0.5 * (wave_number * LENGTHS_PX) ** 2))
