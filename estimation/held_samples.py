"""Segments in which a signal of a resonant motion stands at one value: a sensor or a converter that was stopped.

A converter that repeats its last sample, a cable that came off and an amplifier at its rail give equal samples. A
motion at resonance passes its whole range within a period, so that equal samples for a period do not show it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from math import ceil

import numpy as np
from numpy.typing import NDArray

from estimation.reference import tone_frequency
from scanner.channel import MIN_CLIPPED_RUN_SAMPLES, READ_CHUNK_SAMPLES, Channel, LazySamples
from scanner.device import Axis, Device
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.stages import Position

GRID_SAMPLES_PER_RUN = 16
"""Samples of a run that are compared first: fewer than all, and so many that few other segments have equal ones."""


def slowest_motions(recording: Recording, device: Device) -> dict[str, float]:
    """Frequency of the slowest motion that each sense and angle channel shows [Hz], by channel.

    Left out are channels of an axis whose frequency neither a drive nor the device nor a position signal shows, and
    those without equal samples in a row, which no :func:`find_held_runs` needs: a spectrum of the drive takes longer.
    """
    shown = {f"{kind}_{axis}": [axis] for kind in ("sense", "angle") for axis in device.axes}
    shown |= {"sense": list(device.axes)}
    held = {name: axes for name, axes in shown.items() if name in recording and _has_equal_samples(recording[name])}
    frequencies = {
        axis: next(_frequencies(recording, device.axis(axis), axis), None)
        for axis in device.axes
        if any(axis in axes for axes in held.values())
    }
    slowest = {}
    for name, axes in held.items():
        known = [frequency for axis in axes if (frequency := frequencies[axis]) is not None]
        if len(known) == len(axes):
            slowest[name] = min(known)
    return slowest


def _has_equal_samples(channel: Channel) -> bool:
    """Whether a channel has a run of ``MIN_CLIPPED_RUN_SAMPLES`` equal samples, the shortest that may be held."""
    reach = MIN_CLIPPED_RUN_SAMPLES - 1
    for first in range(0, channel.size, READ_CHUNK_SAMPLES):
        values = channel.stored(first, first + READ_CHUNK_SAMPLES + reach)
        run, length = values[1:] == values[:-1], 1
        while length < reach:  # equal to as many samples after each
            more = min(length, reach - length)
            run, length = run[more:] & run[:-more], length + more
        if run.any():
            return True
    return False


def _frequencies(recording: Recording, axis: Axis, name: str) -> Iterator[float]:
    """Frequencies of the motion of an axis [Hz], the best one first."""
    drive = axis.drive
    if drive is not None and f"drive_{name}" in recording:
        with suppress(BadInput):
            yield drive.motion_per_drive * tone_frequency(recording[f"drive_{name}"])
    if drive is not None and drive.frequency is not None:
        yield drive.motion_per_drive * drive.frequency
    if axis.mechanics is not None:
        yield axis.resonance
    positions = ("angle", "sense") if isinstance(axis.readout, Position) else ("angle",)
    for channel in (f"{kind}_{name}" for kind in positions if f"{kind}_{name}" in recording):
        with suppress(BadInput):
            yield tone_frequency(recording[channel])


def find_held_runs(channel: Channel, frequency: float) -> list[tuple[int, int]]:
    """Runs of equal samples that last for a period or longer.

    Args:
        channel: of shape (n,).
        frequency: of the slowest motion that the channel shows [Hz].

    Returns:
        Ranges of samples (first, stop), increasing and disjoint. Samples that are not finite are in none.
    """
    shortest = max(MIN_CLIPPED_RUN_SAMPLES, ceil(channel.sample_rate / frequency))
    runs: list[tuple[int, int]] = []
    if not _may_be_held(channel, shortest):
        return runs
    begin, last = 0, np.nan  # of the run in which the chunk before ended
    for first in range(0, channel.size, READ_CHUNK_SAMPLES):
        values = channel.stored(first, first + READ_CHUNK_SAMPLES)
        changes = first + 1 + np.flatnonzero(values[1:] != values[:-1])
        edges = np.concatenate([[begin], [first] if values[0] != last else [], changes]).astype(np.int64)
        long = np.flatnonzero(np.diff(edges) >= shortest)
        runs += [(int(edges[i]), int(edges[i + 1])) for i in long]
        begin, last = int(edges[-1]), values[-1]
    if channel.size - begin >= shortest:
        runs.append((begin, channel.size))
    return runs


def held_while_driven(recording: Recording, device: Device) -> tuple[str, float, float] | None:
    """The first run of :func:`held_runs_while_driven`; None if there is none.

    Returns:
        Name of the channel, begin and end of the run [s].
    """
    for name, runs in held_runs_while_driven(recording, device).items():
        channel = recording[name]
        begin, end = (channel.start + at / channel.sample_rate for at in runs[0])
        return name, begin, end
    return None


def held_runs_while_driven(recording: Recording, device: Device) -> dict[str, list[tuple[int, int]]]:
    """Runs of samples (first, stop) in which a signal is held while a drive of its axes changes, by channel.

    A free decay ends below the resolution of its converter, where equal samples are right. Channels without such a run
    are left out.
    """
    found = {}
    for name, frequency in slowest_motions(recording, device).items():
        channel, axes = recording[name], [name.partition("_")[2]] if "_" in name else list(device.axes)
        drives = [recording[f"drive_{axis}"] for axis in axes if f"drive_{axis}" in recording]
        runs = [
            run
            for run in find_held_runs(channel, frequency)
            if any(_changes(drive, *(channel.start + at / channel.sample_rate for at in run)) for drive in drives)
        ]
        if runs:
            found[name] = runs
    return found


def _changes(channel: Channel, begin: float, end: float) -> bool:
    """Whether a channel takes several values from ``begin`` to ``end`` [s]."""
    first, stop = (round((time - channel.start) * channel.sample_rate) for time in (begin, end))
    values = channel.stored(max(first, 0), max(min(stop, channel.size), 0))
    return bool(values.size) and bool(np.any(values != values[0]))


def _may_be_held(channel: Channel, shortest: int) -> bool:
    """Whether samples on a coarse grid allow a run of ``shortest`` equal ones. It saves the search in most channels."""
    step = max(1, shortest // GRID_SAMPLES_PER_RUN)
    parts = [
        channel.stored(first, first + READ_CHUNK_SAMPLES)[-first % step :: step]
        for first in range(0, channel.size, READ_CHUNK_SAMPLES)
    ]
    grid = np.concatenate(parts)
    changes = np.flatnonzero(grid[1:] != grid[:-1])
    return int(np.diff(changes, prepend=-1, append=grid.size - 1).max(initial=0)) >= shortest // step


def without_held_samples(channel: Channel, frequency: float) -> Channel:
    """Return a channel whose held samples are missing (NaN); arguments as for :func:`find_held_runs`."""
    runs = find_held_runs(channel, frequency)
    return without_samples(channel, runs) if runs else channel


def without_samples(channel: Channel, runs: Sequence[tuple[int, int]]) -> Channel:
    """Return a channel whose samples in ``runs`` (first, stop) are missing (NaN)."""

    def fetch(first: int, stop: int) -> NDArray[np.float64]:
        values = channel.read(first, stop)
        for begin, end in runs:
            values[max(begin - first, 0) : max(end - first, 0)] = np.nan
        return values

    raw = LazySamples((channel.size,), np.dtype(np.float64), fetch)
    return replace(channel, raw=raw, first=0, stop=channel.size, gain=1.0, offset=0.0)
