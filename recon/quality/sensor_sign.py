"""Whether the recording confirms the sign of a sensor of the motion: by its linear drive, an angle channel or edges.

A wrong sign of a sensor's gain in the device file mirrors the picture. A passive oscillator lags the torque of a linear
drive by 0 to 180 degrees, which confirms or contradicts the sign. A torque of combs, or no drive, does neither. Where
the motion itself comes from edges, its sign rests on what is stated of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estimation.reference import tone_frequency
from estimation.signs import sign_from_edges
from scanner.channel import Channel, LazySamples
from scanner.device import AXES, Axis, Device
from scanner.edges import Edges
from scanner.errors import BadInput
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording
from scanner.signal_check import check_signal
from scanner.stages import Mechanics, MotionSensor

COMPARED_SAMPLES = 1 << 16
"""Samples of two channels whose phases are compared: hundreds of periods, short against a drift."""

MIN_PHASE_SHARE = 0.5
"""Sine or cosine from which a phase decides a sign. A motion lags its torque by 30 to 150 degrees near the resonance,
and a delay of the readout adds less than 30."""

MIN_DRIVEN_FRACTION = 0.5
"""Fraction of a motion's power at its drive's frequency from which its phase to the drive is used."""

MAX_DECAY = 0.05
"""Relative decrease of a motion's amplitude from the first to the last quarter of the compared samples up to which its
phase to the drive is used. A motion that decays, as after a start or in a beat with its resonance, may lead its torque:
it then gives energy back."""

MAX_WINDOWS = 8
"""Parts of a recording, from its end to its start, in which a motion that does not decay is looked for."""

MIN_DETUNING_WIDTHS = 3.0
"""Distance from the resonance, over its uncertainty and its width, from which the device predicts the sign of the
response: three standard deviations."""

REFERENCES = {"angle": 0, "velocity": 1, "acceleration": 2}
"""Channels in rad, rad/s and rad/s2, with the number of time derivatives. Their sign is that of the recording."""

GAIN_UNITS = ("V/rad", "V s/rad", "V s2/rad")
"""Unit of the gain of a sensor by the number of time derivatives."""


class ContradictedSign(NamedTuple):
    """An axis whose sensor leads its linear drive, which no passive scanner does.

    Attributes:
        axis: its name.
        channel: name of the sensor's channel.
        lead: phase by which the motion leads the torque [rad].
    """

    axis: str
    channel: str
    lead: float


def find_contradicted_signs(recording: Recording, device: Device) -> Iterator[ContradictedSign]:
    """Yield the axes in which the linear drive contradicts the sign of the sensor."""
    for axis in AXES:
        sensor = _sensor(recording, device.axis(axis), axis)
        if sensor is None:
            continue
        lead = _lead_of_torque(recording, device.axis(axis), axis, *sensor)
        if lead is not None and _sign_by_torque(device, axis, *lead) < 0:
            yield ContradictedSign(axis, sensor[0].name, lead[0])


def describe_inverted_sensors(recording: Recording, device: Device) -> Iterator[str]:
    """Yield a line for every sensor whose sign contradicts its linear drive or the angle channel."""
    for axis, channel, lead in find_contradicted_signs(recording, device):
        yield (
            f"{channel}: the motion leads drive_{axis} by {np.degrees(lead):.0f}°, and a passive scanner lags: the "
            f"signal, its gain or the drive is inverted; if it is the signal or the gain, the picture is mirrored in "
            f"{axis}, and --flip-{axis} turns it"
        )
    for axis in AXES:
        if f"angle_{axis}" in recording and _sign_by_angle(recording, device.axis(axis), axis) < 0:
            yield f"sense_{axis}: moves opposite to angle_{axis}: one of the signals or the gain is inverted"


def without_contradicted_signs(recording: Recording, device: Device, motion: Motion) -> Motion:
    """The motion with the sign "ambiguous" in each axis whose linear drive contradicts the sensor that it is from."""
    axes = dict(motion.axes)
    for axis, channel, _ in find_contradicted_signs(recording, device):
        readout = device.axis(axis).readout
        own = {f"known: {channel}"} | ({f"known: {readout.kind} readout"} if readout is not None else set())
        if axis in axes and axes[axis].sign in own:
            axes[axis] = replace(axes[axis], sign="ambiguous")
    return replace(motion, axes=axes)


def describe_unconfirmed_signs(recording: Recording, device: Device, motion: Motion) -> Iterator[str]:
    """Yield a line for every axis whose sign rests on the gain in the device file alone, or contradicts edges.

    A motion from edges is compared with a sensor and a linear drive of the same axis. One line more names all axes
    whose sign rests on what is stated of their edges.

    Args:
        recording: that the motion was estimated from.
        device: with the readouts.
        motion: of the mirror; an axis that the user has flipped, or whose sign has another source, is left out.
    """
    for axis, moved in motion.axes.items():
        readout, channel = device.axis(axis).readout, recording.channels.get(f"sense_{axis}")
        if not isinstance(readout, MotionSensor) or channel is None:
            continue
        if moved.sign not in (f"known: {channel.name}", f"known: {readout.kind} readout"):
            continue
        stated = f"(gain {readout.gain:+.4g} {GAIN_UNITS[readout.order]})"
        if f"sync_{axis}" in recording.edges:
            opposes, how = sign_from_edges(moved, recording, axis)
            if opposes:
                yield (
                    f"{channel.name}: moves opposite to sync_{axis}: the signal, its gain {stated} or the edges are "
                    f"inverted; if it is the signal or the gain, --flip-{axis} turns the picture"
                )
            if how != "ambiguous":
                continue
        lead = _lead_of_torque(recording, device.axis(axis), axis, channel, readout.gain, readout.order)
        if lead is not None and _sign_by_torque(device, axis, *lead) != 0:
            continue
        if f"angle_{axis}" in recording and _sign_by_angle(recording, device.axis(axis), axis) != 0:
            continue
        drive = device.axis(axis).drive
        linear = drive is not None and drive.motion_per_drive == 1.0 and f"drive_{axis}" not in recording
        yield (
            f"the sign of {channel.name} is taken from the device file {stated}; nothing in the recording confirms it; "
            f"a wrong sign mirrors the picture in {axis}, and --flip-{axis} turns it"
            + (f"; a recorded drive_{axis} would confirm it" if linear else "")
        )
    yield from _describe_signs_by_edges(recording, device, motion)


def _describe_signs_by_edges(recording: Recording, device: Device, motion: Motion) -> Iterator[str]:
    """Yield a line for every axis whose edges contradict a sensor or a drive, and one for all that nothing confirms.

    Edges that are half a turn off give the mirrored picture.
    """
    decisive = {}
    for axis, moved in motion.axes.items():
        if moved.sign != f"known: sync_{axis}":
            continue
        edges, signs = recording.edges[f"sync_{axis}"], _signs_beside_edges(recording, device, axis, moved)
        opposed = [name for name, sign in signs.items() if sign < 0]
        if opposed:
            key, value, opposite = _stated_side(edges)
            yield (
                f"{edges.name}: its edges move opposite to {' and '.join(opposed)}: {key} = {value} is wrong, or "
                f"{' or '.join(opposed)} or its gain is inverted; if the edges, the picture is mirrored in {axis}: "
                f"state {key} = {opposite} or give --flip-{axis}"
            )
        elif not any(signs.values()):
            decisive[axis] = edges
    if not decisive:
        return
    stated, remedies = [], []
    for axis, edges in decisive.items():
        key, value, opposite = _stated_side(edges)
        stated.append(f"{key} = {value} of {edges.name}")
        remedies.append(f"if it is mirrored in {axis}, state {key} = {opposite} or give --flip-{axis}")
    yield (
        f"the sign of {' and '.join(decisive)} rests on {' and '.join(stated)}, and the picture of the opposite is the "
        f"mirror image: compare it with a known target; {'; '.join(remedies)}"
    )


def _signs_beside_edges(recording: Recording, device: Device, axis: str, moved: AxisMotion) -> dict[str, int]:
    """By sensor and drive of an axis: 1 if it confirms the sign of a motion from edges, -1 if it opposes it, else 0."""
    own, angle = device.axis(axis), moved.angle
    samples = LazySamples((angle.size,), np.dtype(float), angle.read)
    motion = Channel(f"sync_{axis}", "rad", angle.sample_rate, angle.start, samples, 0, angle.size)
    sensor, signs = _sensor(recording, own, axis), {}
    if sensor is not None:
        signs[sensor[0].name] = _sign_by_reference(*sensor, motion)
    lead = _lead_of_torque(recording, own, axis, motion, 1.0, 0)
    if lead is not None:
        signs[f"the torque of drive_{axis}"] = _sign_by_torque(device, axis, *lead)
    return signs


def _stated_side(edges: Edges) -> tuple[str, str, str]:
    """Name of the attribute that determines the sign, its value, and the value of the opposite sign."""
    if edges.is_one_direction:
        up, down = "zero-crossing-up", "zero-crossing-down"
        return "event", edges.event, down if edges.event == up else up
    angle = edges.angle or 0.0
    return "angle", f"{angle:.4g} rad", f"{-angle:.4g} rad"


def _sensor(recording: Recording, axis: Axis, name: str) -> tuple[Channel, float, int] | None:
    """(channel, gain, time derivatives) of the sensor that shows the motion of an axis, if one does."""
    if f"angle_{name}" in recording:
        return recording[f"angle_{name}"], 1.0, 0
    if f"sense_{name}" in recording:
        readout = axis.readout
        return (recording[f"sense_{name}"], readout.gain, readout.order) if isinstance(readout, MotionSensor) else None
    for kind, order in REFERENCES.items():
        if f"{kind}_{name}" in recording:
            return recording[f"{kind}_{name}"], 1.0, order
    return None


def _lead_of_torque(
    recording: Recording, axis: Axis, name: str, channel: Channel, gain: float, order: int
) -> tuple[float, float] | None:
    """Phase [rad] by which a motion leads the torque of its linear drive, and their frequency [Hz].

    None without such a drive, or if the motion is not mainly at the drive's frequency.
    """
    drive, own = recording.channels.get(f"drive_{name}"), axis.drive
    if drive is None or own is None or own.motion_per_drive != 1.0:
        return None
    try:
        check_signal(channel, gaps_ok=True)
        check_signal(drive, gaps_ok=True)
        frequency = tone_frequency(drive)
    except BadInput:
        return None
    phasors = _steady_phasors(channel, drive, frequency)
    if phasors is None or 0.5 * abs(phasors[0]) ** 2 <= MIN_DRIVEN_FRACTION * phasors[2]:
        return None
    angle = phasors[0] / (gain * 1j**order)
    return float(np.angle(angle / (phasors[1] * np.sign(own.torque_per_volt or 1.0)))), frequency


def _sign_by_torque(device: Device, name: str, lead: float, frequency: float) -> int:
    """1 if the phase of a motion to its torque confirms its sign, -1 if it contradicts it, 0 if it does neither."""
    if abs(np.sin(lead)) > MIN_PHASE_SHARE:
        return -1 if np.sin(lead) > 0.0 else 1
    mechanics = device.axis(name).mechanics
    if mechanics is None or not _is_detuned(mechanics, frequency, device.tolerance(name, "k")):
        return 0
    expected = 1.0 if frequency < mechanics.resonance else -1.0
    return 1 if expected * np.cos(lead) > 0.0 else -1


def _is_detuned(mechanics: Mechanics, frequency: float, tolerance: float) -> bool:
    """Whether a drive is so far from the resonance that its side is certain."""
    width = 0.5 * tolerance + 1.0 / mechanics.quality
    return abs(frequency / mechanics.resonance - 1.0) > MIN_DETUNING_WIDTHS * width


def _sign_by_angle(recording: Recording, axis: Axis, name: str) -> int:
    """1 if the sensor of an axis moves as its angle channel, -1 if opposite, 0 if neither or without such a sensor."""
    readout, channel, angle = axis.readout, recording.channels.get(f"sense_{name}"), recording[f"angle_{name}"]
    if channel is None or not isinstance(readout, MotionSensor):
        return 0
    return _sign_by_reference(channel, readout.gain, readout.order, angle)


def _sign_by_reference(channel: Channel, gain: float, order: int, angle: Channel) -> int:
    """1 if a sensor of the ``order``-th derivative moves as an angle, -1 if opposite, 0 if neither."""
    try:
        check_signal(channel, gaps_ok=True)
        check_signal(angle, gaps_ok=True)
        phasors = _common_phasors(channel, angle, tone_frequency(angle))
    except BadInput:
        return 0
    if phasors is None or 0.5 * abs(phasors[0]) ** 2 <= MIN_DRIVEN_FRACTION * phasors[2]:
        return 0
    cosine = np.cos(np.angle(phasors[0] / (gain * 1j**order) / phasors[1]))
    return int(np.sign(cosine)) if abs(cosine) > MIN_PHASE_SHARE else 0


def _steady_phasors(motion: Channel, drive: Channel, frequency: float) -> tuple[complex, complex, float] | None:
    """Phasors as ``_common_phasors`` in the last part of a recording in which the motion does not decay, else None."""
    start, stop = max(motion.start, drive.start), min(motion.end, drive.end)
    length = COMPARED_SAMPLES / max(motion.sample_rate, drive.sample_rate)
    count = int(np.clip((stop - start) // length, 1, MAX_WINDOWS))
    for begin in np.linspace(max(stop - length, start), start, count).tolist():
        quarter = 0.25 * (min(begin + length, stop) - begin)
        early, late = (_phasor(motion, at, at + quarter, frequency)[1] for at in (begin, begin + 3.0 * quarter))
        if late >= (1.0 - MAX_DECAY) ** 2 * early:
            return _common_phasors(motion, drive, frequency, begin)
    return None


def _common_phasors(
    first: Channel, second: Channel, frequency: float, begin: float = -np.inf
) -> tuple[complex, complex, float] | None:
    """Phasors of two channels at ``frequency`` [Hz] from ``begin`` [s] on, and the variance of the first.

    None if they share no period, or one is too slow to show it.
    """
    start, stop = max(first.start, second.start, begin), min(first.end, second.end)
    stop = min(stop, start + COMPARED_SAMPLES / max(first.sample_rate, second.sample_rate))
    if not (stop - start) * frequency > 1.0 or min(first.sample_rate, second.sample_rate) < 2.0 * frequency:
        return None
    (a, variance), (b, _) = (_phasor(each, start, stop, frequency) for each in (first, second))
    return (a, b, variance) if abs(b) > 0.0 else None


def _phasor(channel: Channel, start: float, stop: float, frequency: float) -> tuple[complex, float]:
    """Phasor at ``frequency`` [Hz] of a channel between two times [s], and its variance there, 0 without samples.

    Gaps count as zero.
    """
    first, last = (round((time - channel.start) * channel.sample_rate) for time in (start, stop))
    values = np.nan_to_num(channel.read(first, last), nan=0.0, posinf=0.0, neginf=0.0)
    if not values.size:
        return 0j, 0.0
    values = values - values.mean()
    time = channel.time(first, first + values.size)
    return complex(2.0 * np.mean(values * np.exp(-2j * np.pi * frequency * time))), float(np.mean(values**2))
