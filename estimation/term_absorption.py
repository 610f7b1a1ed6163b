"""Parts of a device's terms that a nominal device or a corrected recording can express exactly.

Constants and low-pass corners go into the device, a channel's clock into the channel, drive laws into the drive
channel, and the inverse of memoryless output laws into the channel's samples. ``estimation.term_compensation`` treats
the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import ceil, floor
from types import MappingProxyType

import numpy as np

from estimation.clipped_samples import clip_again, find_rails
from scanner.active_terms import ActiveTerm, with_constants
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.coupled_motion import beside_each_other
from scanner.device import Axis, Device
from scanner.forward_model import AxisTrajectory, DriveInput, apply_channel_terms, effective_drive
from scanner.integrator.nodes import nodes_to_samples, to_nodes
from scanner.recording import Recording
from scanner.replaced_samples import with_samples
from scanner.stages import Amdm

Terms = Mapping[str, Sequence[ActiveTerm]]
"""Active terms by axis."""

NEWTON_ITERATIONS = 8
"""Newton steps of the inverse of an output law: quadratic convergence reaches rounding long before."""

MIN_SLOPE = 0.2
"""Slope of an output law below which its inverse is not attempted: a clipped sample is lost."""

SLOPE_STEP = 1e-4
"""Step of the slope's difference quotient, relative to the signal's standard deviation."""

MAX_INVERSION_ERROR = 0.01
"""Largest error of an inverted sample, in units of the slope's step."""


def absorb_constants(device: Device, terms: Terms) -> Device:
    """The device without terms, with the constants and, for an AMDM readout, the low-pass corners that they state."""
    axes = {name: with_constants(device.sensed_axis(name), active) for name, active in terms.items()}
    shared = device.readout
    for name, active in terms.items():
        readout_terms = [term for term in active if term.term.stage == "readout"]
        readout = axes[name].readout
        if shared is not None:
            readout = with_constants(replace(axes[name], readout=shared), readout_terms).readout
        if isinstance(readout, Amdm):
            corners = [
                corner
                for term in active
                if term.term.corners and term.channel == "sense"
                for corner in term.term.corners(term.values)
            ]
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


def remaining_term(active: ActiveTerm, axis: Axis) -> ActiveTerm:
    """A term without the parts that ``absorb_constants``, ``with_clocks`` and ``with_drives`` have taken over."""
    in_sections = isinstance(axis.readout, Amdm) and active.channel == "sense"
    corners = None if in_sections else active.term.corners
    return replace(active, term=replace(active.term, constants=None, clock=None, voltage=None, corners=corners))


def with_clocks(recording: Recording, terms: Terms) -> Recording:
    """The recording with the times that the terms' clock laws give to sense and angle samples and to sync edges."""
    channels, edges = dict(recording.channels), dict(recording.edges)
    for name, active in terms.items():
        for term in active:
            if term.term.clock is None:
                continue
            names = ("sense", f"sense_{name}") if term.channel == "sense" else (f"{term.channel}_{name}",)
            for channel in (channels[key] for key in names if key in channels):
                ends = np.array([channel.start, channel.end]) - recording.origin
                start, end = (float(t) for t in term.term.clock(ends, term.values))
                moved = replace(channel, start=recording.origin + start, sample_rate=channel.size / (end - start))
                channels[channel.name] = _cut(moved, recording.start, recording.end)
            for late in (edges[key] for key in names if key in edges):
                times = recording.origin + term.term.clock(late.times - recording.origin, term.values)
                edges[late.name] = replace(late, times=times)
    return replace(recording, channels=MappingProxyType(channels), edges=MappingProxyType(edges))


def _cut(channel: Channel, start: float, end: float) -> Channel:
    """The samples of a channel between two times [s]."""
    first = max(0, ceil((start - channel.start) * channel.sample_rate - 1e-6))
    stop = min(channel.size, floor((end - channel.start) * channel.sample_rate + 1e-6))
    start = channel.start + first / channel.sample_rate
    return replace(channel, start=start, first=channel.first + first, stop=channel.first + stop)


def with_drives(recording: Recording, device: Device, terms: Terms) -> Recording:
    """The recording with the effective voltage of each drive, or bias without a drive, in place of the recorded one."""
    channels = dict(recording.channels)
    for name, active in terms.items():
        drive = channels.get(f"drive_{name}", channels.get(f"bias_{name}"))
        if drive is not None and any(term.term.voltage for term in active):
            voltage = effective_drive(device.sensed_axis(name), active, drive_input(drive, recording, drive))
            channels[drive.name] = with_samples(drive, nodes_to_samples(voltage)[:-1])
    return replace(recording, channels=MappingProxyType(channels))


