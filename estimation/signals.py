"""The channels of a recording that estimators use: sense signals with their readout, drives, phase references."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.reference import (
    MIN_SAMPLES_PER_PERIOD,
    PhaseReference,
    absolute_reference,
    drive_reference,
    has_slow_oscillation,
    sampled_too_slowly,
    tone_frequency,
)
from scanner.active_terms import check_effects
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import Device
from scanner.errors import BadInput, ChannelMissing, DeviceInvalid
from scanner.recording import Recording
from scanner.signal_check import check_signal
from scanner.stages import Acceleration, MotionSensor, Readout, Velocity

NORMAL_MEDIAN_DEVIATION = 0.6745
"""Median absolute deviation of a normal distribution over its standard deviation."""

WHITE_NOISE_DIFFERENCE_ORDER = 6
"""Order of the differences by which a sensor's noise is measured: sixth differences suppress an oversampled motion
completely, and of white noise they have sqrt(924) times the standard deviation."""

NOISE_SAMPLES = 1 << 18
"""Samples from the start in which the noise of a sensor is measured."""


@dataclass(frozen=True)
class SenseChannel:
    """One sense channel: its readout and the axes whose motion it carries."""

    channel: Channel
    readout: Readout
    axes: tuple[str, ...]


def require_device(recording: Recording, device: Device | None) -> Device:
    """The device given, else the recording's own.

    Raises:
        DeviceInvalid: there is none, or it states a term that has no effect.
        BadInput: it states a term that cannot be used.
    """
    chosen = device or recording.device
    if chosen is None:
        hint = "give one with --device, or record it under /device"
        raise DeviceInvalid("states no device", file=recording.path, channel="/device", hint=hint)
    check_effects(chosen)
    return chosen


def sense_channels(recording: Recording, device: Device, gaps_ok: bool = False) -> list[SenseChannel]:
    """The sense channels, each checked; every axis of the device is in one of them.

    Args:
        gaps_ok: samples may be missing (NaN).

    Raises:
        ChannelMissing: an axis has no sense channel.
        DeviceInvalid: a channel has no readout. BadInput: a channel cannot be used.
    """
    if "sense" in recording:
        if device.readout is None:
            raise DeviceInvalid(
                "is missing and needed for the channel sense",
                file=device.source,
                channel="readout",
                hint="add [readout] with kind and its values at the top level of the device",
            )
        signals = [SenseChannel(recording["sense"], device.readout, tuple(device.axes))]
    else:
        signals = [
            _reference_sensor(recording, name)
            or SenseChannel(
                recording.require(f"sense_{name}", "this estimator needs it"), axis.require_readout(), (name,)
            )
            for name, axis in device.axes.items()
        ]
    for sense in signals:
        check_signal(sense.channel, gaps_ok=gaps_ok)
    return signals


def _reference_sensor(recording: Recording, axis: str) -> SenseChannel | None:
    """The recorded velocity or acceleration of an axis without sense channel, as a readout of gain 1."""
    for sensor in () if f"sense_{axis}" in recording else (Velocity, Acceleration):
        if (name := f"{sensor.kind}_{axis}") in recording:
            channel = recording[name]
            return SenseChannel(channel, sensor(1.0, white_noise_sd(channel.read(0, NOISE_SAMPLES))), (axis,))
    return None


def white_noise_sd(values: Array) -> float:
    """Standard deviation of the white noise of an oversampled signal, from its sixth differences, in its unit."""
    differences = np.diff(values[np.isfinite(values)], n=WHITE_NOISE_DIFFERENCE_ORDER)
    return robust_sd(differences) / np.sqrt(924.0) if differences.size else 0.0


def robust_sd(deviations: Array) -> float:
    """Standard deviation of normal deviations from 0, by the median of their absolute values; NaN are left out."""
    return float(np.nanmedian(np.abs(deviations))) / NORMAL_MEDIAN_DEVIATION


def drive_channel(recording: Recording, axis: str, gaps_ok: bool = False) -> Channel | None:
    """The voltage channel of one axis: its drive, or its bias during a free decay; None if none was recorded.

    Args:
        gaps_ok: samples may be missing (NaN). The drive is then not checked here, because ``phase_reference`` has
        checked it.
    """
    for name in (f"drive_{axis}", f"bias_{axis}"):
        if name in recording:
            if not (gaps_ok and name.startswith("drive")):
                check_signal(recording[name], constant_ok=True, gaps_ok=gaps_ok)
            return recording[name]
    return None


def phase_reference(
    recording: Recording,
    device: Device,
    axis: str,
    sense: Channel | None = None,
    even: bool = False,
    frequency: float | None = None,
) -> PhaseReference:
    """The phase reference of one axis (see ``estimation.reference``).

    Args:
        sense: a signal of the motion, for its frequency where no drive was recorded, and to confirm that a linear drive
            moves the axis far below its resonance.
        even: the signal carries the motion's frequency twice (a capacitance).
        frequency: of the reference in an earlier segment of the same scan [Hz]; searched for where None.

    Raises:
        BadInput: neither the drive nor the signal holds an oscillation, or a drive near the resonance is sampled too
            slowly to show it.
    """
    stated = device.axis(axis)
    if f"drive_{axis}" in recording:
        drive = recording[f"drive_{axis}"]
        check_signal(drive, gaps_ok=True)
        low = 0.1 * stated.resonance if stated.mechanics else 0.0
        span = min(recording.start, drive.start), max(recording.end, drive.end)
        if stated.require_drive().kind == "linear":
            quasistatic = (
                low > 0.0
                and frequency is None
                and all(has_slow_oscillation(signal, 2.0 * low) for signal in (drive, sense) if signal is not None)
            )
            if low and not quasistatic and drive.sample_rate < MIN_SAMPLES_PER_PERIOD * stated.resonance:
                raise sampled_too_slowly(drive, "a drive of the resonance", stated.resonance)
            return drive_reference(drive, "drive", 0.0 if quasistatic else low, frequency, span)
        reference = drive_reference(drive, "half-drive", low, frequency and 2.0 * frequency, span)
        if stated.mechanics and not 0.75 < reference.frequency / stated.resonance < 1.33:
            raise BadInput(
                f"oscillates at {2 * reference.frequency:.6g} Hz, and axis {axis} moves at half of that near its "
                f"resonance of {stated.resonance:.6g} Hz",
                file=drive.file,
                channel=drive.name,
                hint="check its sample_rate, and J and k of the device",
            )
        return reference
    if sense is None:
        if stated.drive is None or stated.drive.frequency is None:
            raise ChannelMissing(
                "is not in the recording and no other channel determines the frequency of the motion",
                file=recording.path,
                channel=f"drive_{axis}",
                hint=f"record the drive, or state its frequency in [{axis}.drive] of the device",
            )
        frequency = stated.drive.frequency * stated.drive.motion_per_drive
        return absolute_reference(frequency, recording.start, recording.end)
    double = 2.0 if even else 1.0
    band = (0.8 * double * stated.resonance, 1.25 * double * stated.resonance) if stated.mechanics else (0.0, np.inf)
    window = 60.0 / stated.resonance if stated.mechanics else None
    frequency = tone_frequency(sense, *band, window=window) / double
    return absolute_reference(frequency, sense.start, sense.end)


def is_capacitive(readout: Readout) -> bool:
    """Whether the readout measures a capacitance: its signal has twice the motion's frequency and no sign."""
    return not isinstance(readout, MotionSensor)


