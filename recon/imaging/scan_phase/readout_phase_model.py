"""Posterior of the phase error of a readout, given its measurements in the picture.

The model of an axis is

    β(t) = ω·T + c + g(t) + s(t),   T ~ N(0, σT²),   c ~ N(0, σ0²),

with β the true phase minus the phase of the estimator, measured with independent errors in short parts of the scan,
and ω the angular frequency of the axis. T is the delay of a readout that both axes have in common (a pole far above the
signal acts as one), c a constant of one axis alone, as feedthrough of its drive causes. g and s are Gaussian processes
with Matérn-3/2 covariances (σ1², τ) and (σs(t)², τ). T, c and g are the error of the readout; s is the random error of
the estimator, σs the standard deviation that it states. The picture measures s too, so the variance of the corrected
phase is the posterior variance of β. The hyperparameters σT, σ0, σ1, τ and a factor on the standard errors are averaged
over by their marginal likelihood (Rasmussen and Williams 2006, eq. 2.30).
σT = 0, σ0 = 0 of both axes and σ1 = 0, a readout as stated, have half of the prior probability each, so that a correct
readout keeps the precision that the sense signal gives. Whether the readout varies (σ1 > 0) is common to both axes,
because the same electronics read them: the axis that the picture determines better decides it for both. Axes with
readouts of their own have no T, and c is as large as it may be.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.special import logsumexp

from estimation.curve_smoother import NOISE_FACTORS
from recon.imaging.normal_density import normal_log_density
from scanner.arrays import Array

OFFSET_SDS_RAD = np.radians([0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0])
"""Standard deviations that a constant phase error may have: half decades from a thirtieth of the usual bound of 0.286°,
below which no picture changes, to the reach of the registration. They are those of c where each axis has a readout of
its own, and of ω·T of the faster axis where both have one in common."""
OWN_OFFSET_SDS_RAD = OFFSET_SDS_RAD[:4]
"""Standard deviations σ0 of an axis that shares its readout: up to 0.3°, because feedthrough of 1 % of the signal
shifts the phase by 0.6° at most, which is two of them."""
DRIFT_SDS_RAD = np.radians([0.01, 0.03, 0.1, 0.3, 1.0])
"""Standard deviations σ1 that the varying part may have: half decades; no readout varies by more."""
DRIFT_TIMES_S = (3e-3, 10e-3, 30e-3)
"""Correlation times τ that it may have: half decades up to the length of a scan. The sense signal determines faster
changes better than the picture."""
SENSE_ERROR_TIMES_S = (1e-3, *DRIFT_TIMES_S)
"""Correlation times τ of the estimator's error, equally probable: half decades down to 1 ms, which the error has in 1/f
noise beside an amplifier's resonance. It is longer in white noise."""
PRIOR_PROBABILITY_AS_STATED = 0.5
"""Prior probability that the delay is zero, and independently that all constants of single axes are, and that the
varying part is: no preference either way."""
DELAY_STEPS = 61
"""Delays about each centre in the integral over T: less than half a standard deviation apart at the centre, further
apart in proportion to the distance from it."""
DELAY_REACH_SD = 5.0
"""Distance of the outermost delays from their centre, in the largest standard deviation that a delay may have."""


@dataclass(frozen=True)
class ReadoutPhase:
    """Posterior of the phase error of one axis: true phase minus estimated phase, positive for a late sense signal.

    Attributes:
        value, sd: of the mean of the readout's error over the scan, without the estimator's random error [rad].
        time: shape (n,), increasing [s].
        mean, variance: of both together at these times, shape (n,) [rad, rad²].
        measured: whether the picture shows it; else it follows from the delay that the other axis shows.
    """

    value: float
    sd: float
    time: Array
    mean: Array
    variance: Array
    measured: bool


class Hypotheses(NamedTuple):
    """What the measurements of one axis say of its constant phase error k, for each model of the varying part.

    The likelihood of k is exp(score·k − information·k²/2), and β is mean + left·k.

    Attributes:
        time: increasing, shape (m,) [s].
        log_weight: logarithm of prior probability times marginal likelihood where k is zero, shape (h,).
        drifts: whether σ1 is above zero, shape (h,).
        information, score: of k, shape (h,) [1/rad², 1/rad].
        mean, left, variance: of β at ``time`` for a known k, shape (h, m) [rad, 1, rad²].
        total, total_left, total_variance: of the mean of k + g over the scan, shape (h,) [rad, 1, rad²].
    """

    time: Array
    log_weight: Array
    drifts: NDArray[np.bool_]
    information: Array
    score: Array
    mean: Array
    left: Array
    variance: Array
    total: Array
    total_left: Array
    total_variance: Array

    @property
    def determines_constant(self) -> bool:
        """Whether there is a measurement."""
        return bool(np.any(self.information > 0.0))


