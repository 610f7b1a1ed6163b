"""Amplitude and phase as a lock-in amplifier or an envelope detector recorded them.

Behind a sensor of the motion they are those of its voltage. Amplitude and phase of the angle follow from the complex
gain of the sensor, which turns the phase by a right angle with each time derivative, and by pi if it is negative.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scanner.arrays import Array, Complex, Mask
from scanner.channel import MAX_TIME_ROUNDING_SAMPLES, Channel
from scanner.device import DEFAULT_TOLERANCE, Axis
from scanner.errors import BadInput
from scanner.harmonics import readout_response
from scanner.recording import Recording
from scanner.signal_check import check_signal
from scanner.stages import MotionSensor


def lock_in_amplitude(recording: Recording, axis: Axis) -> tuple[Array, Array, bool]:
    """Times [s] and amplitude of an axis, shape (n,), and whether the amplitude is in rad.

    A voltage is converted by the gain of a sensor of the motion; behind another readout it stays a voltage. A constant
    amplitude, as under a control loop, is one.

    Raises:
        ChannelMissing: the channel of the reference frequency, where the gain depends on it.
        BadInput: it holds no sample that can be used, or is zero.
    """
    channel = recording[f"amplitude_{axis.name}"]
    check_signal(channel, constant_ok=True, gaps_ok=True)
    values = channel.read()
    if not np.nan_to_num(values).any():
        raise BadInput("is 0 throughout", file=channel.file, channel=channel.name, hint="check that it was connected")
    time = channel.time()
    if not is_voltage_of_motion(recording, axis):
        return time, values, channel.unit == "rad"
    gain = np.abs(_sensor_gain(recording, axis, time))
    return time, values / np.where(gain > 0.0, gain, np.nan), True  # none at a frequency of 0


def is_voltage_of_motion(recording: Recording, axis: Axis) -> bool:
    """Whether amplitude and phase are those of the voltage of a sensor of the motion."""
    return recording[f"amplitude_{axis.name}"].unit != "rad" and isinstance(axis.readout, MotionSensor)


def amplitude_tolerance(recording: Recording, axis: Axis) -> float:
    """Relative standard uncertainty of the amplitude [rad] by that of the gain that it is converted with."""
    return axis.tolerance.get("gain", DEFAULT_TOLERANCE) if is_voltage_of_motion(recording, axis) else 0.0


def recorded_derivatives(recording: Recording, axis: Axis) -> int:
    """Time derivatives of the angle that amplitude and phase are of."""
    readout = axis.readout
    return readout.order if is_voltage_of_motion(recording, axis) and isinstance(readout, MotionSensor) else 0


def _sensor_gain(recording: Recording, axis: Axis, time: Array) -> Complex:
    """Complex gain of a sensor of the motion at the reference frequency, without one at the resonance [V / rad].

    Returns:
        Shape () of a gain that does not depend on the frequency, or of one frequency; else (n,), that of ``time``.
    """
    readout = axis.require_readout()
    if not isinstance(readout, MotionSensor) or not readout.order:
        return readout_response(readout, 1.0)
    reference = _reference(recording, axis)
    if isinstance(reference, Channel):
        at, frequency = _finite_samples(reference)
        return readout_response(readout, np.interp(time, at, frequency))
    return readout_response(readout, axis.resonance if reference is None else reference)


class LockInAngle(NamedTuple):
    """Angle from amplitude and phase of a lock-in amplifier.

    Attributes:
        values: shape (n,) [rad]; where a recorded value is missing, that of amplitude and phase interpolated between
            the values around it.
        missing: whether a recorded value beside it is missing, shape (n,).
    """

    values: Array
    missing: Mask


def lock_in_angle(recording: Recording, axis: Axis, time: Array) -> LockInAngle:
    """Angle A sin(2 pi f t + phase) at ``time`` [s] from ``amplitude_x``, ``phase_x`` and their reference.

    Behind a sensor of the motion, phase is that of the angle.

    Raises:
        ChannelMissing: no phase. BadInput: the amplitude is no angle, no reference frequency is stated, or a channel
            holds no finite sample.
    """
    at, amplitude, in_rad = lock_in_amplitude(recording, axis)
    if not in_rad:
        hint = "record it in rad, or state a position, velocity or acceleration readout"
        raise BadInput("is a voltage behind no sensor of the motion", channel=f"amplitude_{axis.name}", hint=hint)
    phase = recording.require(f"phase_{axis.name}", "the angle needs it beside the amplitude")
    turn, _ = reference_turn(recording, axis, time)
    known = np.isfinite(amplitude)
    size = np.interp(time, at[known], amplitude[known])
    values = np.asarray(size * np.sin(turn + _unwrapped_phase(phase, time) - _sensor_phase(recording, axis)))
    return LockInAngle(values, _missing_values(recording, axis, time))


def lock_in_values(recording: Recording, axis: Axis) -> tuple[Array, Complex]:
    """Times (n,) [s] and amplitude exp(i phase) (n,) of the angle [rad], or of a voltage [V] whose gain is not known.

    Missing values are left out.

    Raises:
        ChannelMissing: no phase. BadInput: a channel holds no finite sample.
    """
    time, amplitude, _ = lock_in_amplitude(recording, axis)
    phase = recording.require(f"phase_{axis.name}", "the frequency of the motion needs it beside the amplitude")
    values = amplitude * np.exp(1j * (_unwrapped_phase(phase, time) - _sensor_phase(recording, axis)))
    known = ~_missing_values(recording, axis, time)
    return time[known], values[known]


def lock_in_phasor(recording: Recording, axis: Axis) -> tuple[Array, Complex, float]:
    """Times (n,) [s], complex amplitude against the mean reference frequency (n,) [rad or V], and that frequency [Hz].

    Raises:
        ChannelMissing: no phase. BadInput: no reference frequency is stated.
    """
    time, values = lock_in_values(recording, axis)
    turn, frequency = reference_turn(recording, axis, time)
    return time, values * np.exp(1j * (turn - 2 * np.pi * frequency * time)), frequency


def reference_turn(recording: Recording, axis: Axis, time: Array) -> tuple[Array, float]:
    """Phase of the reference at ``time`` [rad], and its mean frequency [Hz].

    Missing samples of a recorded frequency are interpolated before it is integrated.

    Raises:
        BadInput: no reference frequency is stated, or the recorded one holds no finite sample.
    """
    phase = recording[f"phase_{axis.name}"]
    reference = _reference(recording, axis)
    if reference is None:
        hint = "state the attribute reference: the frequency in Hz, or the channel that holds it"
        raise BadInput("states no reference frequency", file=phase.file, channel=phase.name, hint=hint)
    if not isinstance(reference, Channel):
        return 2 * np.pi * reference * time, reference
    at, frequency = _finite_samples(reference)
    whole = np.interp(reference.time(), at, frequency)
    cycles = np.concatenate([[0.0], np.cumsum(0.5 * (whole[1:] + whole[:-1]))]) / reference.sample_rate
    return 2 * np.pi * np.interp(time, reference.time(), cycles), float(np.mean(frequency))


def _reference(recording: Recording, axis: Axis) -> float | Channel | None:
    """Frequency of the reference [Hz], or the channel that holds it; None where none is stated.

    Raises:
        ChannelMissing: the channel is not in the recording.
    """
    for name in (f"phase_{axis.name}", f"amplitude_{axis.name}"):
        stated = recording[name].reference if name in recording else None
        if isinstance(stated, str):
            return recording.require(stated, f"it is the reference of {name}")
        if stated is not None:
            return float(stated)
    return None


def _finite_samples(channel: Channel) -> tuple[Array, Array]:
    """Times [s] and values of the finite samples, shape (m,).

    Raises:
        BadInput: there is none.
    """
    check_signal(channel, constant_ok=True, gaps_ok=True)
    values = channel.read()
    known = np.isfinite(values)
    return channel.time()[known], values[known]


def _unwrapped_phase(phase: Channel, time: Array) -> Array:
    """Phase without jumps of 2 pi at ``time`` [s], interpolated between the finite samples, shape (n,) [rad]."""
    at, values = _finite_samples(phase)
    return np.asarray(np.interp(time, at, np.unwrap(values)))


def _sensor_phase(recording: Recording, axis: Axis) -> float:
    """Phase of the recorded signal against the angle [rad]: 0 where this is an angle or its gain is not known."""
    return (
        float(np.angle(readout_response(axis.require_readout(), 1.0))) if is_voltage_of_motion(recording, axis) else 0.0
    )


def lock_in_span(recording: Recording, axis: Axis) -> tuple[float, float]:
    """Begin and end of the time [s] that amplitude, phase and recorded reference frequency have in common.

    The last value holds for less than one sample, so that none follows from it on the clock of another channel.
    """
    spans = [
        (each.start - rounding, each.end - rounding)
        for each in _channels(recording, axis)
        for rounding in (MAX_TIME_ROUNDING_SAMPLES / each.sample_rate,)
    ]
    return max(begin for begin, _ in spans), min(end for _, end in spans)


def _channels(recording: Recording, axis: Axis) -> list[Channel]:
    """Amplitude, phase and recorded reference frequency."""
    reference = _reference(recording, axis)
    pair = [recording[f"{kind}_{axis.name}"] for kind in ("amplitude", "phase")]
    return [*pair, reference] if isinstance(reference, Channel) else pair


def _missing_values(recording: Recording, axis: Axis, time: Array) -> Mask:
    """Whether amplitude, phase or recorded reference frequency lacks a sample beside each ``time`` [s], shape (n,).

    That is so outside their common time too.
    """
    begin, end = lock_in_span(recording, axis)
    missing = (time < begin) | (time > end)
    for channel in _channels(recording, axis):
        missing |= np.interp(time, channel.time(), ~np.isfinite(channel.read())) > 0.0
    return missing
