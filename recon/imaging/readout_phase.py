"""The phase error of the readout, measured in the picture and removed from the motion.

The sense signal follows fast changes of the phase to 0.01°. A delay, an amplifier pole, feedthrough of the drive or a
curved characteristic that the device file does not state shifts its phase by an amount that varies slowly. The
self-crossings of the scan (``bidirectional_phase``) measure the same phase without the readout. The model of an axis is

    β(t) = c + g(t) + s(t),   c ~ N(0, σ0²),

with β the true phase minus the phase of the estimator, measured with independent errors in short parts of the scan. g
and s are Gaussian processes with Matérn-3/2 covariances (σ1², τ) and (σs(t)², τ). c and g are the error of the readout;
s is the random error of the estimator, σs the standard deviation that it states. The picture measures s too, so the
variance of the corrected phase is the posterior variance of β. The hyperparameters σ0, σ1, τ and a factor on the
standard errors are averaged over by their marginal likelihood (Rasmussen and Williams 2006, eq. 2.30).
σ0 = 0 and σ1 = 0, a readout as stated, have half of the prior probability each, so that a correct readout keeps the
precision that the sense signal gives.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from recon.imaging.bidirectional_phase import PhaseError, PhaseEstimate
from scanner.arrays import Array
from scanner.device import AXES
from scanner.motion import AxisMotion, Motion

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
MIN_DRIFT_SLICES = 3
"""Slices from which the error may vary with time. In a shorter scan neighbouring parts have the holes of the picture in
common, which resembles a drift."""
PRIOR_PROBABILITY_AS_STATED = 0.5
"""Prior probability that the constant, and independently that the varying part, is zero: no preference either way."""
UNDESCRIBED_DELAY_SD_S = 0.5e-6
"""Standard deviation of the delay of electronics that no device file describes, where no picture measures it: cables,
converters and amplifiers are late by up to a microsecond."""
REPORTED_SDS = 3.0
"""Standard deviations from which a phase error is reported, or a growing change refutes it: 0.3 % of noise exceeds."""
MAX_SLICE_SPREAD_RAD = 2.0 * DRIFT_SDS_RAD[-1]
"""Largest difference between the phase errors of two slices: two standard deviations of the largest drift. In a pattern
that repeats within the reach of the registration, slices agree on no period."""
MAX_ROUNDS = 3
"""Registrations about an improved motion: an error of 10° needs two, because the picture itself sharpens."""
CONVERGENCE_SD = 0.5
"""Change of the phase in standard deviations at which the rounds end."""
POSTERIOR_TIMES = 200
"""Times at which the posterior is evaluated in addition to those of the measurements: 0.3 ms apart in a scan of 60
ms."""


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


def correlate_matern32(lag: Array, time: float) -> Array:
    """Matérn-3/2 correlation at differences ``lag`` [s], of any shape, with the correlation time ``time`` [s]."""
    scaled = math.sqrt(3.0) * np.abs(lag) / time
    return np.asarray((1.0 + scaled) * np.exp(-scaled))


def estimate_readout_phase(
    time: Array,
    value: Array,
    sd: Array,
    at: Array,
    sense_sd: float | Array = 0.0,
    may_drift: bool = True,
    earlier: tuple[float, float] | None = None,
) -> ReadoutPhase | None:
    """Posterior of a phase error from measurements in the picture; None without a measurement.

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
    hypotheses = [(*drift, factor) for drift in drifts for factor in NOISE_FACTORS]
    offset_var = np.concatenate([[0.0], OFFSET_SDS_RAD**2])
    share = (1.0 - PRIOR_PROBABILITY_AS_STATED) / OFFSET_SDS_RAD.size
    offset_prior = np.concatenate([[PRIOR_PROBABILITY_AS_STATED], np.full(OFFSET_SDS_RAD.size, share)])
    if earlier is not None:
        offset_var, offset_prior = np.array([expected_var]), np.ones(1)
    average = np.gradient(at) / np.gradient(at).sum()
    log_weight, means, variances, totals, total_vars = [], [], [], [], []
    for drift_sd, tau, prior, factor in hypotheses:
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
        means.append(across.T @ solved_value + constant[:, None] * left)
        variances.append(np.maximum(drift_sd**2 + sense_sd**2 - explained, 0.0) + constant_var[:, None] * left**2)
        totals.append(mean_across @ solved_value + constant * mean_left)
        total_vars.append(mean_variance + constant_var * mean_left**2)
    weight = np.exp(np.concatenate(log_weight) - np.max(log_weight))
    weight /= weight.sum()
    mean, total = np.concatenate(means), np.concatenate(totals)
    overall, posterior = weight @ total, weight @ mean
    total_var = weight @ (np.concatenate(total_vars) + total**2) - overall**2
    variance = weight @ (np.concatenate(variances) + mean**2) - posterior**2
    total_sd = math.sqrt(max(total_var, 0.0))
    return ReadoutPhase(float(overall + expected), total_sd, at, posterior + expected, np.maximum(variance, 0.0))


