"""Whether the sample moved during a scan whose picture assumes that it was at rest.

Two halves of the scene, compared with the picture at rest, show the same displacement where the sample moves
(``residual``), and independent noise where it does not. Only where they do is the motion estimated, which takes ten
times as long, and has to predict the samples better than rest. Without this check a picture that is smeared over many
pixels would be called sharp, because the phase is right.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from estimation.sensor_hum import find_slow_lines
from recon.imaging.picture import Grid
from recon.imaging.sample_motion.block_equations import PARTS
from recon.imaging.sample_motion.correction import cell_width, cells, read_samples
from recon.imaging.sample_motion.motion_smoother import part_shift
from recon.imaging.sample_motion.placed_samples import PlacedSamples
from recon.imaging.sample_motion.residual import remaining_motion_variance
from recon.imaging.sample_motion.rigid_motion import MIN_BLOCKS, MIN_CELLS_ACROSS, estimate_sample_motion
from recon.imaging.scan_phase.bidirectional_phase import slow_period
from scanner.channel import Channel
from scanner.device import AXES
from scanner.motion import Motion
from scanner.sample_ranges import SampleRanges

MAX_CHECKED_SAMPLES = 1 << 20
"""Samples that are compared, in periods of the slower axis spread over the scan: 0.5 s of computing time."""

CHECKED_CELLS_ACROSS = 200
"""Cells across the field at most: 0.3 s for the pictures of all folds; a motion of half a cell blurs each edge."""

MAX_SIZE_RATIO = 1.5
"""Ratio of a line in a position signal to the motion that the picture shows, either way, up to which they are one:
lines of several frequencies rarely reach their peaks together, and the estimated motion is smooth."""

CHECK_WIDTH = 1.4
"""Standard deviation of the kernel [cells], from the middle of the widths that an estimate of the motion compares."""


def describe_unremoved_motion(
    beam: Motion, intensity: Channel, grid: Grid, unlocated: SampleRanges, tolerance: float
) -> list[str]:
    """A line if the sample moved by more than the tolerance, or the position sensors have hum of this size.

    Where the mirror moves slowly, its sensors show it, and the picture is right. A slow line in a position signal and a
    motion of this size between the signal and the picture are thus one error of the sensor.

    Args:
        beam, intensity, grid, unlocated: as for :func:`recon.imaging.sample_motion.correction.measure_sample_motion`.
        tolerance: displacement of a sample that is accepted [px].
    """
    period = slow_period(beam) * intensity.sample_rate
    if not np.isfinite(period):
        return []
    length = max(round(period / PARTS), 1) * PARTS
    blocks = intensity.size // length
    if blocks < MIN_BLOCKS:
        return []
    step = -(-blocks * length // MAX_CHECKED_SAMPLES)
    parts = [(first * length, (first + 1) * length) for first in range(0, blocks, step)]
    cell = cell_width(grid, len(parts) * length, CHECKED_CELLS_ACROSS)
    samples, shape = read_samples(beam, intensity, grid, cell, unlocated, parts), cells(grid, cell)
    if len(parts) < MIN_BLOCKS or min(shape) < MIN_CELLS_ACROSS:
        return []
    if not _disagrees_with_rest(samples, len(parts), length, shape):
        return []
    motion = estimate_sample_motion(samples, period, shape, widths=(CHECK_WIDTH,))
    if motion is None or not motion.moving:
        return []
    x, y = cell * np.ptp(motion.shift, axis=0)
    if max(x, y) <= tolerance:
        return []
    hum = _describe_hum(beam, grid, {"x": x, "y": y}) if beam.estimator == "sensor" else []
    return hum or [
        f"intensity: the sample moves by {x:.2g} x {y:.2g} pixels peak to peak (x, y) during the scan, over which the "
        "picture is smeared: run again with --sample-motion, which removes it"
    ]


def _describe_hum(beam: Motion, grid: Grid, moved: Mapping[str, float]) -> list[str]:
    """A line for each axis whose position signal has slow lines of the size of the motion that the picture shows.

    Args:
        beam: with measured angles.
        grid: the pixels.
        moved: peak to peak, by axis [px].
    """
    slower, notes = min(float(np.median(axis.frequency)) for axis in beam.axes.values()), []
    for name, pixel in zip(AXES, grid.pixel_angle, strict=True):
        lines = find_slow_lines(beam.axes[name], slower)
        size = sum(line.amplitude for line in lines) / pixel
        if lines and 1.0 / MAX_SIZE_RATIO < 2.0 * size / max(moved[name], 1e-300) < MAX_SIZE_RATIO:
            notes.append(
                f"{name}: the position signal holds a line at {lines[0].frequency:.4g} Hz, ±{size:.2g} pixels, and the "
                "picture shows that the beam does not follow it: hum of the sensor, which the estimator sensor maps "
                f"as motion, so that the picture is distorted; remove the hum, or record drive_{name}, with which it "
                "is subtracted"
            )
    return notes


def _disagrees_with_rest(samples: PlacedSamples, blocks: int, length: int, shape: tuple[int, int]) -> bool:
    """Whether two halves of the scene show a motion; ``length`` of a block in samples, ``shape`` in cells."""
    at_rest = part_shift(np.zeros((blocks, 2)), [])
    return bool(remaining_motion_variance(samples, at_rest, length // PARTS, shape, CHECK_WIDTH).any())
