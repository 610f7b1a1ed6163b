"""Motion without a filter: constant phase and amplitude, or the angle that a position sensor measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from estimation.filters.measured_motion import MIN_BLOCKS, axis_motion_from_angle
from estimation.filters.to_motion import BLOCK_CYCLES
from estimation.held_samples import find_held_runs
from estimation.initial import fit_initial_motion
from estimation.isolated_spikes import REACH, Spikes, find_dropouts, find_spikes
from estimation.lock_in_channels import lock_in_angle
from estimation.missing_samples import MAX_FILLED_GAP_PERIODS, Filled, fill_missing
from estimation.reference import (
    MIN_SAMPLES_PER_PERIOD,
    PhaseReference,
    absolute_reference,
    block_reference,
    has_slow_oscillation,
    sampled_too_slowly,
    tone_frequency,
)
from estimation.sensor_hum import describe_hum, find_hum, without_hum
from estimation.short_tone import fit_short_tone
from estimation.signals import (
    intensity_clock,
    is_capacitive,
    phase_reference,
    sense_channels,
)
from scanner.angle_tracks import SampledAngle
from scanner.arrays import Index, Mask
from scanner.channel import Channel, make_channel
from scanner.channel_names import list_names
from scanner.device import Axis, Device
from scanner.errors import BadInput, ChannelMissing
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording
from scanner.replaced_samples import with_replaced
from scanner.sample_ranges import runs_of_true
from scanner.signal_check import check_signal
from scanner.stages import Position
from scanner.wording import counted, percent

CONSTANT_POINTS = 200
"""Points of the slow clock of a constant motion: only a chirped drive's frequency changes along it."""


def estimate_constant(recording: Recording, device: Device) -> Motion:
    """Phase and amplitude of the first cycles, held for the whole recording, as a calibration before a scan gives.

    Its ``phase_sd`` is that of the calibration and does not include drift.

    Raises:
        BadInput: as ``sense_channels`` and ``fit_initial_motion``.
    """
    axes = {}
    for sense in sense_channels(recording, device):
        even = is_capacitive(sense.readout)
        references = {name: phase_reference(recording, device, name, sense.channel, even) for name in sense.axes}
        start = fit_initial_motion(sense, device, references)
        rate, first, n = intensity_clock(recording, sense.channel)
        sampled = first + np.arange(n) / rate
        time = np.linspace(sense.channel.start, sense.channel.end, CONSTANT_POINTS)
        for name in sense.axes:
            motion, reference = start.axes[name], references[name]
            axes[name] = AxisMotion(
                time=time,
                phase=np.full(CONSTANT_POINTS, motion.phase),
                amplitude=np.full(CONSTANT_POINTS, motion.amplitude),
                frequency=reference.frequency_at(time),
                phase_sd=np.full(CONSTANT_POINTS, motion.phase_sd),
                angle=SampledAngle(motion.amplitude * np.sin(reference.phase(sampled) + motion.phase), rate, first),
                reference=reference.kind,
                reference_frequency=reference.frequency,
                sign=motion.sign,
            )
    return Motion(axes, "constant", {"calibrated_over_s": start.window})


def estimate_from_sensor(recording: Recording, device: Device) -> Motion:
    """Motion from the angle channels, or from position readouts where there are none; the sign is known.

    Raises:
        ChannelMissing: an axis has neither. BadInput: a channel cannot be used.
    """
    found = {name: _measure_axis(recording, device, name) for name in device.axes}
    slower = min(float(np.median(axis.motion.frequency)) for axis in found.values())
    axes, notes = {}, list[str]()
    for name, axis in found.items():
        hum = find_hum(recording, device.axis(name), name, axis.angle, axis.motion, slower)
        axes[name] = axis.measure(without_hum(axis.angle, hum)) if hum else axis.motion
        notes += [*axis.notes, *describe_hum(axis.channel, axis.gain, hum)]
    return Motion(axes, "sensor", {}, tuple(notes))


def axis_motion_from_sensor(recording: Recording, device: Device, name: str) -> tuple[AxisMotion, list[str]]:
    """Motion of one axis, whose hum is kept, and notes on its samples; as :func:`estimate_from_sensor`."""
    axis = _measure_axis(recording, device, name)
    return axis.motion, list(axis.notes)


class _MeasuredAxis(NamedTuple):
    """The motion of one axis from its position signal.

    Attributes:
        motion: of the axis.
        measure: the motion from such an angle, in place of the own one.
        angle: that was measured [rad].
        channel, gain: from which it was computed, and its unit per rad.
        notes: on samples that were replaced or left out, a line each.
    """

    motion: AxisMotion
    measure: Callable[[Channel], AxisMotion]
    angle: Channel
    channel: Channel
    gain: float = 1.0
    notes: Sequence[str] = ()


