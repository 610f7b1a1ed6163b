"""Amplitude and phase as a lock-in amplifier or an envelope detector recorded them."""

from __future__ import annotations

import numpy as np

from scanner.arrays import Array, Complex
from scanner.channel import check_signal
from scanner.device import Axis
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.stages import MotionSensor


def lock_in_amplitude(recording: Recording, axis: Axis) -> tuple[Array, Array, bool]:
    """Times [s] and amplitude of an axis, shape (n,), and whether the amplitude is in rad.

    A voltage is converted by the gain of a sensor of the motion, at the resonance for velocity and acceleration; behind
    another readout it stays a voltage. A constant amplitude, as under a control loop, is one.

    Raises:
        BadInput: it holds no sample that can be used, or is zero.
    """
    channel = recording[f"amplitude_{axis.name}"]
    check_signal(channel, constant_ok=True, gaps_ok=True)
    values = channel.read()
    if not np.nan_to_num(values).any():
        raise BadInput("is 0 throughout", file=channel.file, channel=channel.name, hint="check that it was connected")
    if channel.unit == "rad" or not isinstance(axis.readout, MotionSensor):
        return channel.time(), values, channel.unit == "rad"
    rate = 2 * np.pi * axis.resonance if axis.readout.order else 1.0
    return channel.time(), values / abs(axis.readout.gain) / rate**axis.readout.order, True


def lock_in_angle(recording: Recording, axis: Axis, time: Array) -> Array:
    """Angle A sin(2 pi f t + phase) at ``time`` [s] from ``amplitude_x``, ``phase_x`` and their reference [rad].

    Raises:
        ChannelMissing: no phase. BadInput: the amplitude is no angle, or no reference frequency is stated.
    """
    at, amplitude, in_rad = lock_in_amplitude(recording, axis)
    if not in_rad:
        hint = "record it in rad, or state a position, velocity or acceleration readout"
        raise BadInput("is a voltage behind no sensor of the motion", channel=f"amplitude_{axis.name}", hint=hint)
    phase = recording.require(f"phase_{axis.name}", "the angle needs it beside the amplitude")
    unwrapped = np.unwrap(phase.read())
    turn, _ = reference_turn(recording, axis, time)
    size = np.interp(time, at, amplitude)
    return np.asarray(size * np.sin(turn + np.interp(time, phase.time(), unwrapped)))


def lock_in_values(recording: Recording, axis: Axis) -> tuple[Array, Complex]:
    """Times (n,) [s] and amplitude exp(i phase) (n,) [rad or V], as recorded; values that are not finite are left out.

    Raises:
        ChannelMissing: no phase.
    """
    time, amplitude, _ = lock_in_amplitude(recording, axis)
    phase = recording.require(f"phase_{axis.name}", "the frequency of the motion needs it beside the amplitude")
    values = amplitude * np.exp(1j * np.interp(time, phase.time(), np.unwrap(phase.read())))
    known = np.isfinite(values)
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
    """Phase of the reference at ``time`` [rad], and its mean frequency [Hz]."""
    phase = recording[f"phase_{axis.name}"]
    reference = phase.reference if phase.reference is not None else recording[f"amplitude_{axis.name}"].reference
    if reference is None:
        hint = "state the attribute reference: the frequency in Hz, or the channel that holds it"
        raise BadInput("states no reference frequency", file=phase.file, channel=phase.name, hint=hint)
    if not isinstance(reference, str):
        return 2 * np.pi * float(reference) * time, float(reference)
    held = recording.require(reference, f"it is the reference of {phase.name}")
    frequency = held.read()
    cycles = np.concatenate([[0.0], np.cumsum(0.5 * (frequency[1:] + frequency[:-1]))]) / held.sample_rate
    return 2 * np.pi * np.interp(time, held.time(), cycles), float(np.nanmean(frequency))
