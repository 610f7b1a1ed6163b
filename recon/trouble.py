"""What is wrong with a recording and can be lived with: where samples are missing or clipped, and what that touches."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from scanner.channel import CHUNK, Channel
from scanner.motion import Motion
from scanner.recording import Recording

CLIPPED_RUN = 8  # equal samples in a row at a signal's extreme: noise would not let them be equal
ONE = 1e-3  # s: stretches closer than this are one, as those of a signal that clips at every swing
UNKNOWN = 0.25  # rad, standard deviation of the phase: 50 pixels of 400 are no place
SPARE = 2.0  # blocks beyond its first and last one that a slow motion may be continued


@dataclass(frozen=True)
class Trouble:
    """A stretch of one channel, from ``start`` to ``stop`` [s].

    Attributes:
        kind: ``"gap"`` (samples that are not finite), ``"clipped"``, ``"missing"`` (the channel begins later or ends
            earlier than the intensity), or ``"leap"`` (see :mod:`recon.leaps`; of the intensity,
            :mod:`recon.lost_light`).
    """

    channel: str
    kind: str
    start: float
    stop: float


Ranges = list[tuple[int, int]]
Number = TypeVar("Number", int, float)


def troubles(recording: Recording) -> list[Trouble]:
    """What is wrong with the channels that a picture is made of, channel by channel in order of time."""
    intensity = recording["intensity"]
    found: list[Trouble] = []
    for name, channel in recording.channels.items():
        if name.startswith(("sense", "drive_", "angle_")) or name == "intensity":
            found += _missing(channel, intensity)
            found += _stretches(channel, "gap", _gaps(channel))
            if name.startswith("sense"):
                found += _stretches(channel, "clipped", _clipped(channel))
    return found


def unknown(motion: Motion, found: Sequence[Trouble]) -> list[tuple[float, float]]:
    """Intervals [s] of trouble in which no one can say where the mirror was: their samples belong to no pixel."""
    lost = []
    for axis in motion.axes.values():
        half = 0.5 * float(axis.time[1] - axis.time[0])
        first, last = float(axis.time[0]) - 2 * SPARE * half, float(axis.time[-1]) + 2 * SPARE * half
        lost += [(-np.inf, first), (last, np.inf)]
        known = np.nan_to_num(axis.phase_sd, nan=np.inf) <= UNKNOWN
        lost += [(float(axis.time[a]) - half, float(axis.time[b - 1]) + half) for a, b in runs(~known)]
    return [
        (max(low, each.start), min(high, each.stop))
        for each in found
        if each.channel != "intensity"
        for low, high in lost
        if max(low, each.start) < min(high, each.stop)
    ]


def samples(intervals: Iterable[tuple[float, float]], channel: Channel) -> Ranges:
    """Samples (first, stop) of a channel in intervals [s], increasing and apart."""
    edges = np.array(sorted(intervals), float).reshape(-1, 2)
    ends = np.clip(np.round((edges - channel.start) * channel.sample_rate), 0, channel.size).astype(int)
    return [(a, b) for a, b in joined(ends.tolist(), 0) if a < b]


def without(ranges: Ranges, others: Ranges) -> Ranges:
    """The parts of ``ranges`` outside ``others``."""
    left = ranges
    for low, high in others:
        left = [part for a, b in left for part in ((a, min(b, low)), (max(a, high), b)) if part[0] < part[1]]
    return left


def told(found: Sequence[Trouble]) -> Iterator[str]:
    """A line for each channel and kind."""
    for (channel, kind), group in groupby(found, lambda each: (each.channel, each.kind)):
        stretches = list(group)
        lasting = sum(each.stop - each.start for each in stretches)
        places = "one stretch" if len(stretches) == 1 else f"{len(stretches)} stretches"
        yield f"{channel}: {kind} for {1e3 * lasting:.4g} ms in {places}, the first at {stretches[0].start:.6g} s"


def _missing(channel: Channel, intensity: Channel) -> list[Trouble]:
    spare = 2.0 / min(channel.sample_rate, intensity.sample_rate)
    parts = ((intensity.start, channel.start), (channel.end, intensity.end))
    return [Trouble(channel.name, "missing", a, b) for a, b in parts if b - a > spare]


def _stretches(channel: Channel, kind: str, ranges: Ranges) -> list[Trouble]:
    whole = joined(ranges, round(ONE * channel.sample_rate))
    rate = channel.sample_rate
    return [Trouble(channel.name, kind, channel.start + a / rate, channel.start + b / rate) for a, b in whole]


def _chunks(channel: Channel) -> Iterator[tuple[int, NDArray[Any]]]:
    """Samples as they are stored, which tells what is missing or clipped as well and costs less to read."""
    for first in range(0, channel.size, CHUNK):
        yield first, channel.stored(first, first + CHUNK)


def _gaps(channel: Channel) -> Ranges:
    if channel.raw.dtype.kind != "f":
        return []
    found: Ranges = []
    for first, values in _chunks(channel):
        bad = ~np.isfinite(values)
        if bad.any():
            found += [(first + a, first + b) for a, b in runs(bad.reshape(len(bad), -1).any(axis=1))]
    return found


def _clipped(channel: Channel) -> Ranges:
    """Runs of CLIPPED_RUN and more equal samples at the least and at the largest value there is."""
    extremes, found = [np.inf, -np.inf], ([], [])  # type: tuple[list[float], tuple[Ranges, Ranges]]
    for first, values in _chunks(channel):
        for side, furthest, beyond in ((0, np.fmin, np.less), (1, np.fmax, np.greater)):
            extreme = float(furthest.reduce(values))
            if beyond(extreme, extremes[side]):
                extremes[side] = extreme
                found[side].clear()
            at = values == extremes[side]
            if np.count_nonzero(at) >= CLIPPED_RUN:
                found[side].extend((first + a, first + b) for a, b in runs(at) if b - a >= CLIPPED_RUN)
    return sorted(found[0] + found[1])


def runs(mask: NDArray[np.bool_]) -> Ranges:
    """(first, stop) of the runs of True."""
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def joined(ranges: Iterable[Sequence[Number]], near: Number) -> list[tuple[Number, Number]]:
    """Increasing ranges, those at most ``near`` apart as one."""
    whole: list[tuple[Number, Number]] = []
    for a, b in ranges:
        if whole and a - whole[-1][1] <= near:
            whole[-1] = whole[-1][0], max(b, whole[-1][1])
        else:
            whole.append((a, b))
    return whole
