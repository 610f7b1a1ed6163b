"""Ranges of samples (first, stop): conversion from seconds, union and difference."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from scanner.channel import Channel

SampleRanges = list[tuple[int, int]]
"""Half-open ranges (first, stop) of sample numbers, increasing and disjoint."""

Number = TypeVar("Number", int, float)


def to_sample_ranges(intervals: Iterable[tuple[float, float]], channel: Channel) -> SampleRanges:
    """Return the samples of a channel that lie in intervals [s], as increasing disjoint ranges."""
    edges = np.array(sorted(intervals), float).reshape(-1, 2)
    ends = np.clip(np.round((edges - channel.start) * channel.sample_rate), 0, channel.size).astype(int)
    return [(first, stop) for first, stop in merge_ranges(ends.tolist(), 0) if first < stop]


def subtract_ranges(ranges: SampleRanges, removed: SampleRanges) -> SampleRanges:
    """Return the parts of ``ranges`` outside ``removed``, in the order of ``ranges``."""
    ends = [high for _, high in removed]
    left: SampleRanges = []
    for begin, end in ranges:
        for k in range(bisect_right(ends, begin), len(removed)):
            low, high = removed[k]
            if low >= end:
                break
            if begin < low:
                left.append((begin, low))
            begin = high
        if begin < end:
            left.append((begin, end))
    return left


def runs_of_true(mask: NDArray[np.bool_]) -> SampleRanges:
    """Return the ranges of indices in which a one-dimensional mask is True."""
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False))
    return [(int(first), int(stop)) for first, stop in edges.reshape(-1, 2)]


def merge_ranges(ranges: Iterable[Sequence[Number]], max_gap: Number) -> list[tuple[Number, Number]]:
    """Merge ranges that are at most ``max_gap`` apart.

    Args:
        ranges: of increasing starts.
        max_gap: in the unit of the ranges.
    """
    merged: list[tuple[Number, Number]] = []
    for first, stop in ranges:
        if merged and first - merged[-1][1] <= max_gap:
            merged[-1] = merged[-1][0], max(stop, merged[-1][1])
        else:
            merged.append((first, stop))
    return merged