def remove_readout_phase(
    motion: Motion, errors: Sequence[PhaseError], register: Callable[[Motion], list[PhaseError]]
) -> tuple[Motion, list[PhaseError], Mapping[str, ReadoutPhase]]:
    """Correct a motion by the phase error of its readout that the picture shows.

    A picture about the corrected motion that determines no phase, or a larger change than the round before, refutes the
    correction: the axis then counts as undetermined. A pattern that repeats would else alternate between two phases.

    Args:
        motion: of both axes.
        errors: its phase errors.
        register: measures the phase errors of a corrected motion.

    Returns:
        The corrected motion, whose ``phase_sd`` is that of sense signal and picture together; its phase errors; and the
        error that was removed by axis, without the axes of which the picture determines none. Their ``phase_sd`` allows
        for electronics that nobody described.
    """
    corrected, found = motion, dict[str, ReadoutPhase]()
    changes: dict[str, list[float]] = {name: [] for name in AXES}
    refuted: set[str] = set()
    for last in (False,) * (MAX_ROUNDS - 1) + (True,):
        axes = dict(motion.axes)
        for column, name in enumerate(AXES):
            axis = motion.axes[name]
            measured = measured_phase_error(errors, column, axis, corrected.axes[name])
            times = posterior_times(axis, measured[0])
            sense_sd = np.interp(times, axis.time, axis.phase_sd)
            estimate = estimate_readout_phase(*measured, times, sense_sd, len(errors) >= MIN_DRIFT_SLICES)
            if estimate is not None:
                axes[name] = advance_axis(axis, estimate)
                moved = axes[name].phase - corrected.axes[name].phase
                changes[name].append(float(np.max(np.abs(moved) / axes[name].phase_sd)))
            if name in found and (estimate is None or changes[name][-1] > max(changes[name][-2], REPORTED_SDS)):
                refuted.add(name)  # rounds that converge change less and less, down to their noise
            if estimate is None or name in refuted:
                found.pop(name, None)
                axes[name] = widen_undetermined(axis)
            else:
                found[name] = estimate
        before, corrected = corrected, replace(motion, axes=axes)
        if last or all(changes[name][-1] < CONVERGENCE_SD for name in found):
            break
        errors = register(corrected)
    return corrected, _errors_after(errors, before, corrected), found


def measured_phase_error(
    errors: Sequence[PhaseError], column: int, axis: AxisMotion, corrected: AxisMotion
) -> tuple[Array, Array, Array]:
    """Times [s], phase errors [rad] of ``axis`` and standard deviations [rad] from those of its corrected motion.

    The standard deviations are infinite if the slices contradict each other or most of them determine nothing.

    Args:
        errors: of the corrected motion.
        column: 0 for x, 1 for y.
        axis, corrected: the motion before and after a correction.
    """
    parts = [error.parts for error in errors if error.parts is not None]
    time, value, sd = (np.concatenate(column) for column in zip(*parts, strict=True))
    time = axis.angle.start + time
    slices = np.array([getattr(error, AXES[column]).value for error in errors])
    determined = slices[np.isfinite(slices)]
    if 2 * determined.size < slices.size or np.ptp(determined) > MAX_SLICE_SPREAD_RAD:
        sd = np.full_like(sd, np.inf)
    return time, value[:, column] + np.interp(time, axis.time, corrected.phase - axis.phase), sd[:, column]


def advance_axis(axis: AxisMotion, error: ReadoutPhase) -> AxisMotion:
    """The motion ahead by a phase error, with the standard deviation of that error, which includes the motion's."""
    variance = np.interp(axis.time, error.time, error.variance)
    ahead = axis.advanced(np.interp(axis.time, error.time, error.mean))
    return replace(ahead, phase_sd=np.sqrt(variance))


