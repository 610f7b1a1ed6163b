"""Samples that were lost on the way, without a gap in the time base: the phase of a line leaps.

A drive goes on evenly and a resonant mirror cannot follow a leap, so one shows that the channel's clock jumped. How
many samples are missing a phase tells only up to whole periods, so nothing is mended: what lies between leaps is used.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from estimation.reference import dominant_frequency
from recon.mapping import Grid, accumulate
from recon.trouble import Trouble, joined, runs
from scanner.channel import Channel
from scanner.demodulate import block_length, block_phasors
from scanner.errors import BadInput
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording

Array = NDArray[np.float64]

CYCLES = 8.0  # of a line, a look at its phase
APART = 2e-3  # s from one look to the next
MOST_LOOKS = 400  # at a line; further apart in a long recording
SIDE = 8  # looks on either side that tell how the phase goes on
LEAST = {"drive": 0.02, "sense": 0.3}  # rad: a mirror's phase wanders, a drive's does not
OVER_NOISE = 12.0  # in standard deviations of what the phase does otherwise
ALONE = 4.0  # times what the phase does in the steps around
STEADY = 0.3  # of a line's median amplitude: below it there is no phase to tell


def leaps(recording: Recording) -> list[Trouble]:
    """Where the phase of a drive, or of a sense signal at a drive's line, leaps."""
    lines: dict[str, float] = {}
    found: list[Trouble] = []
    for name, channel in recording.channels.items():
        if name.startswith("drive_"):
            try:
                lines[name[-1]] = dominant_frequency(channel)
            except BadInput:  # it does not oscillate: nothing that could leap
                continue
            found += _leaps(channel, lines[name[-1]], LEAST["drive"])
    for name, channel in recording.channels.items():
        if name.startswith("sense"):
            for axis, frequency in lines.items():
                if name in ("sense", f"sense_{axis}"):
                    found += _leaps(channel, frequency, LEAST["sense"])
    return found


def longest_stretch(recording: Recording, found: Sequence[Trouble]) -> tuple[float, float]:
    """Begin and end [s] of the longest stretch without a leap."""
    edges = stretches(found)
    begins, ends = [recording.start, *(stop for _, stop in edges)], [*(start for start, _ in edges), recording.end]
    return max(zip(begins, ends, strict=True), key=lambda stretch: stretch[1] - stretch[0])


def stretches(found: Sequence[Trouble]) -> list[tuple[float, float]]:
    """Their stretches [s], increasing, those that overlap as one: drive and sense show one leap each in their way."""
    return joined(sorted((each.start, each.stop) for each in found), 0.0)


def passed(motion: Motion, found: Sequence[Trouble], grid: Grid) -> NDArray[np.bool_]:
    """Pixels that the beam would have passed during the leaps beside its motion, had it gone on as at those ends.

    Returns:
        Shape (height, width).
    """
    counts = np.zeros((grid.height, grid.width), np.uint32)
    track = motion.axes["x"].angle
    begin, end = track.start, track.start + track.size / track.sample_rate
    for start, stop in stretches(found):
        if min(abs(stop - begin), abs(start - end)) < 0.5 * (stop - start):
            time = np.arange(start, stop, 1 / track.sample_rate)
            x, y = (_continued(motion.axes[name], time) for name in ("x", "y"))
            accumulate(x, y, np.zeros(time.size), grid, counts=counts)
    return counts > 0


def _continued(axis: AxisMotion, time: Array) -> Array:
    """Angles [rad] before a motion's first sample or behind its last one, by the sine of the CYCLES next to it."""
    track, late = axis.angle, time[0] > axis.angle.start
    turn = 2 * np.pi * axis.frequency[-1 if late else 0]
    count = min(track.size, round(CYCLES * 2 * np.pi / turn * track.sample_rate))
    first = track.size - count if late else 0

    def sine(at: Array) -> Array:
        return np.stack([np.ones_like(at), np.cos(turn * at), np.sin(turn * at)], -1)

    near = track.start + np.arange(first, first + count) / track.sample_rate
    law = np.linalg.lstsq(sine(near - near[0]), track.read(first, first + count), rcond=None)[0]
    return np.asarray(sine(time - near[0]) @ law, np.float64)


def _leaps(channel: Channel, frequency: float, least: float) -> Iterator[Trouble]:
    time, phase, size = _looks(channel, frequency)
    if time.size < 2 * SIDE:
        return
    step = _turned(np.diff(phase))
    step = _turned(step - np.angle(np.mean(np.exp(1j * step))))
    usual = np.array([np.median(step[max(0, i - SIDE) : i + SIDE + 1]) for i in range(step.size)])
    excess = step - usual
    pair = _turned(excess[:-1] + excess[1:])  # a leap within a look is shared by the steps before and behind it
    limit = max(least, OVER_NOISE * 1.48 * float(np.median(np.abs(pair))))
    beside = np.maximum(np.abs(excess[:-3]), np.abs(excess[3:]))  # a transient shows in the steps around it too
    steady = size > STEADY * np.median(size)
    alone = (np.abs(pair[1:-1]) > np.maximum(limit, ALONE * beside)) & steady[1:-3] & steady[3:-1]
    for low, high in runs(alone):
        yield Trouble(channel.name, "leap", float(time[low + 1]), float(time[high + 2]))


def _looks(channel: Channel, frequency: float) -> tuple[Array, Array, Array]:
    """Times [s], phases against the line [rad] and amplitudes, each of shape (looks,)."""
    block = block_length(frequency, channel.sample_rate, CYCLES)
    stride = max(block, round(APART * channel.sample_rate), channel.size // MOST_LOOKS)
    stride = max(block, min(stride, channel.size // (4 * SIDE)))
    firsts = np.arange(0, channel.size - block + 1, stride)
    looks = np.concatenate([channel.read(first, first + block) for first in firsts.tolist()] or [np.empty(0)])
    _, z = block_phasors(looks, channel.sample_rate, 0.0, frequency, block)  # phases at the looks' own centres
    time = channel.start + (firsts + 0.5 * (block - 1)) / channel.sample_rate
    seen = np.isfinite(z)  # through a gap the phase runs on
    time, z = time[seen], z[seen] * np.exp(-2j * np.pi * frequency * time[seen])
    return np.asarray(time, np.float64), np.asarray(np.angle(z), np.float64), np.asarray(np.abs(z), np.float64)


def _turned(angle: Array) -> Array:
    """Angles in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
