"""The phase error of the readout, measured in the picture and removed from the motion.

The sense signal follows fast changes of the phase to 0.01°. A delay, an amplifier pole, feedthrough of the drive or a
curved characteristic that the device file does not state shifts its phase by an amount that varies slowly. The
self-crossings of the scan (``bidirectional_phase``) measure the same phase without the readout. ``readout_phase_model``
combines both.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence, Set
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from recon.imaging.scan_phase.phase_error import PhaseError, PhaseEstimate
from recon.imaging.scan_phase.readout_phase_model import (
    DRIFT_SDS_RAD,
    ReadoutPhase,
    average_jointly,
    weigh_hypotheses,
)
from scanner.arrays import Array
from scanner.device import AXES
from scanner.motion import AxisMotion, Motion, rms_phase

MIN_DRIFT_SLICES = 3
"""Slices from which the error may vary with time. In a shorter scan neighbouring parts have the holes of the picture in
common, which resembles a drift."""
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


def remove_readout_phase(
    motion: Motion,
    errors: Sequence[PhaseError],
    register: Callable[[Motion], list[PhaseError]],
    one_readout: bool = False,
) -> tuple[Motion, list[PhaseError], Mapping[str, ReadoutPhase]]:
    """Correct a motion by the phase error of its readout that the picture shows.

    A picture about the corrected motion that determines no phase, or a larger change than the round before, refutes the
    correction: the axis then counts as undetermined. A pattern that repeats would else alternate between two phases.

    Args:
        motion: of both axes.
        errors: its phase errors.
        register: measures the phase errors of a corrected motion.
        one_readout: whether both axes have a readout in common. Its delay shifts both in proportion to their
            frequencies, so that it is known in an axis of which the picture determines no phase.

    Returns:
        The corrected motion, whose ``phase_sd`` is that of sense signal and picture together; its phase errors; and the
        error that was removed by axis, without the axes of which nothing determines it. Their ``phase_sd`` allows for
        electronics that nobody described.
    """
    corrected, found, earlier = motion, dict[str, ReadoutPhase](), dict[str, float]()
    refuted: set[str] = set()
    for last in (False,) * (MAX_ROUNDS - 1) + (True,):
        estimates = _estimate_axes(motion, corrected, errors, refuted, one_readout)
        changes = _changes_sd(motion, corrected, estimates)
        contradicted = {
            name
            for name, error in found.items()
            if error.measured
            and (
                name not in estimates
                or not estimates[name].measured
                or changes[name] > max(earlier[name], REPORTED_SDS)  # rounds that converge change less and less
            )
        }
        if contradicted:
            refuted |= contradicted
            estimates = _estimate_axes(motion, corrected, errors, refuted, one_readout)
            changes = _changes_sd(motion, corrected, estimates)
        found, earlier = estimates, changes
        axes = {
            name: advance_axis(axis, found[name]) if name in found else widen_undetermined(axis)
            for name, axis in motion.axes.items()
        }
        before, corrected = corrected, replace(motion, axes=axes)
        if last or not (contradicted or any(change > CONVERGENCE_SD for change in changes.values())):
            break
        errors = register(corrected)
    # What was measured about a motion that is refuted, the gain of the detector too, is wrong.
    errors = register(corrected) if contradicted else _errors_after(errors, before, corrected)
    return corrected, errors, found


def _estimate_axes(
    motion: Motion, corrected: Motion, errors: Sequence[PhaseError], refuted: Set[str], one_readout: bool
) -> dict[str, ReadoutPhase]:
    """Phase errors of ``motion``, without the axes of which the picture determines none.

    Args:
        motion, corrected: before and after a correction.
        errors: of the corrected motion.
        refuted: axes whose measurements are not used.
        one_readout: as in ``remove_readout_phase``.
    """
    axes = {}
    for column, name in enumerate(AXES):
        axis = motion.axes[name]
        time, value, sd = measured_phase_error(errors, column, axis, corrected.axes[name])
        times = posterior_times(axis, time)
        sense_sd = np.interp(times, axis.time[axis.known], axis.phase_sd[axis.known])
        used_sd = np.full_like(sd, np.inf) if name in refuted else sd
        axes[name] = weigh_hypotheses(time, value, used_sd, times, sense_sd, len(errors) >= MIN_DRIFT_SLICES)
    measured = {name: axis for name, axis in axes.items() if axis.determines_constant}
    if not (one_readout and measured):
        return average_jointly(measured)
    return average_jointly(axes, {name: 2.0 * np.pi * float(np.median(motion.axes[name].frequency)) for name in axes})


def _changes_sd(motion: Motion, corrected: Motion, estimates: Mapping[str, ReadoutPhase]) -> dict[str, float]:
    """Largest change of each estimated phase from ``corrected``, in standard deviations."""
    changes = {}
    for name, estimate in estimates.items():
        axis = motion.axes[name]
        phase = axis.phase + np.interp(axis.time, estimate.time, estimate.mean)
        changes[name] = float(np.max(np.abs(phase - corrected.axes[name].phase) / _advanced_sd(axis, estimate)))
    return changes


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
    """The motion ahead by a phase error, with the standard deviation of that error, which includes the motion's.

    A phase that is not known stays so.
    """
    ahead = axis.advanced(np.interp(axis.time, error.time, error.mean))
    return replace(ahead, phase_sd=_advanced_sd(axis, error))


def _advanced_sd(axis: AxisMotion, error: ReadoutPhase) -> Array:
    """Standard deviation of the phase of a motion ahead by a phase error, shape (n,) [rad]."""
    return np.where(axis.known, np.sqrt(np.interp(axis.time, error.time, error.variance)), axis.phase_sd)


def widen_undetermined(axis: AxisMotion) -> AxisMotion:
    """The motion with the uncertainty of a readout that the picture does not measure in its ``phase_sd``."""
    return replace(axis, phase_sd=np.sqrt(axis.phase_sd**2 + _undescribed_variance(axis)))


def _undescribed_variance(axis: AxisMotion) -> Array:
    """Variance of the phase by a delay that the device file does not state [rad^2].

    That of a readout which has one: averaged with readouts as stated, half of them, the interval of ± 1.96 standard
    deviations would hold 92 % of this prior. None of an axis without a frequency: it moves once through its range in
    the recording, of which such a delay is a small part.
    """
    if axis.reference == "blocks":
        return np.zeros_like(axis.frequency)
    return np.square(2.0 * np.pi * axis.frequency * UNDESCRIBED_DELAY_SD_S)


def describe_readout_phase(
    motion: Motion, found: Mapping[str, ReadoutPhase], contradicted: Collection[str] = ()
) -> list[str]:
    """What a reader has to know of the phase error of the readout, a line each.

    Args:
        motion: corrected.
        found: the error that was removed, by axis.
        contradicted: axes whose motion the picture contradicts, which is stated elsewhere.
    """
    notes = [
        f"the picture determines no phase of {name}: no feature across it, a pattern that repeats, too few photons, "
        "or a figure whose two directions have too few places in common. "
        f"The standard deviation of the phase allows for {UNDESCRIBED_DELAY_SD_S * 1e6:.2g} µs of readout delay that "
        f"the device file does not state; without such a delay it is {_sd_as_stated(motion.axes[name]):.2g}°. "
        "A scene with detail, more light, a longer scan or other frequencies narrow it"
        for name in AXES
        if name not in found and name not in contradicted and motion.axes[name].reference != "blocks"
    ]
    notes += [
        f"the picture determines no phase of {name}; the delay that it shows in the other axis, whose signal passes "
        f"the same readout, was removed: {np.degrees(error.value):.3g}° ± {np.degrees(error.sd):.1g}°"
        for name, error in found.items()
        if not error.measured
    ]
    found = {name: error for name, error in found.items() if error.measured}
    delay = common_delay(motion, found)
    if delay is not None and delay.value < 0.0:
        notes.append(_describe_late_intensity(delay.value))
    for name, error in found.items():
        if is_significant(error):
            notes.append(
                f"the signal of {name} is {abs(np.degrees(error.value)):.3g}° ± {np.degrees(error.sd):.1g}° "
                f"{'late' if error.value > 0.0 else 'early'} against the intensity; its phase was corrected by the "
                "picture"
            )
    if delay is not None and delay.value > 0.0:
        notes.append(_describe_late_signals(delay.value, motion.estimator))
    return notes


def is_significant(error: ReadoutPhase) -> bool:
    """Whether a phase error of the readout exceeds its uncertainty."""
    return abs(error.value) > REPORTED_SDS * error.sd


def _describe_late_intensity(delay: float) -> str:
    """The line on a negative delay [s] of the motion's signals, which explains the phase errors of both axes.

    No signal comes before the motion, so that it is the intensity, or its clock, that is late.
    """
    return (
        f"an intensity that is {-1e6 * delay:.2g} µs late (detector, amplifier, start of the channel) would "
        "explain the error of both axes: positions in the picture are right, and the motion is late by this time"
    )


def _describe_late_signals(delay: float, estimator: str) -> str:
    """The line on a delay [s] of the motion's signals that explains the phase errors of both axes."""
    corner = 1.0 / (2.0 * np.pi * delay)
    near = f"{1e-3 * corner:.2g} kHz" if corner < 1e5 else f"{1e-6 * corner:.2g} MHz"
    pole = f"a delay of {1e6 * delay:.2g} µs or a pole near {near} in the "
    if estimator == "tracker":
        return pole + "readout would explain the error of both axes; run `lissajous diagnose`"
    return pole + "position detectors would explain the error of both axes; state their channels' start earlier by it"