def _measure_axis(recording: Recording, device: Device, name: str) -> _MeasuredAxis:
    """Motion of one axis; as :func:`estimate_from_sensor`."""
    measured = any(f"{kind}_{name}" in recording for kind in ("sense", "angle"))
    if f"amplitude_{name}" in recording and "intensity" in recording and not measured:
        light = recording["intensity"]
        values, missing = lock_in_angle(recording, device.axis(name), light.time())
        angle = make_channel(f"phase_{name}", values, unit="rad", sample_rate=light.sample_rate, start=light.start)
        reference = reference_of_any_waveform(recording, device, name, angle)
        clock = intensity_clock(recording, angle)
        measure = partial(
            axis_motion_from_angle, reference=reference, noise_sd=None, clock=clock, held=runs_of_true(missing)
        )
        return _MeasuredAxis(measure(angle), measure, angle, angle, notes=_describe_missing_lock_in(name, missing))
    channel, scale, zero, noise_sd = find_position_signal(recording, device.axis(name), name)
    check_signal(channel, gaps_ok=True)
    channel = replace(channel, raw=channel.stored(), first=0, stop=channel.size)  # the file may be closed later
    dropouts = find_dropouts(channel)
    channel = _without(channel, dropouts)
    straight = fill_missing(channel, 0)
    whole = with_replaced(channel, straight.at, straight.values)
    reference = reference_of_any_waveform(recording, device, name, whole)
    if reference.kind in ("drive", "half-drive") and channel.sample_rate < MIN_SAMPLES_PER_PERIOD * reference.frequency:
        raise sampled_too_slowly(channel, "a motion", reference.frequency)
    longest = 1 if reference.kind == "blocks" else MAX_FILLED_GAP_PERIODS * channel.sample_rate / reference.frequency
    filled = fill_missing(channel, int(longest))
    repaired = with_replaced(channel, filled.at, filled.values)
    spikes = _away_from(filled.left_out, find_spikes(repaired))
    repaired = with_replaced(repaired, spikes.at, spikes.values)
    angle = replace(repaired, unit="rad", gain=repaired.gain / scale, offset=(repaired.offset - zero) / scale)
    held = [] if reference.kind == "blocks" else find_held_runs(channel, reference.frequency)
    clock, unknown = intensity_clock(recording, channel), sorted([*held, *filled.left_out])
    measure = partial(axis_motion_from_angle, reference=reference, noise_sd=noise_sd, clock=clock, held=unknown)
    motion = measure(angle)
    notes = [
        *_describe_held(channel, held),
        *_describe_dropouts(channel, dropouts),
        *_describe_missing(channel, filled),
        *_describe_spikes(channel, spikes.at),
        *_describe_noise(channel, abs(scale), noise_sd, motion.angle_noise_sd),
    ]
    return _MeasuredAxis(motion, measure, angle, channel, scale, notes)


def _away_from(gaps: Sequence[tuple[int, int]], spikes: Spikes) -> Spikes:
    """The spikes that are not beside a gap (first, stop), at either end of which its straight line has a corner."""
    kept = np.ones(spikes.at.size, bool)
    for first, stop in gaps:
        kept &= (spikes.at < first - REACH) | (spikes.at >= stop + REACH)
    return Spikes(spikes.at[kept], spikes.values[kept])


def _describe_noise(channel: Channel, gain: float, stated: float | None, found: float) -> list[str]:
    """A line on noise that the device file states too low.

    Args:
        channel: position signal.
        gain: unit of the channel per rad.
        stated, found: noise in single samples [rad]; None where the device file states none.
    """
    if stated is None or found <= stated:
        return []
    return [
        f"{channel.name}: the noise in single samples is {found * gain:.3g} {channel.unit} (1 sd), and the device file "
        f"states noise_sd = {stated * gain:.3g}; the measured noise is used"
    ]


def _without(channel: Channel, runs: Sequence[tuple[int, int]]) -> Channel:
    """The channel with NaN in ``runs`` of samples (first, stop), increasing."""
    at = np.concatenate([np.zeros(0, np.int64), *(np.arange(*run) for run in runs)])
    return with_replaced(channel, at, np.full(at.size, np.nan))


def _describe_dropouts(channel: Channel, runs: Sequence[tuple[int, int]]) -> list[str]:
    """A line on short ``runs`` of samples (first, stop) that were far from those around, if there are any."""
    if not runs:
        return []
    lengths = [stop - first for first, stop in runs]
    short, long = min(lengths), max(lengths)
    size = f"{long}" if short == long else f"{short} to {long}"
    return [
        f"{channel.name}: {counted(len(runs), 'run')} of {size} samples far from the samples around, the first at "
        f"{channel.start + runs[0][0] / channel.sample_rate:.6g} s, count as missing: drop-outs; check the cable and "
        "the converter"
    ]


