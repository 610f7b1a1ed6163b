"""Any estimator on a device that states terms: what they add along the motion is worked out and taken off the signal.

Constants and low-pass corners go into the device, a channel's clock into the channel, drive laws into the drive. Every
other law acts on a motion that is not known yet, so it is met by iteration: the motion found so far is passed through
``scanner.response`` with the terms and without them, the difference is taken off the sense signal, and the motion is
found anew. A term's torque enters as the stiffness and damping that it amounts to at the motion's amplitude (its
describing function), and by the harmonics that it gives the motion. So every estimator takes every term, by the one
definition in the term's file, and keeps its nominal equations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil, floor
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from estimation.signals import reference_of
from scanner.channel import Channel
from scanner.device import Amdm, Axis, Device, Mechanics
from scanner.motion import AngleTrack, AxisMotion, Motion
from scanner.recording import Recording
from scanner.response import (
    Added,
    Inputs,
    Path,
    added_terms,
    passed,
    pulling,
    reference,
    samples,
    sense,
    with_constants,
)
from scanner.trajectory import nominal_values, thirds

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Estimator = Callable[[Recording, Device], Motion]
Left = Mapping[str, Sequence[Added]]

ROUNDS = 8
SETTLED = 0.02  # of the readout's noise: a correction that changes by less is done
INVERSIONS, FLAT = 8, 0.2  # of an output law: steps of Newton, and the slope below which it has lost a sample
POINTS = 64  # of a turn
HARMONICS = 5  # that a torque may give a motion
TURNS, REPEATS = 400, 1e-6  # until hidden states repeat, and how well
OWN = 0.05  # relative distance of two axes' frequencies below which coupled motion is one motion


@dataclass(frozen=True)
class Swing:
    """What the torques of one axis's terms do at one amplitude and frequency.

    Attributes:
        k, b: stiffness [N m/rad] and damping [N m s] that they amount to.
        lines: harmonics of the motion over its amplitude: theta + sum of Re(lines[n] a exp(i n u)), shape
            (HARMONICS + 1,).
        other: motion that the other axis gives this one, over the other's phasor.
    """

    k: float
    b: float
    lines: Complex
    other: complex = 0.0j


def estimate_with_terms(recording: Recording, device: Device, run: Estimator, modelled: bool = True) -> Motion:
    """The motion by ``run``, an estimator that knows nominal devices only, of a device that may have terms.

    Args:
        modelled: its angle is that of a model; False where it is a sensor's, with whatever harmonics there are.

    Raises:
        BadInput: a term that nobody knows, or as ``run``.
    """
    added = {name: added_terms(axis) for name, axis in device.axes.items()}
    if not any(added.values()):
        return run(recording, device)
    bare = folded(device, added)
    left: Left = {name: tuple(_left(each, bare.sensed_axis(name)) for each in terms) for name, terms in added.items()}
    told = with_drives(with_clocks(recording, added), device, added)
    told, left = with_outputs(told, bare, left)
    blind = _without(told, "intensity")
    corrected = blind
    motion, swings = run(blind, bare), dict[str, Swing]()
    for _ in range(ROUNDS if any(_acts(each) for terms in left.values() for each in terms) else 0):
        if modelled:
            swings = {name: swing(bare.axis(name), left, motion, name, blind.duration) for name in left}
        before, corrected = corrected, _corrected(blind, bare, left, swings, motion)
        motion = run(corrected, _linearised(bare, swings))
        if _settled(before, corrected, bare):
            break
    if "intensity" in told:
        motion = run(replace(corrected, channels={**corrected.channels, "intensity": told["intensity"]}),
                     _linearised(bare, swings))  # fmt: skip
    axes = {name: _finished(axis, motion, swings, name) for name, axis in motion.axes.items()}
    axes = {name: _on_recorded_reference(axis, recording, told, bare, name) for name, axis in axes.items()}
    return replace(motion, axes=axes, notes=_notes(left))


def folded(device: Device, added: Mapping[str, Sequence[Added]]) -> Device:
    """The device with the constants and, behind an AMDM readout, the corners that its terms give it; without terms."""
    axes = {name: with_constants(device.sensed_axis(name), terms) for name, terms in added.items()}
    shared = device.readout
    for name, terms in added.items():
        own = with_constants(replace(axes[name], readout=shared), [t for t in terms if t.term.stage == "readout"])
        readout = own.readout if shared is not None else axes[name].readout
        if isinstance(readout, Amdm):
            corners = [c for t in terms if t.term.corners and t.channel == "sense" for c in t.term.corners(t.values)]
            readout = replace(readout, lpf_hz=(*readout.lpf_hz, *corners))
        if shared is not None:
            shared = readout
        else:
            axes[name] = replace(axes[name], readout=readout)
    bare = {
        name: replace(axis, terms={}, readout=None if shared is not None else axis.readout)
        for name, axis in axes.items()
    }
    return replace(device, axes=bare, readout=shared)


def _left(each: Added, axis: Axis) -> Added:
    """A term without what ``folded``, ``with_clocks`` and ``with_drives`` have taken over."""
    in_sections = isinstance(axis.readout, Amdm) and each.channel == "sense"
    corners = None if in_sections else each.term.corners
    return replace(each, term=replace(each.term, constants=None, clock=None, voltage=None, corners=corners))


def _acts(each: Added) -> bool:
    term = each.term
    return term.torque is not None or term.bell is not None or term.modulate is not None or term.on_channel


def with_clocks(recording: Recording, added: Mapping[str, Sequence[Added]]) -> Recording:
    """The recording with each sense and angle channel on the clock that its samples show."""
    channels = dict(recording.channels)
    for name, terms in added.items():
        for each in terms:
            seen = ("sense", f"sense_{name}") if each.channel == "sense" else (f"{each.channel}_{name}",)
            for channel in (channels[key] for key in seen if key in channels and each.term.clock is not None):
                ends = np.array([channel.start, channel.end]) - recording.start
                start, end = (float(t) for t in each.term.clock(ends, each.values))  # type: ignore[misc]
                moved = replace(channel, start=recording.start + start, sample_rate=channel.size / (end - start))
                channels[channel.name] = _within(moved, recording.start, recording.end)
    return replace(recording, channels=MappingProxyType(channels))


def _within(channel: Channel, start: float, end: float) -> Channel:
    first = max(0, ceil((start - channel.start) * channel.sample_rate - 1e-6))
    stop = min(channel.size, floor((end - channel.start) * channel.sample_rate + 1e-6))
    start = channel.start + first / channel.sample_rate
    return replace(channel, start=start, first=channel.first + first, stop=channel.first + stop)


def with_drives(recording: Recording, device: Device, added: Mapping[str, Sequence[Added]]) -> Recording:
    """The recording with the voltage that pulls in place of the one that was recorded."""
    channels = dict(recording.channels)
    for name, terms in added.items():
        drive = channels.get(f"drive_{name}")
        if drive is not None and any(each.term.voltage for each in terms):
            inputs = _inputs(drive, recording, drive)
            channels[drive.name] = _holding(drive, samples(pulling(device.sensed_axis(name), terms, inputs))[:-1])
    return replace(recording, channels=MappingProxyType(channels))


def with_outputs(recording: Recording, bare: Device, left: Left) -> tuple[Recording, Left]:
    """The recording with its channels as they were before the output laws that can be undone, and the other terms.

    A law that answers to a sample by the signal there, a gain or an offset, is undone by iteration; one that has lost
    the sample (a clip) or looks at the motion is left.
    """
    channels, others = dict(recording.channels), dict(left)
    for key, kind, seen in _measured(recording, bare):
        channel = recording[key]
        laws = {each: [t for t in left[each] if t.term.output and t.channel.partition(":")[0] == kind] for each in seen}
        slow = any(t.term.corners and t.channel == kind for each in seen for t in left[each])  # not exchangeable
        if slow or not any(laws.values()):
            continue
        nowhere = np.full(channel.size, np.nan)
        paths = [
            _path(
                bare.sensed_axis(each),
                tuple(laws[each]),
                _inputs(recording.channels.get(f"drive_{each}"), recording, channel),
                nowhere,
            )
            for each in seen
        ]
        readout, given = bare.sensed_axis(seen[0]).readout, channel.read()

        def law(signal: Array, kind=kind, paths=paths, readout=readout) -> Array:  # type: ignore[no-untyped-def]
            return passed(kind, np.append(signal, signal[-1]), paths, readout)[:-1]

        before, nudge = given, 1e-4 * float(np.nanstd(given))
        for _ in range(INVERSIONS):  # Newton's, sample by sample
            shown = law(before)
            slope = (law(before + nudge) - shown) / nudge
            before = before + (given - shown) / np.where(np.abs(slope) > FLAT, slope, 1.0)
        lost = (np.abs(law(before) - given) > 0.01 * nudge) | (slope < FLAT)
        if not lost[np.isfinite(given)].any():
            channels[key] = _holding(channel, before)
            for each in seen:
                done = laws[each]
                others[each] = tuple(
                    replace(t, term=replace(t.term, output=None)) if t in done else t for t in others[each]
                )
    return replace(recording, channels=MappingProxyType(channels)), others


def _measured(recording: Recording, bare: Device) -> list[tuple[str, str, list[str]]]:
    """(channel, kind, axes that it sees) of every sense and angle channel behind a law."""
    found = []
    for key in recording.channels:
        kind, _, name = key.partition("_")
        seen = [name] if name else list(bare.axes)
        if kind not in ("sense", "angle") or not all(each in bare.axes for each in seen):
            continue
        if kind == "angle" or bare.sensed_axis(seen[0]).readout is not None:
            found.append((key, kind, seen))
    return found


def _inputs(drive: Channel | None, recording: Recording, clock: Channel) -> Inputs:
    """A drive at the samples of ``clock`` and between them; 0 V where none was recorded."""
    step = 1.0 / clock.sample_rate
    half = clock.start + 0.5 * step * np.arange(2 * clock.size + 1)
    volt = np.zeros(half.size) if drive is None else np.interp(half, drive.time(), drive.read())
    return Inputs(thirds(volt), step, clock.start - recording.start)


def _holding(channel: Channel, values: Array) -> Channel:
    return replace(channel, raw=values, first=0, stop=values.size, gain=1.0, offset=0.0)


def _without(recording: Recording, name: str) -> Recording:
    return replace(recording, channels={key: value for key, value in recording.channels.items() if key != name})


def swing(axis: Axis, left: Left, motion: Motion, name: str, duration: float) -> Swing:
    """What the torques of an axis's terms do along its motion, on the whole: at its median amplitude and frequency.

    Laws of time are taken at the recording's middle; what they do before and after, an estimator follows by itself.
    """
    own = motion.axes[name]
    a, w = float(np.median(own.amplitude)), 2 * np.pi * float(np.median(own.frequency))
    mechanics = axis.mechanics
    if mechanics is None or not any(each.term.torque for each in left[name]):
        return Swing(0.0, 0.0, np.zeros(HARMONICS + 1, np.complex128))

    def answer(line: complex, rate: float) -> complex:
        return line / (mechanics.k - mechanics.J * rate * rate + 1j * mechanics.b * rate)

    torques = [torque_lines(each, axis, a, w, 0.5 * duration) for each in left[name] if each.term.torque]
    force = np.sum(torques, axis=0)
    lines = np.array([answer(line, n * w) / a for n, line in enumerate(force)])
    lines[1] = 0.0
    found = Swing(float(force[1].imag / a), float(-force[1].real / (a * w)), lines)
    for other in (each for each in motion.axes if each != name):
        size, rate = (float(np.median(v)) for v in (motion.axes[other].amplitude, motion.axes[other].frequency))
        coupled = [each for each in left[name] if each.term.coupled]
        if coupled and abs(2 * np.pi * rate / w - 1.0) > OWN:
            line = sum(torque_lines(each, axis, 0.0, 2 * np.pi * rate, 0.5 * duration, size)[1] for each in coupled)
            found = replace(found, other=answer(line, 2 * np.pi * rate) / size)
    return found


def torque_lines(each: Added, axis: Axis, a: float, w: float, time: float, other: float = 0.0) -> Complex:
    """Harmonics of a term's torque, sum of Re(line exp(i n u)), along a sin u, the other axis at ``other`` sin u.

    Hidden states are stepped turn by turn until they repeat.

    Returns:
        shape (HARMONICS + 1,) [N m].
    """
    turn = 2 * np.pi * np.arange(POINTS) / POINTS
    nominal, p = nominal_values(axis), np.asarray(each.values, np.float64)
    step = 2 * np.pi / (w * POINTS)

    def law(u: float, z: Array) -> tuple[float, Array]:
        found = each.term.torque(  # type: ignore[misc]
            time, a * np.sin(u), a * w * np.cos(u), other * np.sin(u), 0.0, z[0], z[1], p, nominal
        )
        return found[0], np.array(found[1:])

    z, torque = np.zeros(2), np.zeros(POINTS)
    for _ in range(TURNS if each.term.hidden else 1):
        began = torque.copy()
        for j, u in enumerate(turn):
            torque[j], d1 = law(u, z)
            if each.term.hidden:
                half = u + np.pi / POINTS
                d2 = law(half, z + 0.5 * step * d1)[1]
                d3 = law(half, z + 0.5 * step * d2)[1]
                d4 = law(half + np.pi / POINTS, z + step * d3)[1]
                z = z + step / 6.0 * (d1 + 2.0 * d2 + 2.0 * d3 + d4)
        if np.abs(torque - began).max() <= REPEATS * np.abs(torque).max():
            break
    lines = np.fft.rfft(torque)[: HARMONICS + 1] * (2.0 / POINTS)
    lines[0] *= 0.5
    return lines


def _linearised(device: Device, swings: Mapping[str, Swing]) -> Device:
    """The device with the stiffness and damping that its terms amount to."""
    axes = dict(device.axes)
    for name, found in swings.items():
        if (m := axes[name].mechanics) is not None:
            axes[name] = replace(axes[name], mechanics=Mechanics(m.J, max(m.b + found.b, 0.01 * m.b), m.k + found.k))
    return replace(device, axes=axes)


def _phasor(angle: Array, rate: float, w: float) -> Complex:
    """a exp(i u) of theta = a sin u, from the angle and its slope."""
    return np.gradient(angle, 1.0 / rate) / w + 1j * angle


def _whole_angle(angles: Mapping[str, Array], rate: float, motion: Motion, swings: Mapping[str, Swing],
                 name: str) -> Array:  # fmt: skip
    """An axis's angle with all that its terms' torques add, all axes' angles at one ``rate`` [Hz]."""
    found = swings.get(name)
    if found is None or not (found.lines.any() or found.other):
        return angles[name]
    phasors = {
        each: _phasor(angle, rate, 2 * np.pi * float(np.median(motion.axes[each].frequency)))
        for each, angle in angles.items()
    }
    size = np.abs(phasors[name])
    turn = phasors[name] / np.maximum(size, 1e-300)
    total = angles[name].copy()
    for n, line in enumerate(found.lines):
        if line:
            total += size * (line * turn**n).real
    for each in (each for each in angles if each != name):
        total += (found.other * phasors[each]).real
    return total


