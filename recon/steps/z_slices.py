"""Slices of a scan by the position z of the objective or the stage."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.steps.z_rests import PositionBlocks, cut_to_intensity, find_z_rests, read_blocks, rest_times
from scanner.arrays import Array
from scanner.channel import READ_CHUNK_SAMPLES, Channel, LazySamples
from scanner.errors import BadInput
from scanner.sample_ranges import SampleRanges
from scanner.wording import counted

MAX_TRAVEL_M = 0.1
"""Travel of z above which a note asks for its unit: stages of microscopes travel some centimetres at most [m]."""

MIN_BLOCKS_OF_SLICE = 16
"""Blocks of z from which a variation within a slice is distinguished from noise, and parts that are compared: for
white noise the variance of their differences is then 2 ± 0.5 times that of their means."""


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
    position = cut_to_intensity(position, intensity)
    blocks = read_blocks(position)
    varying: tuple[str, ...] = ()
    if step is not None or blocks.constant:
        positions, label_times = _bins(position, blocks, step or np.inf, intensity.size)
    else:
        used, rests, band = find_z_rests(blocks)
        positions, number_of_rest, label_times = _levels(position, used, rests, band)
        varying = tuple(_describe_variation(blocks, used.edges[rests], number_of_rest, positions, band))

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
        (*_describe(blocks, kept.size, 1.0 - samples.sum() / intensity.size, step), *varying),
    )


def _describe(blocks: PositionBlocks, slices: int, unassigned: float, step: float | None) -> list[str]:
    """Notes on missing samples, a single slice and the samples of the intensity without a slice."""
    notes = []
    travel = blocks.most - blocks.least
    if blocks.missing:
        missing = counted(blocks.missing, "sample")
        notes.append(f"position_z: {missing} without a finite value; the intensity there belongs to no slice")
    if travel > MAX_TRAVEL_M:
        notes.append(f"position_z: moves by {travel:.4g} m; no objective does: check its unit")
    if slices == 1:
        if blocks.constant:
            why = "does not change beyond its noise"
        elif step is None:
            why = "has one position only"
        else:
            why = f"a step of {step:.3g} m does not divide the travel of {travel:.3g} m"
        notes.append(f"position_z: {why}: the stack has a single slice")
    if unassigned > 0.0:
        notes.append(
            f"position_z: {unassigned:.1%} of the intensity was recorded while z moved or was not known; it belongs to "
            "no slice"
        )
    return notes


def _describe_variation(
    blocks: PositionBlocks, rests: NDArray[np.intp], slice_of_rest: NDArray[np.intp], positions: Array, band: float
) -> Iterator[str]:
    """A note on the slices within which z varies more than its noise, as where two positions are one slice.

    Args:
        blocks: as they were read.
        rests: first sample and end of each rest, shape (rests, 2).
        slice_of_rest: shape (rests,).
        positions: of the slices [m].
        band: width within which positions are one [m].
    """
    middle = 0.5 * (blocks.edges[1:] + blocks.edges[:-1])
    rest = np.searchsorted(rests[:, 0], middle, side="right") - 1
    inside = (rest >= 0) & (middle < rests[rest, 1])
    varied: dict[int, float] = {}
    for number in range(positions.size):
        own = inside & (slice_of_rest[rest] == number)
        means, scatter = blocks.mean[own], 0.5 * (blocks.high - blocks.low)[own]
        if means.size < MIN_BLOCKS_OF_SLICE:
            continue
        noise = _white_variance(means) + float(np.mean(scatter**2))
        parts = np.array([part.mean() for part in np.array_split(means, MIN_BLOCKS_OF_SLICE)])
        slow = float(np.var(parts)) - _white_variance(parts)
        if slow > max(_white_variance(parts), 0.25 * noise):
            varied[number] = 2.0 * slow**0.5  # the distance of two positions
    if varied:
        worst = max(varied, key=lambda number: varied[number])
        yield (
            f"position_z: z varies within {len(varied)} of {positions.size} slices, most in that at "
            f"{1e6 * positions[worst]:.6g} µm, by about {1e6 * varied[worst]:.3g} µm: positions closer than "
            f"{1e6 * band:.3g} µm are one slice; if they are several, give --z-step, their spacing in metres"
        )


def _white_variance(values: Array) -> float:
    """Variance of the white noise of values, by their differences (von Neumann 1941)."""
    return 0.5 * float(np.mean(np.diff(values) ** 2))


def _bins(
    position: Channel, blocks: PositionBlocks, step: float, size: int
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
    positions = np.full(count, float(np.nanmean(blocks.mean)))
    if count > 1:
        positions = 0.5 * (blocks.least + blocks.most) + step * (np.arange(count) - 0.5 * (count - 1))

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


def _levels(
    position: Channel, blocks: PositionBlocks, rests: NDArray[np.intp], band: float
) -> tuple[Array, NDArray[np.intp], Callable[[Array], NDArray[np.intp]]]:
    """Positions at which z rests, the number of each rest's position, and that at any times; -1 while z moves.

    Rests whose positions differ by less than the band are one position.
    """
    if not rests.size:
        what = f"does not rest: it moves between {blocks.least:.6g} m and {blocks.most:.6g} m for most of the time"
        hint = "give --z-step M, the thickness of a slice in metres, to sort the samples by z"
        raise BadInput(what, file=position.file, channel=position.name, hint=hint)
    levels = np.array([blocks.mean[first:stop].mean() for first, stop in rests])
    order = np.argsort(levels)
    number = np.empty(levels.size, np.intp)
    number[order] = np.concatenate([[0], np.cumsum(np.diff(levels[order]) > band)])
    lengths = rests[:, 1] - rests[:, 0]
    positions = np.bincount(number, levels * lengths) / np.bincount(number, lengths)
    starts, stops = rest_times(position, blocks, rests)

    def label(times: Array) -> NDArray[np.intp]:
        inside = np.searchsorted(starts, times, side="right") - 1
        return np.where((inside >= 0) & (times < stops[inside]), number[inside], -1)

    return positions, number, label


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