def _describe_spikes(channel: Channel, spikes: Index) -> list[str]:
    """A line on single samples that were far from their neighbours, if there are any."""
    if not spikes.size:
        return []
    return [
        f"{channel.name}: {counted(spikes.size, 'single sample')} far from the samples around, the first at "
        f"{channel.start + spikes[0] / channel.sample_rate:.6g} s, are replaced by the cubic through these: check the "
        "cable and the converter"
    ]


def _describe_missing(channel: Channel, repaired: Filled) -> list[str]:
    """Lines on missing samples: those that were interpolated, and those that are left out."""
    notes, left_out = [], sum(stop - first for first, stop in repaired.left_out)
    if repaired.filled:
        number = f"{counted(repaired.filled, 'missing sample')} ({percent(repaired.filled / channel.size)})"
        notes.append(f"{channel.name}: interpolated {number} in short gaps from the samples around")
    if left_out:
        number = f"{counted(left_out, 'missing sample')} ({percent(left_out / channel.size)})"
        gaps = counted(len(repaired.left_out), "gap")
        notes.append(f"{channel.name}: left out {number} in {gaps} too long to interpolate; no angle is known there")
    return notes


def _describe_missing_lock_in(name: str, missing: Mask) -> list[str]:
    """A line on the samples beside missing values of a lock-in amplifier, if there are any."""
    if not missing.any():
        return []
    number = f"{counted(int(missing.sum()), 'sample')} of the intensity ({percent(float(missing.mean()))})"
    return [
        f"amplitude_{name}, phase_{name}: left out {number} beside values of the lock-in amplifier that are missing; "
        "no angle is known there"
    ]


def _describe_held(channel: Channel, held: Sequence[tuple[int, int]]) -> list[str]:
    """A line on the samples of a sensor that was stopped, if there are any."""
    if not held:
        return []
    number = sum(stop - first for first, stop in held)
    return [
        f"{channel.name}: {counted(number, 'sample')} ({number / channel.size:.2g} of all) at which it stands at one "
        "value are left out of phase, amplitude and picture"
    ]


def find_position_signal(recording: Recording, axis: Axis, name: str) -> tuple[Channel, float, float, float | None]:
    """(channel, gain, offset, noise sd in rad or None where not stated) of the best position signal of one axis."""
    if f"angle_{name}" in recording:
        return recording[f"angle_{name}"], 1.0, 0.0, None
    if f"sense_{name}" in recording and isinstance(axis.readout, Position):
        readout = axis.readout
        return recording[f"sense_{name}"], readout.gain, readout.offset, readout.noise_sd / abs(readout.gain)
    sense, advice = f"sense_{name}", f"choose another estimator, record it, or state frequency in [{name}.drive]"
    if f"drive_{name}" in recording and "intensity" in recording:
        advice = "record it, or use --estimator picture, which needs the drives and the intensity alone"
    raise ChannelMissing(
        f"is not in the recording, and neither is {sense}"
        if sense not in recording
        else f"is not in the recording and {sense} is no position readout",
        file=recording.path,
        channel=f"angle_{name}",
        hint=f"{advice}; it holds {list_names(recording.names)}",
    )


def reference_from_drive_or_signal(recording: Recording, device: Device, name: str, channel: Channel) -> PhaseReference:
    """The phase reference of one axis from its drive, or from a position signal where no drive is known.

    Without a drive it is the strongest line near the resonance, or of the whole spectrum where the main oscillation is
    far below the resonance: a sawtooth has harmonics at the resonance too.
    """
    if f"drive_{name}" in recording and device.axis(name).drive is not None:
        return phase_reference(recording, device, name, channel)
    axis, band = device.axis(name), (0.0, np.inf)
    if axis.mechanics and not has_slow_oscillation(channel, 0.8 * axis.resonance):
        band = (0.8 * axis.resonance, 1.25 * axis.resonance)
    return absolute_reference(tone_frequency(channel, *band), channel.start, channel.end)


def reference_of_any_waveform(recording: Recording, device: Device, name: str, channel: Channel) -> PhaseReference:
    """The phase reference of one axis whose motion may be slow or no sine: a spiral, a raster, a step.

    It is that of :func:`reference_from_drive_or_signal`, else the strongest line of the position signal, else a
    frequency that makes the whole recording ``MIN_BLOCKS`` blocks of the slow clock. The angle does not depend on it.
    The spectrum of a ramp or a step has its strongest line at few periods, where no sine fits it: that is no frequency.
    """
    references = (
        lambda: reference_from_drive_or_signal(recording, device, name, channel),
        lambda: absolute_reference(tone_frequency(channel), channel.start, channel.end),
    )
    most = 2.0 * BLOCK_CYCLES
    for find in references:
        with suppress(BadInput):
            found = find()
            few = found.frequency * channel.size < most * channel.sample_rate
            if found.kind != "absolute" or not few or fit_short_tone(channel, 0.0, most) is not None:
                return found
    lowest = MIN_BLOCKS * (BLOCK_CYCLES + 1.0) * channel.sample_rate / channel.size
    return block_reference(lowest, channel.start, channel.end)