def widen_undetermined(axis: AxisMotion) -> AxisMotion:
    """The motion with the uncertainty of a readout that the picture does not measure in its ``phase_sd``."""
    return replace(axis, phase_sd=np.sqrt(axis.phase_sd**2 + _undescribed_variance(axis)))


def _undescribed_variance(axis: AxisMotion) -> Array:
    """Variance of the phase by a delay that the device file does not state [rad^2].

    That of a readout which has one: averaged with readouts as stated, half of them, the interval of ± 1.96 standard
    deviations would hold 92 % of this prior.
    """
    return np.square(2.0 * np.pi * axis.frequency * UNDESCRIBED_DELAY_SD_S)


def describe_readout_phase(motion: Motion, found: Mapping[str, ReadoutPhase]) -> list[str]:
    """What a reader has to know of the phase error of the readout, a line each.

    Args:
        motion: corrected.
        found: the error that was removed, by axis.
    """
    notes = [
        f"the picture determines no phase of {name}: no feature across it, a pattern that repeats, or too few photons. "
        f"The standard deviation of the phase allows for {UNDESCRIBED_DELAY_SD_S * 1e6:.2g} µs of readout delay that "
        f"the device file does not state; without such a delay it is {_sd_as_stated(motion.axes[name]):.2g}°. "
        "A specimen with detail, more light or a longer scan narrows it"
        for name in AXES
        if name not in found
    ]
    late = {name: error for name, error in found.items() if abs(error.value) > REPORTED_SDS * error.sd}
    for name, error in late.items():
        notes.append(
            f"the signal of {name} is {abs(np.degrees(error.value)):.3g}° ± {np.degrees(error.sd):.1g}° "
            f"{'late' if error.value > 0.0 else 'early'}; its phase was corrected by the picture"
        )
    delay = common_delay(motion, found) if late else None
    if delay is not None:
        pole = f" or a pole near {1e-3 / (2.0 * np.pi * delay):.2g} kHz" if delay > 0.0 else ""
        notes.append(
            f"a delay of {1e6 * delay:.2g} µs{pole} in the readout would explain the error of both axes; "
            "run `lissajous diagnose`"
        )
    return notes


def _sd_as_stated(axis: AxisMotion) -> float:
    """Standard deviation of the phase, rms [deg], if the readout is as the device file states; axis: widened."""
    variance = np.maximum(axis.phase_sd**2 - _undescribed_variance(axis), 0.0)
    return float(np.degrees(np.sqrt(np.mean(variance))))


def common_delay(motion: Motion, found: Mapping[str, ReadoutPhase]) -> float | None:
    """The delay [s] that explains the phase errors of both axes within their uncertainty; None if none does."""
    if len(found) < len(AXES):
        return None
    rate = np.array([2.0 * np.pi * np.median(motion.axes[name].frequency) for name in found])
    value, sd = np.array([(error.value, error.sd) for error in found.values()]).T
    delay = float(np.sum(rate * value / sd**2) / np.sum(rate**2 / sd**2))
    misfit = np.sum(((value - rate * delay) / sd) ** 2)
    return delay if misfit < REPORTED_SDS**2 else None


def posterior_times(axis: AxisMotion, measured: Array) -> Array:
    """Return the times of the posterior: evenly over the scan, and those of the measurements, increasing [s]."""
    return np.unique(np.concatenate([np.linspace(axis.time[0], axis.time[-1], POSTERIOR_TIMES), measured]))


def _errors_after(errors: Sequence[PhaseError], before: Motion, after: Motion) -> list[PhaseError]:
    """Phase errors of the motion ``after``, from those of the motion ``before`` that lies within their reach."""
    moved = []
    for error in errors:
        values, parts = {}, error.parts and error.parts._replace(value=error.parts.value.copy())
        for column, name in enumerate(AXES):
            old, new = before.axes[name], after.axes[name]
            estimate: PhaseEstimate = getattr(error, name)

            def shift(time: float | Array, old: AxisMotion = old, new: AxisMotion = new) -> Array:
                return np.interp(old.angle.start + np.asarray(time), old.time, new.phase - old.phase)

            values[name] = estimate._replace(value=estimate.value - float(shift(error.time)))
            if parts is not None:
                parts.value[:, column] -= shift(parts.time)
        moved.append(replace(error, x=values["x"], y=values["y"], parts=parts))
    return moved
