"""A clock of the intensity that runs at another rate than that of the sensors, from the phase errors of both axes.

Two instruments that record one scan differ by up to 100 ppm. The intensity is then later and later against the motion:
the phase errors of both axes grow with time in proportion to their frequencies. A readout or a scanner whose phase
drifts changes one axis, or both in another proportion.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from math import pi, sqrt
from typing import NamedTuple

import numpy as np

from recon.imaging.scan_phase.phase_error import PhaseError
from recon.imaging.scan_phase.readout_phase import CONVERGENCE_SD, MAX_ROUNDS, MIN_DRIFT_SLICES, REPORTED_SDS
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import AXES
from scanner.motion import AxisMotion, Motion

MIN_CLOCK_SDS = 5.0
"""Common slope in its standard deviations from which a clock is named: noise exceeds it in one of 10^6 scans. Each
axis by itself has to show ``REPORTED_SDS``."""

PPM = 1e-6
"""One part per million."""


class ClockError(NamedTuple):
    """Relative excess of the stated over the true sample rate of the intensity, and its standard deviation."""

    value: float
    sd: float


class _Line(NamedTuple):
    """Slope of a lateness over time, with its variance for the stated standard deviations, and the misfit."""

    slope: float
    variance: float
    misfit: float


def find_clock_error(sensed: Motion, corrected: Motion, errors: Sequence[PhaseError]) -> ClockError | None:
    """The clock error of the intensity that explains how the phase errors of both axes grow; None where none does.

    Args:
        sensed: motion by its sensors, on the intensity's clock.
        corrected: the same, after a correction by the picture.
        errors: phase errors of ``corrected`` that the slices of the scan show. Of a scan of few slices their parts
            are used.
    """
    if set(sensed.axes) != set(AXES):
        return None
    late = [_lateness(sensed, corrected, errors, name) for name in AXES]
    if any(time.size < MIN_DRIFT_SLICES for time, _, _ in late):
        return None
    lines = [_fit_line(*each) for each in late]
    information = sum(1.0 / line.variance for line in lines)
    slope = sum(line.slope / line.variance for line in lines) / information
    between = sum((line.slope - slope) ** 2 / line.variance for line in lines)
    freedom = sum(time.size for time, _, _ in late) - 2 * len(lines)
    scale = max(sum(line.misfit for line in lines) / freedom, 1.0)
    sd = sqrt(scale / information)
    agree = between < REPORTED_SDS**2 * scale
    shown = all(abs(line.slope) > REPORTED_SDS * sqrt(scale * line.variance) for line in lines)
    return ClockError(slope, sd) if agree and shown and abs(slope) > MIN_CLOCK_SDS * sd else None


def converge_clock_error(
    sensed: Motion, corrected: Motion, error: ClockError, register: Callable[[Motion], Sequence[PhaseError]]
) -> ClockError:
    """The clock error of a scan of few slices, measured again in the picture of the motion that follows it.

    The parts of a slice share a picture, which contains the error and thus a part of their lateness.

    Args:
        sensed, corrected: as for :func:`find_clock_error`, which found ``error``.
        register: measures the phase errors of a motion.
    """
    for _ in range(MAX_ROUNDS):
        followed = _following(corrected, error)
        again = find_clock_error(sensed, followed, register(followed))
        if again is None:
            break
        change, error = again.value - error.value, again
        if abs(change) < CONVERGENCE_SD * error.sd:
            break
    return error


def _following(motion: Motion, error: ClockError) -> Motion:
    """The motion on a clock of the intensity that runs wrong, with the same mean phase."""
    axes = {
        name: axis.advanced(2.0 * pi * axis.frequency * error.value * _time_from_middle(axis))
        for name, axis in motion.axes.items()
    }
    return replace(motion, axes=axes)


def _time_from_middle(axis: AxisMotion) -> Array:
    """Times of the phases of an axis from the middle of the intensity on [s]."""
    return axis.time - (axis.angle.start + 0.5 * axis.angle.size / axis.angle.sample_rate)


def describe_clock_error(error: ClockError | None, intensity: Channel) -> list[str]:
    """A line on a clock error of the intensity."""
    if error is None:
        return []
    rate, sd = intensity.sample_rate / (1.0 + error.value), intensity.sample_rate * error.sd
    digits = max(int(np.ceil(np.log10(rate / sd))) + 1, 1)
    return [
        f"intensity: the phase errors of both axes grow with time in proportion to their frequencies, as if the clock "
        f"of the intensity differed from that of the sensors by ({error.value / PPM:.3g} ± {error.sd / PPM:.1g}) ppm: "
        f"if two instruments recorded them, state {rate:.{digits}g} Hz as its sample_rate"
    ]


def include_clock_error(motion: Motion, error: ClockError, names: Collection[str]) -> Motion:
    """The motion with the phase error of a wrong clock in the ``phase_sd`` of the axes ``names``.

    The mean of the error over the scan was removed.
    """
    axes = dict(motion.axes)
    for name in names:
        axis = motion.axes[name]
        drift = 2.0 * pi * axis.frequency * error.value * _time_from_middle(axis)
        axes[name] = replace(axis, phase_sd=np.hypot(axis.phase_sd, drift))
    return replace(motion, axes=axes)


def _lateness(sensed: Motion, corrected: Motion, errors: Sequence[PhaseError], name: str) -> tuple[Array, Array, Array]:
    """Times of the slices, lateness of the intensity against the motion of an axis and standard deviation [s]."""
    axis, after = sensed.axes[name], corrected.axes[name]
    time, value, sd = _slices(errors, name) if len(errors) >= MIN_DRIFT_SLICES else _parts(errors, AXES.index(name))
    value = value + np.interp(axis.angle.start + time, axis.time, after.phase - axis.phase)
    known = np.isfinite(value) & np.isfinite(sd) & (sd > 0.0)
    rate = 2.0 * pi * float(np.median(axis.frequency))
    return time[known], value[known] / rate, sd[known] / rate


def _slices(errors: Sequence[PhaseError], name: str) -> Array:
    """Times [s], phase errors and standard deviations [rad] of the slices, shape (3, slices)."""
    rows = [(each.time, *getattr(each, name)) for each in errors]
    return np.array(rows, float).reshape(-1, 3).T


def _parts(errors: Sequence[PhaseError], column: int) -> Array:
    """The same of all parts of the slices, shape (3, parts); ``column`` 0 for x, 1 for y."""
    parts = [each.parts for each in errors if each.parts is not None]
    columns = [np.stack([each.time, each.value[:, column], each.sd[:, column]]) for each in parts]
    return np.concatenate(columns, axis=1) if columns else np.zeros((3, 0))


def _fit_line(time: Array, value: Array, sd: Array) -> _Line:
    """Weighted least squares, each array of shape (n,)."""
    weight = sd**-2
    centred = time - np.average(time, weights=weight)
    spread = float(weight @ centred**2)
    slope = float(weight @ (centred * value)) / spread
    left = value - np.average(value, weights=weight) - slope * centred
    return _Line(slope, 1.0 / spread, float(weight @ left**2))