class ConstantPrior(NamedTuple):
    """Prior of a constant: a mixture of normal distributions with one mean.

    Attributes:
        mean: [rad].
        variance, log_probability: of the components, shape (k,) [rad², 1].
    """

    mean: float
    variance: Array
    log_probability: Array


def constant_prior(sds: Array, as_stated: float = PRIOR_PROBABILITY_AS_STATED) -> ConstantPrior:
    """Zero with the probability ``as_stated``, else with one of the standard deviations, shape (k,) [rad]."""
    probability = np.concatenate([[as_stated], np.full(sds.size, (1.0 - as_stated) / sds.size)])
    return ConstantPrior(0.0, np.concatenate([[0.0], sds**2]), np.log(probability))


def correlate_matern32(lag: Array, time: float) -> Array:
    """Matérn-3/2 correlation at differences ``lag`` [s], of any shape, with the correlation time ``time`` [s]."""
    scaled = math.sqrt(3.0) * np.abs(lag) / time
    return np.asarray((1.0 + scaled) * np.exp(-scaled))


def weigh_hypotheses(
    time: Array, value: Array, sd: Array, at: Array, sense_sd: float | Array = 0.0, may_drift: bool = True
) -> Hypotheses:
    """Models of the varying part of a phase error, weighed by measurements in the picture.

    Args:
        time: of the measurements, shape (n,) [s].
        value, sd: phase errors and standard deviations, shape (n,) [rad]; an infinite sd is no measurement.
        at: times of the posterior, shape (m,), m > 1, increasing [s].
        sense_sd: standard deviation that the estimator states for its phase, a number or shape (m,) [rad]; 0 leaves
            its error out of the posterior.
        may_drift: whether the error may vary with time.
    """
    used = np.isfinite(value) & np.isfinite(sd)
    time, value, noise = time[used], value[used], np.diag(sd[used] ** 2)
    sense_sd = np.broadcast_to(sense_sd, at.shape)
    measured_sd = np.interp(time, at, sense_sd)
    share = PRIOR_PROBABILITY_AS_STATED / len(SENSE_ERROR_TIMES_S)
    drifts = [(0.0, tau, share) for tau in SENSE_ERROR_TIMES_S]  # standard deviation, correlation time, probability
    share = (1.0 - PRIOR_PROBABILITY_AS_STATED) / (DRIFT_SDS_RAD.size * len(DRIFT_TIMES_S))
    if may_drift:
        drifts += [(drift_sd, tau, share) for drift_sd in DRIFT_SDS_RAD for tau in DRIFT_TIMES_S]
    average = np.gradient(at) / np.gradient(at).sum()
    rows = []
    for drift_sd, tau, prior in drifts:
        within = (drift_sd**2 + np.outer(measured_sd, measured_sd)) * correlate_matern32(time[:, None] - time, tau)
        correlation = correlate_matern32(time[:, None] - at, tau)
        across = (drift_sd**2 + np.outer(measured_sd, sense_sd)) * correlation
        mean_across = drift_sd**2 * (correlation @ average)
        between = drift_sd**2 * (average @ correlate_matern32(at[:, None] - at, tau) @ average)
        for factor in NOISE_FACTORS:
            covariance = cho_factor(factor**2 * noise + within, lower=True)
            solved_value, solved_one = cho_solve(covariance, value), cho_solve(covariance, np.ones_like(value))
            explained = (solve_triangular(covariance[0], across, lower=True) ** 2).sum(axis=0)
            rows.append((
                np.log(prior) - 0.5 * value @ solved_value - np.log(np.diag(covariance[0])).sum(),
                drift_sd > 0.0,
                solved_one.sum(),
                solved_value.sum(),
                across.T @ solved_value,
                1.0 - across.T @ solved_one,
                np.maximum(drift_sd**2 + sense_sd**2 - explained, 0.0),
                mean_across @ solved_value,
                1.0 - mean_across @ solved_one,
                max(between - mean_across @ cho_solve(covariance, mean_across), 0.0),
            ))  # fmt: skip
    return Hypotheses(at, *(np.array(column) for column in zip(*rows, strict=True)))


def average_separately(hypotheses: Hypotheses, prior: ConstantPrior) -> ReadoutPhase:
    """The posterior of one axis with a prior of its constant."""
    return _average(hypotheses, _weigh_constants(hypotheses, np.zeros(1), prior))


def average_jointly(
    axes: Mapping[str, Hypotheses], rates: Mapping[str, float] | None = None
) -> dict[str, ReadoutPhase]:
    """The posterior of each axis, with a drift in all axes or in none.

    Args:
        axes: what the measurements say, by axis.
        rates: angular frequencies [rad/s] where the axes have a readout in common, whose delay is then a part of the
            model.
    """
    delays, log_prior, prior = np.zeros(1), np.zeros(1), constant_prior(OFFSET_SDS_RAD)
    if rates is not None:
        delays, log_prior = _delay_nodes(axes, rates)
        prior = constant_prior(OWN_OFFSET_SDS_RAD, PRIOR_PROBABILITY_AS_STATED ** (1.0 / len(axes)))
    constants = {
        name: _weigh_constants(axis, delays * (rates[name] if rates else 0.0), prior) for name, axis in axes.items()
    }
    evidence = {name: _evidence_of_drift(axis, constants[name]) for name, axis in axes.items()}
    found = {}
    for name, axis in axes.items():
        others = sum((each for other, each in evidence.items() if other != name), np.zeros(2)) + log_prior[:, None]
        weight = constants[name].log_weight + others[:, axis.drifts.astype(int), None]
        found[name] = _average(axis, constants[name]._replace(log_weight=weight))
    return found


