"""Where the position z of the objective or the stage rests.

z rests in an interval in which it moves at less than ``REST_SPEED`` of its mean speed. The mean speed is the length of
its path over the duration. Both are measured with a band of one width: a part of the recording in which z stays within
a band of width w moves at the speed w over its duration. Narrow bands break at the noise of z, wide ones contain
movement. The width is chosen such that the rests last longest beyond the time in which a steady movement crosses their
bands. A ramp moves at its mean speed throughout and has no rests; a sinusoid is slower than a quarter of its mean speed
for 41 % of the time at most, so that rests are accepted from ``MIN_REST_SHARE`` of the time on.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanner.arrays import Array
from scanner.channel import Channel
from scanner.errors import BadInput
from scanner.sample_ranges import SampleRanges, to_sample_ranges

MAX_BLOCKS = 2048
"""Blocks into which z is divided: of 100 slices, each has twenty. A rest loses up to a block at both ends."""

MERGED_BLOCKS = 4
"""Blocks that are merged to one, once and twice, to find rests in a noisy z: longer blocks average its noise."""

REST_SPEED = 0.25
"""Speed of a resting z, relative to its mean speed: the steps of a stack have to exceed the noise within a rest
fourfold (a single step eightfold), and the slow parts of a sinusoid around its turning points are a minority."""

MIN_REST_SHARE = 0.5
"""Part of the time that z has to rest: a sinusoid reaches 0.41, a stack of a microscope nearly 1."""

SINE_SWING = 2.0**0.5
"""Amplitude of a sinusoid in its standard deviations: by it the extremes of a z that oscillates within a block follow
from the block, and those of the noise do not count."""

MIN_NOISE_SAMPLES = 32
"""Samples of z from which successive differences distinguish noise from movement: their ratio is then 2 ± 0.35."""

BAND_WIDTHS = 2.0 ** -np.arange(24.0, 0.5, -0.5)
"""Widths of the band that are tried, in travels of z: from a step of a converter of 24 bits to half the travel."""


class PositionBlocks(NamedTuple):
    """Blocks of z. Those with missing samples have no mean, and fit into no band.

    Attributes:
        edges: first sample of each block, and the end of the last one.
        mean, low, high: mean, and mean less and plus the standard deviation, shape (blocks,) [m].
        least, most: extremes of z, without those of its noise [m].
        missing: number of samples that are not finite.
        constant: z scatters about its mean like white noise, or not at all.
    """

    edges: NDArray[np.intp]
    mean: Array
    low: Array
    high: Array
    least: float
    most: float
    missing: int
    constant: bool


def rest_ranges(position: Channel, intensity: Channel) -> SampleRanges:
    """Return the samples of the intensity during which z rests at one position; all where z nowhere rests."""
    try:
        position = cut_to_intensity(position, intensity)
        blocks, rests, _ = find_z_rests(read_blocks(position))
    except BadInput:
        return [(0, intensity.size)]
    if blocks.constant or not rests.size:
        return [(0, intensity.size)]
    return to_sample_ranges(np.stack(rest_times(position, blocks, rests), axis=1).tolist(), intensity)


def cut_to_intensity(position: Channel, intensity: Channel) -> Channel:
    """Return the part of z during the intensity, and one sample beyond it at both ends.

    Raises:
        BadInput: there is none.
    """
    begin = int(np.clip(np.floor((intensity.start - position.start) * position.sample_rate), 0, position.size))
    end = int(np.clip(np.ceil((intensity.end - position.start) * position.sample_rate) + 1, 0, position.size))
    if begin >= end:
        hint = "check the start of both channels"
        raise BadInput("has no sample during the intensity", file=position.file, channel=position.name, hint=hint)
    start = position.start + begin / position.sample_rate
    return replace(position, start=start, first=position.first + begin, stop=position.first + end)


def read_blocks(position: Channel) -> PositionBlocks:
    """Return mean and scatter of z in each block, read block by block.

    Raises:
        BadInput: no block is without a missing sample.
    """
    count = min(position.size, MAX_BLOCKS)
    edges = np.linspace(0, position.size, count + 1).astype(np.intp)
    mean, sd = np.empty(count), np.empty(count)
    finite, before = 0, np.nan
    reference, total, squares, differences = np.nan, 0.0, 0.0, 0.0
    for k in range(count):
        values = position.read(int(edges[k]), int(edges[k + 1]))
        values[~np.isfinite(values)] = np.nan
        mean[k], sd[k] = values.mean(), values.std()
        differences += float(np.nansum(np.diff(values, prepend=before) ** 2))
        before = values[-1]
        known = values[np.isfinite(values)]
        if known.size:
            reference = known[0] if np.isnan(reference) else reference
            finite += known.size
            total, squares = total + (known - reference).sum(), squares + ((known - reference) ** 2).sum()
    if not np.isfinite(mean).any():
        hint = "check that it was recorded"
        raise BadInput(
            "has samples that are not finite throughout", file=position.file, channel=position.name, hint=hint
        )
    # Successive differences of white noise have twice its variance (von Neumann 1941); those of a movement far less.
    least, most = np.nanmin(mean - SINE_SWING * sd), np.nanmax(mean + SINE_SWING * sd)
    scatter = squares - total**2 / finite
    constant = differences >= scatter and (scatter == 0.0 or finite >= MIN_NOISE_SAMPLES)
    # A converter's step limits what can be known of z: it belongs to the band.
    sd += 0.5 * abs(position.gain) if position.raw.dtype.kind in "iu" and not constant else 0.0
    low, high = np.nan_to_num(mean - sd, nan=-np.inf), np.nan_to_num(mean + sd, nan=np.inf)
    return PositionBlocks(edges, mean, low, high, least, most, position.size - finite, constant)


def find_z_rests(blocks: PositionBlocks) -> tuple[PositionBlocks, NDArray[np.intp], float]:
    """Return where z rests: of all band widths and three lengths of the blocks, those rests that last longest.

    Returns:
        The blocks in use, first block and end of each rest, shape (rests, 2), and the width of the band [m]. There are
        no rests if they last less than ``MIN_REST_SHARE`` in total.
    """
    best, used, rests, width = 0.0, blocks, np.empty((0, 2), np.intp), 0.0
    longer = merge_blocks(blocks)
    for each in (blocks, longer, merge_blocks(longer)):
        for band in (blocks.most - blocks.least) * BAND_WIDTHS:
            found, excess = _slow_segments(each, band)
            if excess > best:
                best, used, rests, width = excess, each, found, band
    enough = np.sum(rests[:, 1] - rests[:, 0]) > MIN_REST_SHARE * used.mean.size
    return used, rests if enough else rests[:0], width


def merge_blocks(blocks: PositionBlocks) -> PositionBlocks:
    """Return the blocks with ``MERGED_BLOCKS`` merged to one each."""
    firsts = np.arange(0, blocks.mean.size, MERGED_BLOCKS)
    length = np.diff(blocks.edges).astype(np.float64)
    total = np.add.reduceat(length, firsts)
    offset = np.nanmean(blocks.mean)  # without which squares would hide the noise of a z far from 0
    mean, sd = blocks.mean - offset, 0.5 * (blocks.high - blocks.low)
    merged = np.add.reduceat(length * mean, firsts) / total
    variance = np.add.reduceat(length * (sd**2 + mean**2), firsts) / total - merged**2
    sd = np.sqrt(np.maximum(variance, 0.0))
    edges = np.append(blocks.edges[firsts], blocks.edges[-1])
    low, high = (np.nan_to_num(merged + offset + side * sd, nan=side * np.inf) for side in (-1.0, 1.0))
    return blocks._replace(edges=edges, mean=merged + offset, low=low, high=high)


def rest_times(position: Channel, blocks: PositionBlocks, rests: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return the times of the first and the last sample of z in each rest, and those of the ends of the channel [s]."""
    starts, stops = (position.start + edge / position.sample_rate for edge in blocks.edges[rests].T - [[0], [1]])
    if rests[0, 0] == 0:
        starts[0] = position.start - 1.0 / position.sample_rate
    if rests[-1, 1] == blocks.mean.size:
        stops[-1] = position.end
    return starts, stops


