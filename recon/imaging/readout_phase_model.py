"""Posterior of the phase error of a readout, given its measurements in the picture.

The model of an axis is

    β(t) = c + g(t) + s(t),   c ~ N(0, σ0²),

with β the true phase minus the phase of the estimator, measured with independent errors in short parts of the scan. g
and s are Gaussian processes with Matérn-3/2 covariances (σ1², τ) and (σs(t)², τ). c and g are the error of the readout;
s is the random error of the estimator, σs the standard deviation that it states. The picture measures s too, so the
variance of the corrected phase is the posterior variance of β. The hyperparameters σ0, σ1, τ and a factor on the
standard errors are averaged over by their marginal likelihood (Rasmussen and Williams 2006, eq. 2.30).
σ0 = 0 and σ1 = 0, a readout as stated, have half of the prior probability each, so that a correct readout keeps the
precision that the sense signal gives. Whether the readout varies (σ1 > 0) is common to both axes, because the same
electronics read them: the axis that the picture determines better decides it for both. The constant is not common,
because feedthrough of one drive shifts one axis alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from scanner.arrays import Array

OFFSET_SDS_RAD = np.radians([0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0])
"""Standard deviations σ0 that a constant phase error may have: half decades from a thirtieth of the usual bound of
0.286°, below which no picture changes, to the reach of the registration."""
DRIFT_SDS_RAD = np.radians([0.01, 0.03, 0.1, 0.3, 1.0])
"""Standard deviations σ1 that the varying part may have: half decades; no readout varies by more."""
DRIFT_TIMES_S = (3e-3, 10e-3, 30e-3)
"""Correlation times τ that it may have: half decades up to the length of a scan. The sense signal determines faster
changes better than the picture."""
SENSE_ERROR_TIMES_S = (1e-3, *DRIFT_TIMES_S)
"""Correlation times τ of the estimator's error, equally probable: half decades down to 1 ms, which the error has in 1/f
noise beside an amplifier's resonance. It is longer in white noise."""
NOISE_FACTORS = np.array([1.0, 2.0, 4.0])
"""Factors on the standard errors of the measurements, equally probable. Detail that the registration does not resolve
acts on short parts as additional noise."""
PRIOR_PROBABILITY_AS_STATED = 0.5
"""Prior probability that the constant, and independently that the varying part, is zero: no preference either way."""


@dataclass(frozen=True)
class ReadoutPhase:
    """Posterior of the phase error of one axis: true phase minus estimated phase, positive for a late sense signal.

    Attributes:
        value, sd: of the mean of the readout's error over the scan, without the estimator's random error [rad].
        time: shape (n,), increasing [s].
        mean, variance: of both together at these times, shape (n,) [rad, rad²].
    """

    value: float
    sd: float
    time: Array
    mean: Array
    variance: Array


class Hypotheses(NamedTuple):
    """Posteriors of the phase error of one axis, one for each combination of hyperparameters.

    Attributes:
        time: increasing, shape (m,) [s].
        log_weight: logarithm of prior probability times marginal likelihood, shape (h,).
        drifts: whether σ1 is above zero, shape (h,).
        mean, variance: of β at ``time``, shape (h, m) [rad, rad²].
        total, total_variance: of the mean of c + g over the scan, shape (h,) [rad, rad²].
    """

    time: Array
    log_weight: Array
    drifts: NDArray[np.bool_]
    mean: Array
    variance: Array
    total: Array
    total_variance: Array

    def log_evidence(self) -> Array:
        """Logarithm of the summed weights without and with a drift, shape (2,)."""
        evidence = np.full(2, -np.inf)
        np.logaddexp.at(evidence, self.drifts.astype(int), self.log_weight)
        return evidence

    def average(self, other_evidence: Array | None = None) -> ReadoutPhase:
        """The posterior averaged over the hypotheses.

        Args:
            other_evidence: that of the other axis without and with a drift, as in ``log_evidence``.
        """
        log_weight = self.log_weight
        if other_evidence is not None:
            log_weight = log_weight + other_evidence[self.drifts.astype(int)]
        weight = np.exp(log_weight - np.max(log_weight))
        weight /= weight.sum()
        value, mean = weight @ self.total, weight @ self.mean
        value_variance = weight @ (self.total_variance + self.total**2) - value**2
        variance = weight @ (self.variance + self.mean**2) - mean**2
        return ReadoutPhase(
            float(value), math.sqrt(max(float(value_variance), 0.0)), self.time, mean, np.maximum(variance, 0.0)
        )


def correlate_matern32(lag: Array, time: float) -> Array:
    """Matérn-3/2 correlation at differences ``lag`` [s], of any shape, with the correlation time ``time`` [s]."""
    scaled = math.sqrt(3.0) * np.abs(lag) / time
    return np.asarray((1.0 + scaled) * np.exp(-scaled))