def intensity_clock(recording: Recording, fallback: Channel) -> tuple[float, float, int]:
    """(rate [Hz], start [s], samples) of the intensity, or of ``fallback`` where there is none."""
    channel = recording.channels.get("intensity", fallback)
    if channel.size < 1:
        raise BadInput("holds no samples", file=channel.file, channel=channel.name)
    return channel.sample_rate, channel.start, channel.size


def drive_phase_change(
    recording: Recording, effective: Recording, device: Device, axis: str, time: Array
) -> Array | float:
    """Phase of the effective drive minus that of the recorded one; 0.0 if terms do not change the drive of the axis.

    Args:
        effective: the recording with the effective drive, see ``estimation.term_absorption``.
        axis: name of the axis.
        time: shape (n,) [s].

    Returns:
        shape (n,), or 0.0 [rad].
    """
    key = f"drive_{axis}"
    if key not in effective or effective[key] is recording[key]:
        return 0.0
    return phase_reference(effective, device, axis).phase(time) - phase_reference(recording, device, axis).phase(time)


def drive_motion_frequency(recording: Recording, device: Device, axis: str) -> float | None:
    """Frequency at which the drive of an axis moves it [Hz], as recorded or stated; None where neither is known."""
    drive = device.axis(axis).drive
    if drive is None:
        return None
    if f"drive_{axis}" in recording:
        try:
            return phase_reference(recording, device, axis).frequency
        except BadInput:
            return None
    return None if drive.frequency is None else drive.frequency * drive.motion_per_drive
