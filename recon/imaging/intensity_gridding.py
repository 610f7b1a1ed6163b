"""From a motion and an intensity channel to a picture, a chunk at a time."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon.imaging.gridding import accumulate_samples, mean_picture
from recon.imaging.phasor_gridding import accumulate_phasors
from recon.imaging.picture import Grid, Picture
from scanner.channel import Channel
from scanner.device import AXES
from scanner.lock_in import contiguous_samples
from scanner.motion import Motion
from scanner.sample_ranges import SampleRanges, merge_ranges, subtract_ranges

CHUNK_SAMPLES = 1 << 22
"""Samples gridded at a time. It bounds the memory (some 100 MB) for recordings of any length."""

MAX_GAP_SAMPLES = 1 << 12
"""Samples between two ranges up to which they are read together."""


@dataclass(frozen=True, eq=False)
class PixelSums:
    """Sums of the samples of each pixel, to which further samples of the same channel can be added.

    Attributes:
        sums: of the stored values, shape (height, width) or (height, width, detectors). counts: of the samples, shape
            (height, width). Both are changed in place.
        samples: number of samples that have a value, inside the field and outside.
    """

    sums: NDArray[np.float64]
    counts: NDArray[np.uint32]
    samples: int = 0

    def picture(self, intensity: Channel, grid: Grid) -> Picture:
        """Return the picture of the means; intensity: the channel. grid: the pixels."""
        counts = self.counts if self.sums.ndim == 2 else self.counts[..., None]
        means = mean_picture(intensity.gain * self.sums + intensity.offset * counts, self.counts, grid)
        return replace(means, outside=self.samples - int(self.counts.sum()), detectors=intensity.detectors)


def empty_sums(intensity: Channel, grid: Grid) -> PixelSums:
    """Return the sums of no sample of a channel."""
    shape = grid.height, grid.width
    return PixelSums(np.zeros((*shape, *intensity.shape[1:])), np.zeros(shape, np.uint32))


def grid_intensity(
    beam: Motion,
    intensity: Channel,
    grid: Grid,
    unlocated: SampleRanges,
    first: int = 0,
    stop: int | None = None,
) -> Picture:
    """Return the picture of the samples ``first`` up to ``stop``.

    Args:
        beam, intensity, grid: as for :func:`add_samples`.
        unlocated: samples that belong to no pixel because the beam's place is unknown.
        first, stop: samples to grid; all where ``stop`` is None.
    """
    located = subtract_ranges([(first, intensity.size if stop is None else stop)], unlocated)
    return add_samples(empty_sums(intensity, grid), beam, intensity, grid, located).picture(intensity, grid)


def add_samples(to: PixelSums, beam: Motion, intensity: Channel, grid: Grid, ranges: SampleRanges) -> PixelSums:
    """Add ranges of samples to their pixels and return the sums.

    Args:
        to: sums so far; its arrays are changed in place.
        beam: motion whose angles are on the intensity's clock.
        intensity: shape (n,) or (n, detectors). Samples that are not finite are left out.
        grid: the pixels.
        ranges: of samples whose place is known.
    """
    x, y = (beam.axes[axis].angle for axis in AXES)
    phasors_x, phasors_y = x.phasors(), y.phasors()
    samples = to.samples
    for begin, end in _chunks(ranges):
        values = contiguous_samples(intensity.stored(begin, end))
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            values = np.where(np.isinf(values), np.nan, values)  # accumulation leaves NaN out
            samples += int(np.isfinite(values).reshape(len(values), -1).all(axis=1).sum())
        else:
            samples += len(values)
        if (
            phasors_x is not None
            and phasors_y is not None
            and values.ndim == 1
            and phasors_x.is_in_segments(begin, end)
            and phasors_y.is_in_segments(begin, end)
        ):
            accumulate_phasors(phasors_x, phasors_y, begin, values, grid, to.sums, to.counts)
        else:
            accumulate_samples(x.read(begin, end), y.read(begin, end), values, grid, to.sums, to.counts)
    return replace(to, samples=samples)


def add_scattered(to: PixelSums, beam: Motion, intensity: Channel, grid: Grid, ranges: SampleRanges) -> PixelSums:
    """Add many short ranges of samples to their pixels; arguments as for :func:`add_samples`.

    Neighbouring ranges are read together, because a call costs as much as thousands of samples.
    """
    x, y = (beam.axes[axis].angle for axis in AXES)
    samples = to.samples
    for first, stop in merge_ranges(ranges, MAX_GAP_SAMPLES):
        chosen = np.zeros(stop - first, np.bool_)
        for begin, end in ranges[bisect_left(ranges, (first, first)) : bisect_left(ranges, (stop, stop))]:
            chosen[begin - first : end - first] = True
        values = contiguous_samples(intensity.stored(first, stop)[chosen])
        if values.dtype.kind == "f":
            values = np.where(np.isfinite(values), values, np.nan)
            samples += int(np.isfinite(values).reshape(len(values), -1).all(axis=1).sum())
        else:
            samples += len(values)
        accumulate_samples(x.read(first, stop)[chosen], y.read(first, stop)[chosen], values, grid, to.sums, to.counts)
    return replace(to, samples=samples)


def find_visited_pixels(beam: Motion, ranges: SampleRanges, grid: Grid) -> NDArray[np.bool_]:
    """Return the pixels that the beam passed during ranges of samples, shape (height, width)."""
    x, y = (beam.axes[axis].angle for axis in AXES)
    counts = np.zeros((grid.height, grid.width), np.uint32)
    for begin, end in _chunks(ranges):
        accumulate_samples(x.read(begin, end), y.read(begin, end), np.zeros(end - begin), grid, counts=counts)
    return counts > 0


def _chunks(ranges: SampleRanges) -> SampleRanges:
    """The ranges cut into parts of ``CHUNK_SAMPLES`` at most."""
    return [
        (begin, min(begin + CHUNK_SAMPLES, stop))
        for first, stop in ranges
        for begin in range(first, stop, CHUNK_SAMPLES)
    ]