def _angles_on(channel: Channel, motion: Motion) -> dict[str, Array]:
    """Every axis's angle at the samples of a channel, shape (n,) [rad]; 0 where the motion is not told."""
    from scipy.interpolate import CubicSpline

    found = {}
    for name, axis in motion.axes.items():
        track = axis.angle
        values = track.read(0, track.size)
        same = (track.sample_rate, track.start, track.size) == (channel.sample_rate, channel.start, channel.size)
        if not same:
            told = np.isfinite(values)
            time = track.start + np.arange(track.size)[told] / track.sample_rate
            values = CubicSpline(time, values[told], extrapolate=False)(channel.time())
        found[name] = np.nan_to_num(values)
    return found


def _corrected(recording: Recording, bare: Device, left: Left, swings: Mapping[str, Swing],
               motion: Motion) -> Recording:  # fmt: skip
    """The recording with what the terms add along ``motion`` taken off its sense and angle channels."""
    channels = dict(recording.channels)
    for key, kind, seen in _measured(recording, bare):
        channel = recording[key]
        angles = _angles_on(channel, motion)
        plain, full = [], []
        for each in seen:
            inputs = _inputs(recording.channels.get(f"drive_{each}"), recording, channel)
            axis = bare.sensed_axis(each)
            whole = _whole_angle(angles, channel.sample_rate, motion, swings, each)
            plain.append(_path(axis, (), inputs, angles[each]))
            full.append(_path(axis, tuple(left[each]), inputs, whole))
        if kind == "angle":
            change = reference(full[0]) - reference(plain[0])
        else:
            readout = bare.sensed_axis(seen[0]).require_readout()
            change = sense(readout, full) - sense(readout, plain)
        channels[key] = _holding(channel, channel.read() - change[:-1])
    return replace(recording, channels=MappingProxyType(channels))


