"""Amplitude and phase as a lock-in amplifier or an envelope detector recorded them."""

from __future__ import annotations

import numpy as np

from scanner.arrays import Array
from scanner.channel import check_signal
from scanner.device import Axis
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.stages import MotionSensor


def lock_in_amplitude(recording: Recording, axis: Axis) -> tuple[Array, Array, bool]:
    """Times [s] and amplitude of an axis, shape (n,), and whether the amplitude is in rad.

    A voltage is converted by the gain of a sensor of the motion, at the resonance for velocity and acceleration; behind
    another readout it stays a voltage.
    """
    channel = recording[f"amplitude_{axis.name}"]
    check_signal(channel, gaps_ok=True)
    values = channel.read()
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
    phase = recording.require(f"phase_{axis.name}", "the angle needs it beside the amplitude")
    reference = phase.reference if phase.reference is not None else recording[f"amplitude_{axis.name}"].reference
    if not in_rad:
        hint = "record it in rad, or state a position, velocity or acceleration readout"
        raise BadInput("is a voltage behind no sensor of the motion", channel=f"amplitude_{axis.name}", hint=hint)
    if reference is None:
        hint = "state the attribute reference: the frequency in Hz, or the channel that holds it"
        raise BadInput("states no reference frequency", file=phase.file, channel=phase.name, hint=hint)
    if isinstance(reference, str):
        held = recording.require(reference, f"it is the reference of {phase.name}")
        frequency = held.read()
        cycles = np.concatenate([[0.0], np.cumsum(0.5 * (frequency[1:] + frequency[:-1]))]) / held.sample_rate
        turn = 2 * np.pi * np.interp(time, held.time(), cycles)
    else:
        turn = 2 * np.pi * float(reference) * time
    unwrapped = np.unwrap(phase.read())
    size = np.interp(time, at, amplitude)
    return np.asarray(size * np.sin(turn + np.interp(time, phase.time(), unwrapped)))