def without_visible_clipping(recording: Recording, bare: Device, terms: Terms) -> Terms:
    """The terms without the clipping of channels of which samples stand at a rail.

    Args:
        bare: device without terms.
    """
    remaining = dict(terms)
    for key, kind, axes in measured_channels(recording, bare):
        if np.isfinite(find_rails(recording[key].read())).any():
            for name in axes:
                remaining[name] = tuple(
                    replace(active, term=replace(active.term, output=None))
                    if active.term.after_noise and active.channel.partition(":")[0] == kind
                    else active
                    for active in remaining[name]
                )
    return remaining


def with_outputs(
    recording: Recording, bare: Device, terms: Terms, treats_clipping: bool = False
) -> tuple[Recording, Terms]:
    """The recording with output laws inverted where that is possible, and the terms that remain.

    A law that maps each sample by the signal at that sample, such as a gain or an offset, is inverted. A law that loses
    samples (clipping) or depends on the motion remains.

    Args:
        bare: device without terms.
        treats_clipping: whether clipped samples have to be recognisable as such.
    """
    channels, remaining = dict(recording.channels), dict(terms)
    for key, kind, axes in measured_channels(recording, bare):
        channel = recording[key]
        laws = {
            name: [term for term in terms[name] if term.term.output and term.channel.partition(":")[0] == kind]
            for name in axes
        }
        filtered = any(term.term.corners and term.channel == kind for name in axes for term in terms[name])
        if filtered or not any(laws.values()):  # the iteration compensates laws behind a low-pass
            continue
        unknown = {
            name: trajectory(
                bare.sensed_axis(name),
                tuple(laws.get(name, ())),
                drive_input(recording.channels.get(f"drive_{name}"), recording, channel),
                np.full(channel.size, np.nan),
            )
            for name in bare.axes
        }
        trajectories = [beside_each_other(unknown)[name] for name in axes]
        readout = bare.sensed_axis(axes[0]).readout

        def law(signal: Array, kind=kind, trajectories=trajectories, readout=readout) -> Array:  # type: ignore[no-untyped-def]
            return apply_channel_terms(kind, np.append(signal, signal[-1]), trajectories, readout)[:-1]

        measured = channel.read()
        inverted = _invert(law, measured)
        if inverted is not None:
            channels[key] = with_samples(channel, clip_again(inverted, measured) if treats_clipping else inverted)
            for name in axes:
                done = laws[name]
                remaining[name] = tuple(
                    replace(term, term=replace(term.term, output=None)) if term in done else term
                    for term in remaining[name]
                )
    return replace(recording, channels=MappingProxyType(channels)), remaining


def _invert(law: Callable[[Array], Array], values: Array) -> Array | None:
    """The signal that ``law`` maps to ``values``, sample by sample by Newton's method.

    None where samples are lost, or where the law is NaN because it depends on the motion.
    """
    signal, step = values, SLOPE_STEP * float(np.nanstd(values))
    for _ in range(NEWTON_ITERATIONS):
        mapped = law(signal)
        slope = (law(signal + step) - mapped) / step
        signal = signal + (values - mapped) / np.where(np.abs(slope) > MIN_SLOPE, slope, 1.0)
    kept = (np.abs(law(signal) - values) <= MAX_INVERSION_ERROR * step) & (slope >= MIN_SLOPE)
    return signal if kept[np.isfinite(values)].all() else None


def measured_channels(recording: Recording, bare: Device) -> list[tuple[str, str, list[str]]]:
    """(channel, kind, axes that it measures) of every sense and angle channel that a device describes."""
    channels = []
    for key in recording.channels:
        kind, _, name = key.partition("_")
        axes = [name] if name else list(bare.axes)
        if kind not in ("sense", "angle") or not all(axis in bare.axes for axis in axes):
            continue
        if kind == "angle" or bare.sensed_axis(axes[0]).readout is not None:
            channels.append((key, kind, axes))
    return channels


def drive_input(drive: Channel | None, recording: Recording, clock: Channel) -> DriveInput:
    """A drive at the samples of ``clock`` and between them; 0 V where none was recorded."""
    step = 1.0 / clock.sample_rate
    half_steps = clock.start + 0.5 * step * np.arange(2 * clock.size + 1)
    voltage = np.zeros(half_steps.size) if drive is None else np.interp(half_steps, drive.time(), drive.read())
    return DriveInput(to_nodes(voltage), step, clock.start - recording.origin)


def trajectory(axis: Axis, terms: tuple[ActiveTerm, ...], drive: DriveInput, angle: Array) -> AxisTrajectory:
    """A known motion as a trajectory; the sample after its last one is extrapolated linearly."""
    extended = np.append(angle, 2.0 * angle[-1] - angle[-2])
    omega = np.gradient(extended, drive.step)
    return AxisTrajectory(axis, terms, drive, extended, omega, nodes_to_samples(drive.voltage))