def _path(axis: Axis, added: tuple[Added, ...], inputs: Inputs, angle: Array) -> Path:
    """A known motion as a path; the step behind its last sample goes on straight."""
    whole = np.append(angle, 2.0 * angle[-1] - angle[-2])
    return Path(axis, added, inputs, whole, np.gradient(whole, inputs.step), samples(inputs.voltage))


def _settled(before: Recording, after: Recording, device: Device) -> bool:
    """Whether no channel's correction changed by what its readout's noise would show."""
    for key, channel in after.channels.items():
        if key.startswith(("sense", "angle")):
            new, old = channel.read(), before[key].read()
            axis = device.sensed_axis(key.partition("_")[2] or next(iter(device.axes)))
            noise = axis.readout.noise_sd if key.startswith("sense") and axis.readout else 0.0
            if np.sqrt(np.nanmean((new - old) ** 2)) > SETTLED * max(noise, 1e-3 * float(np.nanstd(new))):
                return False
    return True


def _finished(axis: AxisMotion, motion: Motion, swings: Mapping[str, Swing], name: str) -> AxisMotion:
    """The axis with the harmonics that its terms give it in its angle."""
    found = swings.get(name)
    if found is None or not (found.lines.any() or found.other):
        return axis
    angles = {each: other.angle.read(0, other.angle.size) for each, other in motion.axes.items()}
    values = _whole_angle(angles, axis.angle.sample_rate, motion, swings, name)
    return replace(axis, angle=AngleTrack(values, axis.angle.sample_rate, axis.angle.start))


def _on_recorded_reference(axis: AxisMotion, recording: Recording, told: Recording, device: Device,
                           name: str) -> AxisMotion:  # fmt: skip
    """The axis with its phase against the drive as recorded, where another one pulled."""
    key = f"drive_{name}"
    if key not in told or told[key] is recording[key]:
        return axis
    pulled, recorded = (reference_of(each, device, name).phase(axis.time) for each in (told, recording))
    return replace(axis, phase=axis.phase + pulled - recorded)


def _notes(left: Left) -> tuple[str, ...]:
    """How the terms were taken, where that is not by their own law."""
    notes = []
    for name, terms in left.items():
        for each in terms:
            if each.term.torque is not None:
                notes.append(f"{each.term.effect} of {name}: as the stiffness, damping and harmonics at the amplitude")
            if each.term.bell is not None:
                notes.append(f"{each.term.effect} of {name}: in what is sensed; its pull as the nominal comb's")
    return tuple(notes)
