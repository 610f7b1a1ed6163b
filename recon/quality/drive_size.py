"""Whether a measured amplitude is one that the recorded linear drive can give.

A position sensor shows the motion whatever the drive is, so that a drive in millivolts that states volts has no effect
on the picture. Phase references and a picture remain right; a diagnosis, a prediction and the tracker do not.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import hypot, inf, isclose, pi, sqrt

import numpy as np

from estimation.reference import tone_frequency
from recon.quality.amplitude_check import MAX_RELATIVE_SIGNAL
from scanner.channel import Channel
from scanner.device import Device
from scanner.errors import BadInput
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording
from scanner.stages import MotionSensor

SAME_LINE = 1e-3
"""Relative difference up to which a motion has the frequency of its drive."""

STEADY_CHANGE = 0.05
"""Relative difference of the amplitudes of the third and the last quarter up to which a motion counts as steady."""

COVERAGE_SD = 3.0
"""Standard deviations by which inertia, stiffness and damping may differ from their nominal values."""

COMPARED_SAMPLES = 1 << 16
"""Samples at the end of a drive whose size is measured: hundreds of periods."""


def describe_drive_sizes(recording: Recording, device: Device, motion: Motion) -> Iterator[str]:
    """Yield a line for each axis whose amplitude lies outside what its linear drive gives by ``MAX_RELATIVE_SIGNAL``.

    Args:
        recording: that the motion was estimated from.
        device: an axis without mechanics or torque per volt is left out.
        motion: an axis that a sensor of the motion does not show, or that does not move steadily with its drive, is
            left out.
    """
    for name, own in motion.axes.items():
        drive = recording.channels.get(f"drive_{name}")
        if drive is None or not _is_sensed(recording, device, name) or not _is_steady(own):
            continue
        frequency = float(np.median(own.frequency))
        limits = response_limits(device, name, frequency)
        size = _drive_amplitude(drive, frequency)
        if limits is None or size is None:
            continue
        least, most = (size * limit for limit in limits)
        amplitude = float(np.median(own.amplitude[-(own.amplitude.size // 4) - 1 :]))
        if amplitude * MAX_RELATIVE_SIGNAL < least or amplitude > MAX_RELATIVE_SIGNAL * most:
            few = amplitude < least
            factor = amplitude / (least if few else most)
            yield (
                f"drive_{name}: an amplitude of {size:.4g} V gives at {'least' if few else 'most'} "
                f"{least if few else most:.3g} rad by [{name}.mechanics] and torque_per_volt, and the sensor shows "
                f"{amplitude:.3g} rad, {factor:.2g} times as much: check the unit of drive_{name} and of the sensor, "
                "torque_per_volt and the gain. The picture depends on the sensor alone; the tracker, a prediction and "
                "a diagnosis depend on the drive too"
            )


def response_limits(device: Device, axis: str, frequency: float) -> tuple[float, float] | None:
    """Least and largest amplitude of the steady motion for a drive of 1 V [rad / V]; None without a linear drive.

    Args:
        device: with the tolerances of J, b and k.
        axis: its name.
        frequency: of drive and motion [Hz].
    """
    own = device.axis(axis)
    if own.mechanics is None or own.drive is None or not own.drive.torque_per_volt:
        return None
    omega, mechanics = 2.0 * pi * frequency, own.mechanics
    inertia, damping = mechanics.J * omega**2, mechanics.b * omega
    spread = COVERAGE_SD * hypot(device.tolerance(axis, "k") * mechanics.k, device.tolerance(axis, "J") * inertia)
    reactance, loss = abs(mechanics.k - inertia), COVERAGE_SD * device.tolerance(axis, "b")
    torque = abs(own.drive.torque_per_volt)
    softest = hypot(max(reactance - spread, 0.0), damping * max(1.0 - loss, 0.0))
    return torque / hypot(reactance + spread, damping * (1.0 + loss)), torque / softest if softest else inf


def _is_sensed(recording: Recording, device: Device, axis: str) -> bool:
    """Whether a channel shows the motion of an axis independently of the mechanics."""
    is_sensor = isinstance(device.axis(axis).readout, MotionSensor)
    return f"angle_{axis}" in recording or (is_sensor and f"sense_{axis}" in recording)


def _is_steady(own: AxisMotion) -> bool:
    """Whether the amplitude is the same in the third and in the last quarter of a motion that has a frequency."""
    quarter = own.amplitude.size // 4
    if own.reference == "blocks" or not quarter:
        return False
    third, last = np.median(own.amplitude[-2 * quarter : -quarter]), np.median(own.amplitude[-quarter:])
    return bool(abs(third - last) <= STEADY_CHANGE * max(third, last)) and bool(last > 0.0)


def _drive_amplitude(drive: Channel, frequency: float) -> float | None:
    """Amplitude of a drive [V] of the frequency [Hz] of the motion; None of another one or of none."""
    try:
        line = tone_frequency(drive)
    except BadInput:
        return None
    if not isclose(line, frequency, rel_tol=SAME_LINE):
        return None
    samples = drive.read(max(drive.size - COMPARED_SAMPLES, 0), drive.size)
    finite = samples[np.isfinite(samples)]
    return sqrt(2.0) * float(finite.std()) if finite.any() else None
