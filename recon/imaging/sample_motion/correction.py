"""Correction of the beam's positions for the motion of the sample."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from recon.imaging.picture import Grid
from recon.imaging.sample_motion.placed_samples import PlacedSamples
from recon.imaging.sample_motion.rigid_motion import SampleMotion, estimate_sample_motion
from recon.imaging.scan_phase.bidirectional_phase import slow_period
from scanner.angle_tracks import DerivedAngle
from scanner.arrays import Array
from scanner.channel import READ_CHUNK_SAMPLES, Channel
from scanner.device import AXES
from scanner.motion import Motion
from scanner.sample_ranges import SampleRanges

MAX_CELLS_ACROSS = 512
"""Cells across the field at most: pictures and sums of all folds then take 150 MB."""

MIN_SAMPLES_PER_CELL = 0.5
"""Samples per cell below which cells are wider than a pixel: too few samples would fall near others."""

MAX_USEFUL_SD_PX = 3.0
"""Standard deviation of the position of one block from which a message states that motion is hardly detectable [px]."""


@dataclass(frozen=True)
class SampleAngle(DerivedAngle):
    """Position of the beam relative to a sample that moves.

    The track is that of the beam.

    Attributes:
        sample: increasing sample numbers, shape (n,).
        shift: displacement of the sample there, shape (n,) [rad]; linear between them, constant before and after.
    """

    sample: Array
    shift: Array

    def read(self, first: int = 0, stop: int | None = None) -> Array:
        """Return the positions of samples ``first`` up to ``stop`` (as in a Python slice), shape (n,) [rad]."""
        index = np.arange(*slice(first, stop).indices(self.size))
        return self.track.read(first, stop) - np.interp(index, self.sample, self.shift)

    def negated(self) -> SampleAngle:
        """Return the positions for the motion of the mirror and of the sample with the opposite sign."""
        return replace(self, track=self.track.negated(), shift=-self.shift)

    def advanced(self, time: Array, phase: Array, frequency: Array) -> SampleAngle:
        """Return the positions for the motion of the mirror that is ahead (see ``scanner.angle_tracks.AngleTrack``)."""
        return replace(self, track=self.track.advanced(time, phase, frequency))


def measure_sample_motion(beam: Motion, intensity: Channel, grid: Grid, unlocated: SampleRanges) -> SampleMotion | None:
    """Motion of the sample; None where the scan has too few crossings, or the picture too few rows or columns.

    Args:
        beam: motion whose angles are on the intensity's clock.
        intensity: shape (n,) or (n, detectors); detectors are averaged.
        grid: the pixels.
        unlocated: samples that are left out because the beam's place is unknown.
    """
    cell = cell_width(grid, intensity.size, MAX_CELLS_ACROSS)
    samples = read_samples(beam, intensity, grid, cell, unlocated, _chunks(intensity.size))
    found = estimate_sample_motion(samples, slow_period(beam) * intensity.sample_rate, cells(grid, cell))
    if found is None:
        return None
    vibrations = tuple(each._replace(cosine=cell * each.cosine, sine=cell * each.sine) for each in found.vibrations)
    lengths = {name: cell * getattr(found, name) for name in ("shift", "sd", "left")}
    return replace(found, vibrations=vibrations, **lengths)


def cell_width(grid: Grid, samples: int, across: int) -> float:
    """Width of the cells in which a number of samples is compared, at most so many cells across the field [px]."""
    size = min(grid.width * grid.height, samples / MIN_SAMPLES_PER_CELL)
    return max(max(grid.width, grid.height) / across, float(np.sqrt(grid.width * grid.height / size)))


def cells(grid: Grid, cell: float) -> tuple[int, int]:
    """Number of cells of a width [px] down and across the field."""
    return math.ceil(grid.height / cell), math.ceil(grid.width / cell)


def read_samples(
    beam: Motion,
    intensity: Channel,
    grid: Grid,
    cell: float,
    unlocated: SampleRanges,
    parts: Sequence[tuple[int, int]],
) -> PlacedSamples:
    """Samples of parts (first, stop) of a scan, one part after the other, at places in cells of a width [px].

    The other arguments are those of :func:`measure_sample_motion`.
    """
    samples = PlacedSamples.empty(sum(stop - first for first, stop in parts))
    x, y = (beam.axes[axis].angle for axis in AXES)
    offset = 0
    for first, stop in parts:
        across = 0.5 * grid.width / cell * (x.read(first, stop) / grid.half_angle_x + 1.0)
        down = 0.5 * grid.height / cell * (y.read(first, stop) / grid.half_angle_y + 1.0)
        value = intensity.read(first, stop).reshape(stop - first, -1).mean(axis=1)
        for begin, end in unlocated:
            value[max(begin - first, 0) : max(end - first, 0)] = np.nan
        samples.write(offset, across, down, value)
        offset += stop - first
    return samples


def _chunks(size: int) -> list[tuple[int, int]]:
    """All samples of a scan in parts that fit into memory."""
    return [(first, min(first + READ_CHUNK_SAMPLES, size)) for first in range(0, size, READ_CHUNK_SAMPLES)]


def relative_to_sample(beam: Motion, motion: SampleMotion | None, grid: Grid) -> Motion:
    """The motion of the beam over a sample that moves; ``beam`` itself for one at rest."""
    if motion is None or not motion.moving:
        return beam
    axes = dict(beam.axes)
    for name, shift, pixel in zip(AXES, motion.shift.T, grid.pixel_angle, strict=True):
        angle = SampleAngle(axes[name].angle, motion.sample, shift * pixel)
        axes[name] = replace(axes[name], angle=angle)
    return replace(beam, axes=axes)


def describe_sample_motion(motion: SampleMotion | None, sample_rate: float) -> str:
    """What a reader has to know of the motion that was removed, in a line; sample rate of the intensity [Hz]."""
    if motion is None:
        return (
            "sample motion: the scan crosses itself too rarely, or the picture has too few rows or columns, to "
            "determine one; nothing was removed"
        )
    left = ""
    if motion.left.any():
        left = "; a motion of {:.2g} x {:.2g} pixels rms (x, y) beside it could not be followed".format(*motion.left)
    sd = float(np.sqrt(np.mean(motion.sd**2)))
    if not motion.moving:
        text = "sample motion: none was found"
        if sd > MAX_USEFUL_SD_PX:
            return (
                f"{text}, but a period of the slower axis determines the position to {sd:.2g} pixels only: the picture "
                f"has too little structure or too few photons{left}"
            )
        return f"{text}; each period of the slower axis determines the position to {sd:.2g} pixels (1 sd){left}"
    range_x, range_y = np.ptp(motion.shift, axis=0)
    text = (
        f"sample motion: {range_x:.2g} x {range_y:.2g} pixels peak to peak (x, y), known to {sd:.1g} pixels at each "
        "moment, was removed"
    )
    for each in motion.vibrations:
        across, down = 2.0 * each.peak
        text += f"; vibration at {each.frequency * sample_rate:.4g} Hz, {across:.2g} x {down:.2g} pixels peak to peak"
    return text + left