def _sd_as_stated(axis: AxisMotion) -> float:
    """Standard deviation of a known phase, rms [deg], if the readout is as the device file states; axis: widened."""
    variance = np.maximum(axis.phase_sd**2 - _undescribed_variance(axis), 0.0)
    return float(np.degrees(rms_phase(np.sqrt(variance[axis.known]), axis.amplitude[axis.known])))


class CommonDelay(NamedTuple):
    """Delay of the signals of both axes against the intensity, and its standard deviation [s]."""

    value: float
    sd: float


def common_delay(motion: Motion, found: Mapping[str, ReadoutPhase]) -> CommonDelay | None:
    """The delay that explains the measured phase errors of both axes within their uncertainty.

    None if none does, or if no phase error is significant.

    Args:
        motion: corrected.
        found: the error that was removed, by axis.
    """
    if not (set(found) == set(AXES) and all(error.measured for error in found.values())):
        return None
    if not any(map(is_significant, found.values())):
        return None
    rate = np.array([2.0 * np.pi * np.median(motion.axes[name].frequency) for name in found])
    value, sd = np.array([(error.value, error.sd) for error in found.values()]).T
    information = float(np.sum(rate**2 / sd**2))
    delay = float(np.sum(rate * value / sd**2)) / information
    misfit = np.sum(((value - rate * delay) / sd) ** 2)
    return CommonDelay(delay, information**-0.5) if misfit < REPORTED_SDS**2 else None


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
