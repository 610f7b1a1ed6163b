"""Amplitude and phase as a lock-in amplifier or an envelope detector recorded them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scanner.arrays import Array, Complex, Mask
from scanner.channel import Channel
from scanner.device import Axis
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.signal_check import check_signal
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
    values = np.asarray(size * np.sin(turn + _unwrapped_phase(phase, time)))
    return LockInAngle(values, _missing_values(recording, axis, time))


def lock_in_values(recording: Recording, axis: Axis) -> tuple[Array, Complex]:
    """Times (n,) [s] and amplitude exp(i phase) (n,) [rad or V], as recorded; missing values are left out.

    Raises:
        ChannelMissing: no phase. BadInput: a channel holds no finite sample.
    """
    time, amplitude, _ = lock_in_amplitude(recording, axis)
    phase = recording.require(f"phase_{axis.name}", "the frequency of the motion needs it beside the amplitude")
    values = amplitude * np.exp(1j * _unwrapped_phase(phase, time))
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
    phase = recording[f"phase_{axis.name}"]
    stated = phase.reference if phase.reference is not None else recording[f"amplitude_{axis.name}"].reference
    if isinstance(stated, str):
        return recording.require(stated, f"it is the reference of {phase.name}")
    return None if stated is None else float(stated)


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


def _missing_values(recording: Recording, axis: Axis, time: Array) -> Mask:
    """Whether amplitude, phase or recorded reference frequency lacks a sample beside each ``time`` [s], shape (n,)."""
    channels = [recording[f"{kind}_{axis.name}"] for kind in ("amplitude", "phase")]
    reference = _reference(recording, axis)
    if isinstance(reference, Channel):
        channels.append(reference)
    missing = np.zeros(time.size, bool)
    for channel in channels:
        missing |= np.interp(time, channel.time(), ~np.isfinite(channel.read())) > 0.0
    return missing