def weigh_hypotheses(
    time: Array,
    value: Array,
    sd: Array,
    at: Array,
    sense_sd: float | Array = 0.0,
    may_drift: bool = True,
    earlier: tuple[float, float] | None = None,
) -> Hypotheses | None:
    """Posteriors of a phase error from measurements in the picture; None without a measurement.

    Args:
        time: of the measurements, shape (n,) [s].
        value, sd: phase errors and standard deviations, shape (n,) [rad]; an infinite sd is no measurement.
        at: times of the posterior, shape (m,), m > 1, increasing [s].
        sense_sd: standard deviation that the estimator states for its phase, a number or shape (m,) [rad]; 0 leaves
            its error out of the posterior.
        may_drift: whether the error may vary with time.
        earlier: mean [rad] and variance [rad²] of the constant by earlier parts of the scan, in the place of the prior.
    """
    used = np.isfinite(value) & np.isfinite(sd)
    if not used.any():
        return None
    expected, expected_var = earlier or (0.0, 0.0)
    time, value, noise = time[used], value[used] - expected, np.diag(sd[used] ** 2)
    sense_sd = np.broadcast_to(sense_sd, at.shape)
    measured_sd = np.interp(time, at, sense_sd)
    share = PRIOR_PROBABILITY_AS_STATED / len(SENSE_ERROR_TIMES_S)
    drifts = [(0.0, tau, share) for tau in SENSE_ERROR_TIMES_S]  # standard deviation, correlation time, probability
    share = (1.0 - PRIOR_PROBABILITY_AS_STATED) / (DRIFT_SDS_RAD.size * len(DRIFT_TIMES_S))
    if may_drift:
        drifts += [(drift_sd, tau, share) for drift_sd in DRIFT_SDS_RAD for tau in DRIFT_TIMES_S]
    combinations = [(*drift, factor) for drift in drifts for factor in NOISE_FACTORS]
    offset_var = np.concatenate([[0.0], OFFSET_SDS_RAD**2])
    share = (1.0 - PRIOR_PROBABILITY_AS_STATED) / OFFSET_SDS_RAD.size
    offset_prior = np.concatenate([[PRIOR_PROBABILITY_AS_STATED], np.full(OFFSET_SDS_RAD.size, share)])
    if earlier is not None:
        offset_var, offset_prior = np.array([expected_var]), np.ones(1)
    average = np.gradient(at) / np.gradient(at).sum()
    log_weight, means, variances, totals, total_vars = [], [], [], [], []
    for drift_sd, tau, prior, factor in combinations:
        within = (drift_sd**2 + np.outer(measured_sd, measured_sd)) * correlate_matern32(time[:, None] - time, tau)
        correlation = correlate_matern32(time[:, None] - at, tau)
        across = (drift_sd**2 + np.outer(measured_sd, sense_sd)) * correlation
        covariance = cho_factor(factor**2 * noise + within, lower=True)
        solved_value, solved_one = cho_solve(covariance, value), cho_solve(covariance, np.ones_like(value))
        log_det = 2.0 * np.log(np.diag(covariance[0])).sum()
        left = 1.0 - across.T @ solved_one  # of a constant, what the varying part does not follow, shape (m,)
        explained = (solve_triangular(covariance[0], across, lower=True) ** 2).sum(axis=0)
        mean_across = drift_sd**2 * (correlation @ average)
        mean_left = 1.0 - mean_across @ solved_one
        between = drift_sd**2 * (average @ correlate_matern32(at[:, None] - at, tau) @ average)
        mean_variance = max(between - mean_across @ cho_solve(covariance, mean_across), 0.0)
        # The constant adds σ0² 1 1ᵀ to the covariance: its posterior variance and mean follow from two inner products.
        information, score = solved_one.sum(), solved_value.sum()
        constant_var = offset_var / (1.0 + offset_var * information)
        constant = constant_var * score
        log_weight.append(
            np.log(prior * offset_prior)
            - 0.5 * (value @ solved_value - constant * score + log_det + np.log1p(offset_var * information))
        )
        means.append(expected + across.T @ solved_value + constant[:, None] * left)
        variances.append(np.maximum(drift_sd**2 + sense_sd**2 - explained, 0.0) + constant_var[:, None] * left**2)
        totals.append(expected + mean_across @ solved_value + constant * mean_left)
        total_vars.append(mean_variance + constant_var * mean_left**2)
    return Hypotheses(
        at,
        np.concatenate(log_weight),
        np.repeat([drift_sd > 0.0 for drift_sd, *_ in combinations], offset_var.size),
        *(np.concatenate(each) for each in (means, variances, totals, total_vars)),
    )


def average_jointly(axes: Mapping[str, Hypotheses]) -> dict[str, ReadoutPhase]:
    """The averaged posterior of each axis, with a drift in all axes or in none."""
    evidence = {name: axis.log_evidence() for name, axis in axes.items()}
    return {
        name: axis.average(sum((each for other, each in evidence.items() if other != name), np.zeros(2)))
        for name, axis in axes.items()
    }
