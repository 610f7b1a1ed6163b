"""Motion of axes of which only the frequency is known: a sine of unknown slow phase that fills the field."""

from __future__ import annotations

from math import pi
from typing import NamedTuple

import numpy as np

from estimation.reference import PhaseReference
from estimation.signals import phase_reference
from estimation.tracker.angle_synthesis import PhasorAngle, PhasorMotion
from estimation.tracker.phase_measurements import UNKNOWN_PHASE_SD
from scanner.arrays import Array
from scanner.device import Device
from scanner.errors import DeviceInvalid
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording


class SlowCurve(NamedTuple):
    """Phase against the reference, or logarithm of an amplitude, at knots: shape (n,), n > 1.

    Attributes:
        time: increasing [s].
        value, rate: [rad, rad/s], or [1, 1/s].
        sd: standard deviation of the value.
    """

    time: Array
    value: Array
    rate: Array
    sd: Array


def missing_for_motion(recording: Recording, device: Device) -> str | None:
    """What the drives need to determine the motion and is not there, in words; None where nothing is missing."""
    for name, axis in device.axes.items():
        if axis.mechanics is None:
            return f"[{name}.mechanics] is not stated"
        if f"drive_{name}" not in recording:
            return f"drive_{name} was not recorded"
        if axis.capacitance is None and (axis.drive is None or axis.drive.kind == "electrostatic"):
            return f"[{name}.capacitance] is not stated"
    return None


def is_motion_computable(recording: Recording, device: Device) -> bool:
    """Whether the drives were recorded and the device states their torque and the mechanics."""
    return missing_for_motion(recording, device) is None


def frequency_motion(recording: Recording, device: Device) -> Motion:
    """The motion of a device without mechanics: amplitudes that fill the field, and phases that are not known.

    Args:
        recording: with an intensity; drive channels, where there are any, give the reference phase.
        device: with a field of view and the drive of every axis.

    Raises:
        DeviceInvalid: the device states no drive, no field, or one of more than half a turn.
        ChannelMissing: an axis has neither a drive channel nor a drive frequency; no intensity.
    """
    scan = device.require_scan()
    half_angles = dict(zip("xy", scan.mechanical_half_angles, strict=True))
    if max(half_angles.values()) > pi / 2 and scan.metres_per_radian is None:
        what = f"half angles of {scan.half_angle_x:g} and {scan.half_angle_y:g} rad look like degrees or mrad"
        raise DeviceInvalid(what, file=device.source, channel="scan", hint="state them in rad")
    intensity = recording.require("intensity", "without a sense signal the phases come from it")
    clock = intensity.sample_rate, intensity.start, intensity.size
    axes = {}
    for name in device.axes:
        reference = phase_reference(recording, device, name)
        time = np.array([intensity.start, intensity.end])
        unknown = SlowCurve(time, np.zeros(2), np.zeros(2), np.full(2, UNKNOWN_PHASE_SD))
        log_amplitude = SlowCurve(time, np.full(2, np.log(half_angles[name])), np.zeros(2), np.zeros(2))
        axes[name] = sine_motion(reference, unknown, log_amplitude, clock)
    return Motion(axes, "picture")


def sine_motion(
    reference: PhaseReference, phase: SlowCurve, log_amplitude: SlowCurve, clock: tuple[float, float, int]
) -> AxisMotion:
    """A sine with a slow phase against a reference and a slow amplitude.

    Args:
        reference: the reference phase.
        phase: at knots.
        log_amplitude: logarithm of the amplitude in rad, at other knots.
        clock: sample rate [Hz], start [s] and number of samples of the angles.
    """
    size = phase.time.size
    harmonics = np.tile(np.array([-1j, 0.0, 0.0], np.complex64), (size, 1))  # n = 1, 3 and 5
    log, log_rate = interpolate_curve(log_amplitude, phase.time)
    motion = PhasorMotion(reference, phase.time, phase.value, phase.rate, log, log_rate, harmonics)
    return AxisMotion(
        time=phase.time,
        phase=phase.value,
        amplitude=np.exp(log),
        frequency=reference.frequency_at(phase.time) + phase.rate / (2 * pi),
        phase_sd=phase.sd,
        angle=PhasorAngle(motion, *clock),
        reference=reference.kind,
        reference_frequency=reference.frequency,
        sign="ambiguous",
    )


def interpolate_curve(curve: SlowCurve, time: Array) -> tuple[Array, Array]:
    """Values and rates of a curve at other times: cubic between the knots, linear beyond, as the motion has it."""
    from scipy.interpolate import CubicHermiteSpline

    spline = CubicHermiteSpline(curve.time, curve.value, curve.rate)
    inside = np.clip(time, curve.time[0], curve.time[-1])
    rate: Array = spline(inside, 1)
    return spline(inside) + (time - inside) * rate, rate