class _Constants(NamedTuple):
    """Posteriors of the constant of an axis, for each of n delays, h hypotheses and k components of its prior.

    Attributes:
        log_weight: logarithm of prior probability times marginal likelihood, shape (n, h, k).
        mean: shape (n, h, k) [rad].
        variance: shape (h, k) [rad²].
    """

    log_weight: Array
    mean: Array
    variance: Array


def _weigh_constants(axis: Hypotheses, late: Array, prior: ConstantPrior) -> _Constants:
    """Posteriors of a constant whose prior is shifted by the phases ``late``, shape (n,) [rad]."""
    information, score = axis.information[:, None], axis.score[:, None]
    expected = prior.mean + late[:, None, None]
    left = score - information * expected  # of the score, at the expected constant
    variance = prior.variance / (1.0 + prior.variance * information)
    log_weight = (
        axis.log_weight[:, None]
        + prior.log_probability
        + (score - 0.5 * information * expected) * expected
        + 0.5 * (left**2 * variance - np.log1p(prior.variance * information))
    )
    return _Constants(log_weight, expected + variance * left, variance)


def _average(axis: Hypotheses, constants: _Constants) -> ReadoutPhase:
    """The posterior averaged over delays, hypotheses and components."""
    weight = np.exp(constants.log_weight - np.max(constants.log_weight))
    weight /= weight.sum()
    by_hypothesis = weight.sum(axis=(0, 2))
    used = by_hypothesis > 0.0
    share = by_hypothesis[used]
    constant = (weight * constants.mean).sum(axis=(0, 2))[used] / share
    square = (weight * (constants.mean**2 + constants.variance)).sum(axis=(0, 2))[used] / share
    constant_var = np.maximum(square - constant**2, 0.0)

    def mix(zero: Array, left: Array, variance: Array) -> tuple[Array, Array]:
        """Mean and variance over the hypotheses of zero + left·constant, which has a variance of its own."""
        means = zero[used] + (constant * left[used].T).T
        variances = variance[used] + (constant_var * (left[used] ** 2).T).T
        mean = share @ means
        return mean, np.maximum(share @ (variances + means**2) - mean**2, 0.0)

    value, value_variance = mix(axis.total, axis.total_left, axis.total_variance)
    mean, variance = mix(axis.mean, axis.left, axis.variance)
    sd = math.sqrt(float(value_variance))
    return ReadoutPhase(float(value), sd, axis.time, mean, variance, axis.determines_constant)


def _delay_nodes(axes: Mapping[str, Hypotheses], rates: Mapping[str, float]) -> tuple[Array, Array]:
    """Delays of a readout [s], shape (n,), and the logarithm of the prior probability that each stands for.

    The first is that of a readout as stated. The others are dense about zero and about the delay that each axis shows,
    down to the precision with which it shows it, so that sums over them are the integrals over the delay.
    """
    sds = OFFSET_SDS_RAD / max(rates.values())
    centres = [(0.0, sds[0])]
    for name, axis in axes.items():
        if axis.determines_constant:
            best = np.argmax(axis.information)
            information = axis.information[best] * rates[name] ** 2
            centres.append((axis.score[best] * rates[name] / information, 1.0 / math.sqrt(information)))
    ends = [np.arcsinh(DELAY_REACH_SD * sds[-1] / width) for _, width in centres]
    delays = np.unique(
        [centre + width * np.sinh(np.linspace(-end, end, DELAY_STEPS))
         for (centre, width), end in zip(centres, ends, strict=True)]
    )  # fmt: skip
    density = normal_log_density(delays[:, None], sds) + constant_prior(sds).log_probability[1:]
    log_prior = logsumexp(density, axis=1) + np.log(np.gradient(delays))
    return np.concatenate([[0.0], delays]), np.concatenate([[math.log(PRIOR_PROBABILITY_AS_STATED)], log_prior])


def _evidence_of_drift(axis: Hypotheses, constants: _Constants) -> Array:
    """Logarithm of the summed weights of the hypotheses without and with a drift, by delay, shape (n, 2)."""
    sums = logsumexp(constants.log_weight, axis=2)  # by delay and hypothesis
    columns = [np.where(axis.drifts == drift, sums, -np.inf) for drift in (False, True)]
    return np.stack([logsumexp(column, axis=1) for column in columns], axis=1)