def _slow_segments(blocks: PositionBlocks, band: float) -> tuple[NDArray[np.intp], float]:
    """Segments within bands of one width that z crosses at less than ``REST_SPEED`` of its mean speed.

    Returns:
        First block and end of each, shape (segments, 2), those that follow each other without a step merged; and their
        part of the time beyond that in which a steady movement crosses their bands.
    """
    segments = np.array(_segments_within(blocks.low.tolist(), blocks.high.tolist(), band), np.intp).reshape(-1, 2)
    levels = [blocks.mean[first:stop].mean() for first, stop in segments]
    path = float(np.abs(np.diff(levels)).sum())
    steady = band / path if path > 0.0 else np.inf  # part of the time in which the mean speed crosses a band
    share = (segments[:, 1] - segments[:, 0]) / blocks.mean.size
    slow = REST_SPEED * share >= steady
    excess = float(np.sum(share[slow] - steady))
    merged: list[list[int]] = []
    for first, stop in segments[slow].tolist():
        if merged and merged[-1][1] == first and abs(blocks.mean[first] - blocks.mean[first - 1]) <= band:
            merged[-1][1] = stop
        else:
            merged.append([first, stop])
    return np.array(merged, np.intp).reshape(-1, 2), excess


def _segments_within(low: list[float], high: list[float], band: float) -> list[tuple[int, int]]:
    """Successive segments of two blocks or more whose values lie within a band, each as long as possible."""
    segments = []
    first, bottom, top = 0, np.inf, -np.inf
    for k in range(len(low) + 1):
        if k < len(low):
            lower, upper = min(bottom, low[k]), max(top, high[k])
            if upper - lower <= band:
                bottom, top = lower, upper
                continue
        if k - first >= 2:
            segments.append((first, k))
        if k < len(low) and high[k] - low[k] <= band:
            first, bottom, top = k, low[k], high[k]
        else:  # too wide for the band, or NaN
            first, bottom, top = k + 1, np.inf, -np.inf
    return segments
