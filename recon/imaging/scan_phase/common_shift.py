"""Errors of the measured phase that repeat: at the same places, and in all slices of a scan.

Fine cells do not average out a pattern that the samples repeat from line to line, coarse ones lose detail. The scatter
of blocks of time does not show either: the error by detail between the samples repeats at the same places, and a shift
that all slices have in common shows where cells of two sizes are compared.
"""

from __future__ import annotations

import numpy as np

from scanner.arrays import Array

MIN_COMMON_SLICES = 3
"""Slices from which a common shift is distinguished from the noise of each, whose variance is estimated too."""


def common_shift_factor(coarse: tuple[Array, Array], fine: tuple[Array, Array]) -> Array:
    """Factor on the standard errors in fine cells that allows for what coarse ones show in all slices.

    Without a common shift the square of the difference of the means is on average the difference of their variances
    (Hausman 1978, "Specification tests in econometrics"). What exceeds it is added to the variance of the mean.

    Args:
        coarse, fine: values and standard errors in each slice, of shape (slices, axes) [rad]; inf where undetermined.

    Returns:
        Shape (axes,), at least 1.
    """
    both = np.isfinite(coarse[1]) & np.isfinite(fine[1])
    means, variances = [], []
    for value, sd in (coarse, fine):
        weight = np.where(both, sd, np.inf) ** -2.0
        variances.append(1.0 / np.maximum(weight.sum(axis=0), np.finfo(float).tiny))
        means.append((weight * value).sum(axis=0) * variances[-1])
    shift = np.maximum((means[0] - means[1]) ** 2 - np.abs(variances[0] - variances[1]), 0.0)
    return np.where(both.sum(axis=0) >= MIN_COMMON_SLICES, np.sqrt(1.0 + shift / variances[1]), 1.0)


def common_place_factor(shares: Array, sd: Array) -> Array:
    """Factor on the standard errors of slices that allows for errors which repeat at the same places.

    The standard error of their mean then is that which follows from the scatter of the places.

    Args:
        shares: of the places in the result of each slice, shape (slices, places, axes) [rad].
        sd: standard errors of the slices, shape (slices, axes) [rad]; inf where undetermined.

    Returns:
        Shape (axes,), at least 1.

    Source:
        Cameron and Miller 2015, "A practitioner's guide to cluster-robust inference", section II.
    """
    weight = sd**-2.0
    of_mean = np.linalg.norm((weight[:, None] * shares).sum(axis=0), axis=0)
    independent = np.maximum(np.sqrt(weight.sum(axis=0)), np.finfo(float).tiny)
    return np.asarray(np.maximum(of_mean / independent, 1.0))
