"""Variance of a sample's residual from a smoothed picture of the scene."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from scanner.arrays import Array

LOWEST = 1.0 / 16.0
"""Fraction of the samples whose mean is the dark level: the least value is that of noise."""

ROUNDS = 100
"""Updates of the coefficients: the last ones change them by less than their standard error."""

MIN_VARIANCE_OF_SIGNAL = 1e-12
"""Lower bound on the variance relative to the mean square of the picture, for recordings without noise and structure.
Samples are held in single precision, whose rounding has 1e-15 of it."""

MIN_RELATIVE_VARIANCE = 1e-3
"""Lower bound on the variance relative to its mean: a dark sample is then worth at most 1000 usual ones."""


LEAST_ITERATED_VARIANCE = 1e-12
"""Relative variance that is added while the coefficients are fitted: samples without noise would divide by zero."""


class ResidualNoise(NamedTuple):
    """Variance ``floor + slope * (f - dark) + place * |∇f|²`` for the expected value f, in the square of its unit.

    Read noise and photon noise, as in :class:`recon.imaging.pixel_noise.SampleNoise`, and the detail that the kernel
    smooths, which displaces edges by ``place`` [px²] in the mean square. ``f - dark`` is at least 0.
    """

    floor: float
    slope: float
    place: float
    dark: float

    def at(self, expected: Array, gradient: Array) -> Array:
        """Variance at expected values and squared gradients [1/px²] of any shape."""
        return self.floor + self.slope * np.maximum(expected - self.dark, 0.0) + self.place * gradient


def fit_residual_noise(expected: Array, gradient: Array, residual: Array) -> ResidualNoise:
    """Return the variance under which normal residuals are most likely, with coefficients that are not negative.

    The updates are multiplicative and never lower the likelihood (Févotte and Idier 2011, "Algorithms for nonnegative
    matrix factorization with the β-divergence", eq. 4.1 for β = 0). Least squares would follow the few brightest
    samples, whose squared residuals scatter most.

    Args:
        expected: value of the picture, shape (n,).
        gradient: its squared gradient, shape (n,) [1/px²].
        residual: shape (n,).
    """
    lowest = int(np.ceil(LOWEST * expected.size))
    least_unit = MIN_VARIANCE_OF_SIGNAL * (float(np.mean(expected**2)) if lowest else 0.0) or 1.0
    if not lowest or not residual.any():
        return ResidualNoise(least_unit, 0.0, 0.0, 0.0)
    dark = float(np.mean(np.partition(expected, lowest - 1)[:lowest]))
    terms = np.column_stack([np.ones_like(expected), np.maximum(expected - dark, 0.0), gradient])
    square = residual**2
    unit, sizes = max(float(square.mean()), least_unit), np.maximum(terms.mean(axis=0), 1e-300)
    relative = _most_likely(terms / sizes, square / unit, np.full(sizes.size, 1.0 / sizes.size))
    floor, slope, place = (unit * each / size for each, size in zip(relative, sizes, strict=True))
    least = MIN_RELATIVE_VARIANCE * unit
    return ResidualNoise(max(floor, least), slope, place, dark)


@njit(cache=True)
def _most_likely(terms, square, values):  # type: ignore[no-untyped-def]
    """Coefficients, from positive ones, of the terms of the variance of values with squares whose mean is 1."""
    for _ in range(ROUNDS):
        up, down = np.zeros(values.size), np.zeros(values.size)
        for i in range(square.size):
            variance = LEAST_ITERATED_VARIANCE
            for j in range(values.size):
                variance += values[j] * terms[i, j]
            for j in range(values.size):
                up[j] += terms[i, j] * square[i] / variance / variance
                down[j] += terms[i, j] / variance
        for j in range(values.size):
            if down[j] > 0.0:
                values[j] *= np.sqrt(up[j] / down[j])
    return values[0], values[1], values[2]
