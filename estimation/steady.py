"""Motion without a filter: a constant phase as calibrated, or the position sensors' own word."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from estimation.filters import BLOCK_CYCLES, on_clock_of
from estimation.initial import start_from_signal
from estimation.reference import Reference, absolute, dominant_frequency
from estimation.signals import intensity_clock, is_capacitive, reference_of, senses
from scanner.channel import Channel, check_signal
from scanner.demodulate import block_length, block_phasors, unwrapped
from scanner.device import Axis, Device, Position
from scanner.errors import BadInput, ChannelMissing
from scanner.motion import AngleTrack, AxisMotion, Motion
from scanner.recording import Recording

Array = NDArray[np.float64]

POINTS = 200  # of a constant motion's slow clock


def constant(recording: Recording, device: Device) -> Motion:
    """Phase and amplitude of the first stretch, held for the whole recording: what labs do today.

    Its ``phase_sd`` is that of the calibration; it knows nothing of a drift.

    Raises:
        as ``start_from_signal``.
    """
    axes = {}
    for sense in senses(recording, device):
        even = is_capacitive(sense.readout)
        references = {name: reference_of(recording, device, name, sense.channel, even) for name in sense.axes}
        start = start_from_signal(sense, device, references)
        rate, first, n = intensity_clock(recording, sense.channel)
        sampled = first + np.arange(n) / rate
        time = np.linspace(sense.channel.start, sense.channel.end, POINTS)
        for name in sense.axes:
            motion, reference = start.axes[name], references[name]
            axes[name] = AxisMotion(
                time=time,
                phase=np.full(POINTS, motion.phase),
                amplitude=np.full(POINTS, motion.amplitude),
                frequency=reference.frequency_at(time),
                phase_sd=np.full(POINTS, motion.phase_sd),
                angle=AngleTrack(motion.amplitude * np.sin(reference.phase(sampled) + motion.phase), rate, first),
                reference=reference.kind,
                sign=motion.sign,
            )
    return Motion(axes, "constant", {"calibrated_over_s": start.window})


def sensor(recording: Recording, device: Device) -> Motion:
    """Motion as angle channels, else position readouts, give it; their sign is known.

    Raises:
        ChannelMissing: an axis has neither. BadInput: a channel cannot be used.
    """
    axes = {}
    for name, axis in device.axes.items():
        channel, scale, zero, noise_sd = position_channel(recording, axis, name)
        check_signal(channel)
        angle = (channel.read() - zero) / scale
        reference = reference_for(recording, device, name, channel)
        axes[name] = axis_from_angle(angle, channel, reference, noise_sd, intensity_clock(recording, channel))
    return Motion(axes, "sensor", {})


def position_channel(recording: Recording, axis: Axis, name: str) -> tuple[Channel, float, float, float | None]:
    """(channel, gain, offset, noise sd in rad or None where not stated) of the best position signal of one axis."""
    if f"angle_{name}" in recording:
        return recording[f"angle_{name}"], 1.0, 0.0, None
    if f"sense_{name}" in recording and isinstance(axis.readout, Position):
        readout = axis.readout
        return recording[f"sense_{name}"], readout.gain, readout.offset, readout.noise_sd / abs(readout.gain)
    raise ChannelMissing(
        f"is not in the recording and sense_{name} is no position readout",
        file=recording.path,
        channel=f"angle_{name}",
        hint=f"choose another estimator, or record it; there are {', '.join(sorted(recording.channels))}",
    )


def reference_for(recording: Recording, device: Device, name: str, channel: Channel) -> Reference:
    if f"drive_{name}" in recording and device.axis(name).drive is not None:
        return reference_of(recording, device, name)
    own = device.axis(name)
    band = (0.8 * own.resonance, 1.25 * own.resonance) if own.mechanics else (0.0, np.inf)
    return absolute(dominant_frequency(channel, *band), channel.start, channel.end)


def axis_from_angle(
    angle: Array, channel: Channel, reference: Reference, noise_sd: float | None, clock: tuple[float, float, int]
) -> AxisMotion:
    rate = channel.sample_rate
    block = block_length(reference.frequency, rate, BLOCK_CYCLES)
    time, phasors = block_phasors(angle, rate, channel.start, reference.frequency, block)
    if time.size < 2:
        raise BadInput(
            f"is too short to tell its phase: {2 * block} samples are needed",
            file=channel.file,
            channel=channel.name,
            hint="record for longer",
        )
    amplitude = np.abs(phasors)
    if noise_sd is None:  # sixth differences leave no motion; of white noise they scatter sqrt(924) times as much
        noise_sd = float(np.median(np.abs(np.diff(angle[: 1 << 18], n=6))) / 0.6745 / np.sqrt(924.0))
    phase = unwrapped(np.angle(phasors) - reference.phase(time))
    return AxisMotion(
        time=time,
        phase=phase,
        amplitude=amplitude,
        frequency=reference.frequency_at(time) + np.gradient(phase, time) / (2 * np.pi),
        phase_sd=noise_sd / np.maximum(amplitude, 1e-300) * np.sqrt(3.0 / block),  # 3/N: Hann weights, 2/N unweighted
        angle=AngleTrack(on_clock_of(angle, channel, clock), clock[0], clock[1]),
        reference=reference.kind,
        sign=f"known: {channel.name}",
    )


def settle_signs(motion: Motion, recording: Recording, flips: Mapping[str, bool]) -> Motion:
    """Motion with each axis's sign turned where the user or an angle channel says so.

    An even capacitance leaves theta and -theta alike. ``flips`` is the user's word; an angle channel's is taken where
    the sign is ambiguous.
    """
    from dataclasses import replace

    axes = {}
    for name, axis in motion.axes.items():
        turn, sign = flips.get(name, False), axis.sign
        if sign == "ambiguous" and f"angle_{name}" in recording and not turn:
            turn, sign = _opposes(axis, recording[f"angle_{name}"]), f"known: angle_{name}"
        elif turn:
            sign = f"known: --flip-{name}"
        if turn:
            axis = axis.turned()
        axes[name] = replace(axis, sign=sign)
    return replace(motion, axes=axes)


def _opposes(axis: AxisMotion, angle: Channel) -> bool:
    n = min(axis.angle.size, 100_000)
    time = axis.angle.start + np.arange(n) / axis.angle.sample_rate
    m = min(angle.size, int(np.ceil((time[-1] - angle.start) * angle.sample_rate)) + 1)
    told = np.interp(time, angle.time(0, m), angle.read(0, m))
    return float(np.nansum(told * axis.angle.read(0, n))) < 0.0
