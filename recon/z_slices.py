"""Slices of a scan by the position z of the objective or the stage.

Where z rests is decided by one rule: z rests in an interval in which it moves at less than ``REST_SPEED`` of its mean
speed. The mean speed is the length of its path over the duration. Both are measured with a band of one width: a part of
the recording in which z stays within a band of width w moves at the speed w over its duration. Narrow bands break at
the noise of z, wide ones contain movement. The width is chosen such that the rests last longest beyond the time in
which a steady movement crosses their bands. A ramp moves at its mean speed throughout and has no rests; a sinusoid is
slower than a quarter of its mean speed for 41 % of the time at most, so that rests are accepted from
``MIN_REST_SHARE`` of the time on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.sample_ranges import SampleRanges
from scanner.arrays import Array
from scanner.channel import READ_CHUNK_SAMPLES, Channel, LazySamples
from scanner.errors import BadInput

MAX_BLOCKS = 4096
"""Blocks into which z is divided to find its rests. A block of a stack of 100 slices is a fortieth of a slice."""

REST_SPEED = 0.25
"""Speed of a resting z, relative to its mean speed: the steps of a stack have to exceed the noise within a rest about
fourfold, and the slow parts of a sinusoid around its turning points are a minority."""

MIN_REST_SHARE = 0.5
"""Part of the time that z has to rest: a sinusoid reaches 0.41, a stack of a microscope nearly 1."""

SINE_SWING = 2.0**0.5
"""Amplitude of a sinusoid in its standard deviations: by it the extremes of a z that oscillates within a block follow
from the block, and those of the noise do not count."""

MIN_NOISE_SAMPLES = 32
"""Samples of z from which noise is told from movement by successive differences: their ratio is then 2 ± 0.35."""

BAND_WIDTHS = 2.0 ** -np.arange(24.0, 0.5, -0.5)
"""Widths of the band that are tried, in travels of z: from a step of a converter of 24 bits to half the travel."""


@dataclass(frozen=True)
class ZSlices:
    """Slices of a scan, in the order of their positions.

    Attributes:
        positions: of the slices, increasing [m].
        spans: first sample of the intensity that belongs to a slice, and end of the last one.
        samples: number of samples of the intensity in each slice.
        labels: (first, stop) -> slice of each sample of the intensity, -1 for none.
        notes: what a reader has to know of z, a line each.
    """

    positions: tuple[float, ...]
    spans: SampleRanges
    samples: tuple[int, ...]
    labels: Callable[[int, int], NDArray[np.intp]]
    notes: tuple[str, ...] = ()

    def intensity_of(self, number: int, intensity: Channel) -> Channel:
        """Return the intensity on the same clock with NaN for the samples of other slices."""

        def fetch(first: int, stop: int) -> NDArray[Any]:
            values = np.array(intensity.stored(first, stop), np.float64)
            values[self.labels(first, first + len(values)) != number] = np.nan
            return values

        masked = LazySamples(intensity.shape, np.dtype(np.float64), fetch)
        return replace(intensity, raw=masked, first=0, stop=intensity.size)


class _Blocks(NamedTuple):
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


def find_z_slices(position: Channel, intensity: Channel, step: float | None = None) -> ZSlices:
    """Return the slices of a scan: where z rests, or parts of its travel.

    Args:
        position: z of the objective or the stage [m], on its own clock.
        intensity: whose samples are assigned.
        step: thickness of a slice, by which samples are assigned whether z rests or not [m]; None for a slice at each
            position at which z rests. Rests at one position are one slice.

    Raises:
        BadInput: the step is not positive, z is not known at any sample of the intensity, does not rest, or a slice
            would hold less than a sample.
    """
    if step is not None and not 0.0 < step < np.inf:
        raise BadInput(f"a step of {step} m", channel="z_step", hint="give a positive thickness in metres")
    position = _during(position, intensity)
    blocks = _read_blocks(position)
    if step is not None:
        positions, label_times = _bins(position, blocks, step, intensity.size)
    elif blocks.constant:
        positions, label_times = _bins(position, blocks, np.inf, 1)
    else:
        positions, label_times = _rests(position, blocks)

    def labels(first: int, stop: int) -> NDArray[np.intp]:
        return label_times(intensity.start + np.arange(first, stop) / intensity.sample_rate)

    first, end, samples = _count(labels, intensity.size, positions.size)
    kept = np.flatnonzero(samples)
    if not kept.size:
        hint = "check the clocks of both channels"
        raise BadInput(
            "no sample of the intensity lies in a slice", file=position.file, channel=position.name, hint=hint
        )
    number = np.full(positions.size + 1, -1)
    number[kept] = np.arange(kept.size)
    return ZSlices(
        tuple(positions[kept].tolist()),
        list(zip(first[kept].tolist(), end[kept].tolist(), strict=True)),
        tuple(samples[kept].tolist()),
        lambda begin, stop: number[labels(begin, stop)],
        tuple(_describe(blocks, kept.size, 1.0 - samples.sum() / intensity.size)),
    )


def _describe(blocks: _Blocks, slices: int, unassigned: float) -> list[str]:
    """Notes on missing samples, a single slice and the samples of the intensity without a slice."""
    notes = []
    if blocks.missing:
        notes.append(f"position_z: {blocks.missing} samples are not finite; the intensity there belongs to no slice")
    if slices == 1:
        why = "does not change beyond its noise" if blocks.constant else "has one position only"
        notes.append(f"position_z: {why}: the stack has a single slice")
    if unassigned > 0.0:
        notes.append(
            f"position_z: {unassigned:.1%} of the intensity was recorded while z moved or was not known; it belongs to "
            "no slice"
        )
    return notes


def _during(position: Channel, intensity: Channel) -> Channel:
    """The part of z during the intensity, and one sample beyond it at both ends."""
    begin = int(np.clip(np.floor((intensity.start - position.start) * position.sample_rate), 0, position.size))
    end = int(np.clip(np.ceil((intensity.end - position.start) * position.sample_rate) + 1, 0, position.size))
    if begin >= end:
        hint = "check the start of both channels"
        raise BadInput("has no sample during the intensity", file=position.file, channel=position.name, hint=hint)
    start = position.start + begin / position.sample_rate
    return replace(position, start=start, first=position.first + begin, stop=position.first + end)


def _read_blocks(position: Channel) -> _Blocks:
    """Mean and scatter of z in each block, read block by block."""
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
    if not finite:
        hint = "check that it was recorded"
        raise BadInput("holds no sample that can be used", file=position.file, channel=position.name, hint=hint)
    # Successive differences of white noise have twice its variance (von Neumann 1941); those of a movement far less.
    least, most = np.nanmin(mean - SINE_SWING * sd), np.nanmax(mean + SINE_SWING * sd)
    scatter = squares - total**2 / finite
    constant = differences >= scatter and (scatter == 0.0 or finite >= MIN_NOISE_SAMPLES)
    # A converter's step limits what can be known of z: it belongs to the band.
    sd += 0.5 * abs(position.gain) if position.raw.dtype.kind in "iu" and not constant else 0.0
    low, high = np.nan_to_num(mean - sd, nan=-np.inf), np.nan_to_num(mean + sd, nan=np.inf)
    return _Blocks(edges, mean, low, high, least, most, position.size - finite, constant)


def _bins(
    position: Channel, blocks: _Blocks, step: float, size: int
) -> tuple[Array, Callable[[Array], NDArray[np.intp]]]:
    """Positions spaced by ``step`` over the travel, and the number of the nearest at any times; -1 for an unknown z."""
    intervals = (blocks.most - blocks.least) / step
    if intervals + 1.0 > size:
        what = (
            f"--z-step of {step:.3g} m makes {intervals:.3g} slices of a travel of {blocks.most - blocks.least:.3g} m"
        )
        hint = "give a larger step in metres, as 1e-6"
        raise BadInput(f"{what}, more than there are samples", file=position.file, channel=position.name, hint=hint)
    count = round(intervals) + 1
    middle = 0.5 * (blocks.least + blocks.most)
    positions = np.full(count, middle)
    if count > 1:  # the step may be infinite
        positions += step * (np.arange(count) - 0.5 * (count - 1))

    def label(times: Array) -> NDArray[np.intp]:
        z = _interpolate(position, times)
        nearest = np.zeros(z.shape) if count == 1 else np.clip(np.rint((z - positions[0]) / step), 0, count - 1)
        return np.where(np.isfinite(z), nearest, -1).astype(np.intp)

    return positions, label


def _interpolate(position: Channel, times: Array) -> Array:
    """z at times by linear interpolation [m]; NaN beyond its ends and next to a missing sample."""
    at = (times - position.start) * position.sample_rate
    first = int(np.clip(np.floor(at[0]), 0, position.size - 1))
    stop = int(np.clip(np.ceil(at[-1]) + 1, first + 1, position.size))
    z = np.interp(at, np.arange(first, stop), position.read(first, stop))
    return np.where((at > -1.0) & (at < position.size), z, np.nan)


def _rests(position: Channel, blocks: _Blocks) -> tuple[Array, Callable[[Array], NDArray[np.intp]]]:
    """Positions at which z rests, and the number of the position at any times; -1 while it moves."""
    travel = blocks.most - blocks.least
    best, rests, width = 0.0, np.empty((0, 2), np.intp), 0.0
    for band in travel * BAND_WIDTHS:
        found, excess = _slow_segments(blocks, band)
        if excess > best:
            best, rests, width = excess, found, band
    covered = np.sum(rests[:, 1] - rests[:, 0]) / blocks.mean.size
    if covered <= MIN_REST_SHARE:
        what = f"does not rest: it moves between {blocks.least:.6g} m and {blocks.most:.6g} m for most of the time"
        hint = "give --z-step M, the thickness of a slice in metres, to sort the samples by z"
        raise BadInput(what, file=position.file, channel=position.name, hint=hint)
    levels = np.array([blocks.mean[first:stop].mean() for first, stop in rests])
    order = np.argsort(levels)
    number = np.empty(levels.size, np.intp)
    number[order] = np.concatenate([[0], np.cumsum(np.diff(levels[order]) > width)])
    lengths = rests[:, 1] - rests[:, 0]
    positions = np.bincount(number, levels * lengths) / np.bincount(number, lengths)
    starts, stops = (position.start + edge / position.sample_rate for edge in blocks.edges[rests].T - [[0], [1]])
    if rests[0, 0] == 0:
        starts[0] = position.start - 1.0 / position.sample_rate
    if rests[-1, 1] == blocks.mean.size:
        stops[-1] = position.end

    def label(times: Array) -> NDArray[np.intp]:
        inside = np.searchsorted(starts, times, side="right") - 1
        return np.where((inside >= 0) & (times <= stops[inside]), number[inside], -1)

    return positions, label


def _slow_segments(blocks: _Blocks, band: float) -> tuple[NDArray[np.intp], float]:
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


def _count(
    labels: Callable[[int, int], NDArray[np.intp]], size: int, slices: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """First sample, end and number of the samples of each slice."""
    first, end, samples = np.full(slices, size), np.zeros(slices, np.intp), np.zeros(slices, np.intp)
    for begin in range(0, size, READ_CHUNK_SAMPLES):
        chunk = labels(begin, min(begin + READ_CHUNK_SAMPLES, size))
        present, at, count = np.unique(chunk, return_index=True, return_counts=True)
        _, from_end = np.unique(chunk[::-1], return_index=True)
        known = present >= 0
        present = present[known]
        first[present] = np.minimum(first[present], begin + at[known])
        end[present] = begin + chunk.size - from_end[known]
        samples[present] += count[known]
    return first, end, samples
