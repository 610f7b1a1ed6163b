"""Reference angle of one axis from what was recorded of its motion: angle, velocity, acceleration or lock-in output.

A velocity or an acceleration is integrated. Its mean and everything slower than the motion is lost, because the
integral of noise drifts; theta_th is then relative to the mean angle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimation.lock_in_channels import amplitude_tolerance, lock_in_angle, lock_in_span
from estimation.reference import dominant_frequency
from scanner.arrays import Array
from scanner.channel import Channel, make_channel
from scanner.device import Axis
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.signal_check import check_signal
from scanner.stages import Acceleration, MotionSensor, Position, Velocity

MEAN_CYCLES = 8.0
"""Cycles of the Hann-weighted mean that is taken off an integral. It passes less than 0.1 % of a motion whose frequency
is within 20 % of the centre, and removes drifts slower than a quarter of it."""


@dataclass(frozen=True)
class ReferenceAngle:
    """An angle for identification.

    Attributes:
        channel: ``angle_x`` [rad].
        source: name of the channel that it comes from.
        gain_tolerance: relative standard uncertainty of its scale, where it comes from a readout of the device.
        order: derivatives of the angle that ``source`` follows.
        sensor: readout to which ``source`` corresponds where it is no angle.
    """

    channel: Channel
    source: str
    gain_tolerance: float = 0.0
    order: int = 0
    sensor: Position | Velocity | Acceleration | None = None


def find_reference_angle(recording: Recording, axis: Axis, default_tolerance: float) -> ReferenceAngle | None:
    """The best reference angle of an axis; None if nothing recorded is proportional to its motion.

    In this order: ``angle_x``, ``velocity_x``, ``acceleration_x``, ``amplitude_x`` with ``phase_x`` beside a drive, and
    ``sense_x`` behind a position, velocity or acceleration readout beside a drive.

    Args:
        default_tolerance: of the readout's gain where the device states none.

    Raises:
        BadInput: a channel cannot be used.
    """
    name = axis.name
    if f"angle_{name}" in recording:
        return ReferenceAngle(recording[f"angle_{name}"], f"angle_{name}")
    for sensor in (Velocity(1.0, 0.0), Acceleration(1.0, 0.0)):
        if (key := f"{sensor.kind}_{name}") in recording:
            channel = recording[key]
            check_signal(channel)
            return ReferenceAngle(
                _integrated(channel, axis, channel.read(), sensor.order), key, 0.0, sensor.order, sensor
            )
    if f"drive_{name}" not in recording:
        return None
    tolerance = axis.tolerance.get("gain", default_tolerance)
    if f"amplitude_{name}" in recording and f"phase_{name}" in recording:
        drive = recording[f"drive_{name}"]
        held = recording[f"amplitude_{name}"]
        time = drive.time()
        begin, end = lock_in_span(recording, axis)
        inside = (time >= begin) & (time <= end)
        if not inside.any():
            hint = "check their start times and rates"
            raise BadInput(f"has no time in common with drive_{name}", file=held.file, channel=held.name, hint=hint)
        angle = lock_in_angle(recording, axis, time[inside]).values
        channel = _channel(name, angle, drive.sample_rate, float(time[inside][0]))
        return ReferenceAngle(channel, held.name, amplitude_tolerance(recording, axis))
    if f"sense_{name}" in recording and isinstance(axis.readout, MotionSensor):
        sense, readout = recording[f"sense_{name}"], axis.readout
        check_signal(sense)
        motion = (sense.read() - readout.offset) / readout.gain
        channel = _integrated(sense, axis, motion, readout.order)
        return ReferenceAngle(channel, sense.name, tolerance, readout.order, readout)
    return None


def with_angle(recording: Recording, reference: ReferenceAngle) -> Recording:
    """The recording with the reference angle as its channel ``angle_x``."""
    return replace(recording, channels={**recording.channels, reference.channel.name: reference.channel})


def _channel(name: str, angle: Array, rate: float, start: float) -> Channel:
    return make_channel(f"angle_{name}", angle, unit="rad", sample_rate=rate, start=start)


def _integrated(channel: Channel, axis: Axis, values: Array, order: int) -> Channel:
    """The angle of which ``values`` are the derivative of that order, without its slow part; ``values`` for order 0."""
    from scipy.interpolate import CubicSpline
    from scipy.signal import oaconvolve

    rate = channel.sample_rate
    if order == 0:
        return _channel(axis.name, values, rate, channel.start)
    frequency = dominant_frequency(channel, 0.5 * axis.resonance, 2.0 * axis.resonance)
    half = round(0.5 * MEAN_CYCLES * rate / frequency)
    if values.size < (2 * order + 2) * half:
        hint = "record for longer"
        raise BadInput(
            f"holds fewer than {(order + 1) * MEAN_CYCLES:g} cycles", file=channel.file, channel=channel.name, hint=hint
        )
    window = np.hanning(2 * half + 1)
    window /= window.sum()
    start = channel.start
    for _ in range(order):
        integral = CubicSpline(np.arange(values.size), values - values.mean()).antiderivative()(np.arange(values.size))
        mean = oaconvolve(integral, window, mode="valid")
        values = (integral[half : integral.size - half] - mean) / rate
        start += half / rate
    return _channel(axis.name, values, rate, start)
