"""Slow noise that rises more steeply below the measured bands than its spectrum is extrapolated there.

A drift of the baseline and 1/f noise fill the same few half bins at the low end of the spectrum. What a steeper
spectrum explains of a misfit is no evidence for a drift.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct
from scipy.optimize import minimize_scalar

from estimation.device_fit.fit import Fit, Likelihood
from estimation.device_fit.noise import Whitener
from estimation.least_squares import gaussian_posterior
from scanner.arrays import Array, Mask

SLOPE_PRIOR_SD = 0.6
"""Prior standard deviation of the exponent by which slow noise may rise more steeply than extrapolated. Two medians of
``MIN_BINS_PER_BAND`` bins determine the exponent no better."""

MAX_SLOPE = 2.0
"""Largest exponent by which the spectrum may rise more steeply: that of a random walk above flat noise, which no drift
of electronics exceeds for long."""


MAX_SLOW_HALF_BINS = 1000
"""Largest number of half bins below the lowest measured one that count as slow noise. Where the lines of a multisine
leave only high frequencies to measure noise in, all below is unknown, and the products of the bins need much memory."""


class _SlowPart(NamedTuple):
    """The slowest cosines of one whitened channel, in which the noise is extrapolated.

    Attributes:
        reach: logarithm of the lowest measured frequency over that of each cosine, shape (k,).
        amplitudes: of the cosines in the columns, shape (k, q).
        products: of the cosines with the columns over the fitted samples, shape (k, q).
        overlap: of the cosines with each other over the fitted samples, shape (k, k).
        share: of the samples that are fitted.
    """

    reach: Array
    amplitudes: Array
    products: Array
    overlap: Array
    share: float

    def weakening(self, slope: float) -> Array:
        """Change of the inner products of the columns with a spectrum that rises more steeply, shape (q, q)."""
        removed = -np.expm1(-0.5 * slope * self.reach)[:, None] * self.amplitudes
        mixed = self.products.T @ removed
        return np.asarray(removed.T @ self.overlap @ removed - mixed - mixed.T)

    def cost(self, slope: float) -> float:
        """-2 log of the determinant and of the prior probability of a slope."""
        return float(self.share * slope * self.reach.sum() + (slope / SLOPE_PRIOR_SD) ** 2)


def steeper_noise_gain(likelihood: Likelihood, fit: Fit) -> float:
    """Fall of a fit's -2 log evidence if the slow noise of every channel rises more steeply than extrapolated.

    All parameters of the fit are estimated again under that noise, in the linear model around the fit.
    """
    whiteners = [whitener for row in likelihood.whiteners for whitener in row]
    columns = np.column_stack([fit.jacobian, fit.residual])
    return gain_of_steeper_noise(whiteners, columns, fit.rows, fit.model.precision, fit.x)


def gain_of_steeper_noise(
    whiteners: Sequence[Whitener], columns: Array, rows: Mask, precision: Array, x: Array
) -> float:
    """Fall of -2 log evidence of a linear model by the slope of every channel's slow noise, the best of each in turn.

    The model is linear in the change of the parameters: those of a precise signal are so well determined that the
    misfit in terms of their values would be lost in rounding.

    Args:
        whiteners: of all channels in order, n whitened samples together.
        columns: whitened sensitivities to p parameters and, last, the residual, shape (n, p + 1).
        rows: samples that are fitted, shape (n,).
        precision: of the parameters' priors, whose means are 0.
        x: parameters at the residual, shape (p,).
    """
    fitted = columns[rows]
    gram, gain = fitted.T @ fitted, 0.0
    root = precision**-0.5

    def neg2_log_evidence(inner_products: Array) -> float:
        score = -inner_products[:-1, -1] - precision * x
        posterior = gaussian_posterior(inner_products[:-1, :-1], score, root)
        return float(inner_products[-1, -1]) + posterior.neg2_log_evidence

    for part in _slow_parts(whiteners, columns, rows):
        before = neg2_log_evidence(gram)

        def change(slope: float, part: _SlowPart = part, gram: Array = gram, before: float = before) -> float:
            return neg2_log_evidence(gram + part.weakening(slope)) + part.cost(slope) - before

        best = minimize_scalar(change, bounds=(0.0, MAX_SLOPE), method="bounded")
        if best.fun < 0.0:
            gain, gram = gain - float(best.fun), gram + part.weakening(float(best.x))
    return gain


def _slow_parts(whiteners: Sequence[Whitener], columns: Array, rows: Mask) -> list[_SlowPart]:
    """Of the channels whose noise is extrapolated at its low end."""
    parts, first = [], 0
    for whitener in whiteners:
        samples = slice(first, first + whitener.samples)
        first += whitener.samples
        half_bins = np.arange(1, 2 * int(np.ceil(whitener.first)) - 1)
        if not 0 < half_bins.size <= MAX_SLOW_HALF_BINS:
            continue
        values, used = columns[samples], rows[samples]
        parts.append(
            _SlowPart(
                np.log(whitener.first / (0.5 * half_bins)),
                dct(values, norm="ortho", axis=0)[half_bins],
                dct(values * used[:, None], norm="ortho", axis=0)[half_bins],
                _overlap(used, half_bins),
                float(np.mean(used)),
            )
        )
    return parts


def _overlap(used: Mask, half_bins: NDArray[np.intp]) -> Array:
    """Inner products over the ``used`` of n samples of the normalised cosines of some half bins, shape (k, k).

    The product of two cosines is half the sum of those of the difference and of the sum of their half bins.
    """
    sums = 0.5 * dct(used.astype(float))  # of the cosine of every half bin over the used samples
    sums = np.concatenate([sums, [0.0], -sums[:0:-1]])
    difference, total = np.abs(np.subtract.outer(half_bins, half_bins)), np.add.outer(half_bins, half_bins)
    return np.asarray((sums[difference] + sums[total]) / used.size)
