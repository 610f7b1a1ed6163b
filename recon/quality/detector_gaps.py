"""Times in which the detector did not see the scene: it was off, covered or disconnected for a part of the scan."""

from __future__ import annotations

import numpy as np

from recon.imaging.intensity_gridding import grid_intensity
from recon.imaging.picture import Grid, Picture
from recon.imaging.scan_phase.bidirectional_phase import quadrature, slow_period
from recon.imaging.wild_samples import MAX_CHECKED_SAMPLES, WildLimits, usable_samples, wild_limits
from recon.sample_ranges import SampleRanges, runs_of_true, subtract_ranges
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.motion import Motion

BLOCK_PERIODS = 2.0
"""Periods of the slower axis in a block: it crosses the whole field, so that most blocks scatter alike."""

MAX_BLOCKS = 2048
"""Most blocks that are inspected; those of a longer scan are longer."""

QUIET_SD_SHARE = 0.3
"""Scatter of a block, over the third quartile of all, below which its samples may not show the scene."""

MIN_COMMON_PIXELS = 100
"""Pixels that both parts of the scan visited from which they can be compared."""

MAX_SLOPE = 0.2
"""Slope of the means of the quiet blocks against those of the others up to which the quiet ones do not show the scene.
Blocks that are quiet because the scene is dark there have a slope near 1."""

MIN_CONTRAST = 4.0
"""Variance of the means of the other blocks in the common pixels, over that of their noise, from which the scene has
structure there that the quiet blocks would show."""


def find_detector_gaps(beam: Motion, intensity: Channel, grid: Grid, unlocated: SampleRanges) -> SampleRanges:
    """Return the samples in which no detector shows the scene that it shows in the rest of the scan.

    Args:
        beam, intensity, grid, unlocated: as for :func:`recon.imaging.intensity_gridding.grid_intensity`.
    """
    length = max(round(BLOCK_PERIODS * slow_period(beam) * intensity.sample_rate), -(-intensity.size // MAX_BLOCKS), 2)
    count = intensity.size // length
    if count < 2:
        return []
    limits = wild_limits(intensity.read(0, min(intensity.size, MAX_CHECKED_SAMPLES)))
    scatter = np.array([_scatter(intensity.read(k * length, (k + 1) * length), limits) for k in range(count)])
    loud = np.nanpercentile(scatter, 75) if np.isfinite(scatter).any() else 0.0
    quiet = [(a * length, b * length) for a, b in runs_of_true(scatter < QUIET_SD_SHARE * loud)]
    if not quiet:
        return []
    inside = subtract_ranges(quiet, unlocated)
    others = subtract_ranges(subtract_ranges([(0, count * length)], quiet), unlocated)
    off, on = (_grid(beam, intensity, grid, ranges) for ranges in (inside, others))
    return quiet if misses_scene(off, on) else []


def describe_detector_gaps(beam: Motion, intensity: Channel, grid: Grid, unlocated: SampleRanges) -> list[str]:
    """A line if the detector did not see the scene for a part of the scan; arguments as ``find_detector_gaps``."""
    gaps = find_detector_gaps(beam, intensity, grid, unlocated)
    if not gaps:
        return []
    first = intensity.start + gaps[0][0] / intensity.sample_rate
    share = sum(stop - begin for begin, stop in gaps) / intensity.size
    return [
        f"intensity: in at least {share:.0%} of the scan, from {first:.4g} s on, the samples do not show the scene "
        "that the rest shows: the detector was off or covered there, and pixels visited then are wrong; "
        "cut the recording"
    ]


def describe_blanked_directions(beam: Motion, intensity: Channel) -> list[str]:
    """A line for each axis in one of whose directions the light or the detector was off, as in a scan of one direction.

    Args:
        beam, intensity: as for :func:`recon.imaging.intensity_gridding.grid_intensity`.
    """
    count = min(intensity.size, MAX_CHECKED_SAMPLES)
    values, lines = intensity.read(0, count), []
    limits = wild_limits(values)
    for name, axis in beam.axes.items():
        angle, periods = axis.angle.read(0, count), count / intensity.sample_rate * float(np.median(axis.frequency))
        if not (periods >= BLOCK_PERIODS and np.isfinite(angle).any()):
            continue
        rate = quadrature(angle, float(np.nanmax(np.abs(angle))))
        rising, falling = (_scatter(values[part], limits) for part in (rate > 0.0, rate < 0.0))
        if min(rising, falling) < QUIET_SD_SHARE * max(rising, falling):
            direction = "rises" if rising < falling else "falls"
            lines.append(
                f"intensity: the samples taken while {name} {direction} do not show the scene that the others show, so "
                "that the picture is wrong: the light or the detector was off in this direction; set these samples to "
                "NaN, which leaves them out"
            )
    return lines


def _scatter(values: Array, limits: WildLimits) -> float:
    """Largest standard deviation of a detector in a block without its wild samples; NaN without samples."""
    if not len(values):
        return np.nan
    usable = usable_samples(values, limits)
    known = values[usable.all(axis=1)]
    return float(known.reshape(len(known), -1).std(axis=0).max()) if len(known) else np.nan


def _grid(beam: Motion, intensity: Channel, grid: Grid, ranges: SampleRanges) -> Picture:
    """Picture of ranges of samples."""
    return grid_intensity(beam, intensity, grid, subtract_ranges([(0, intensity.size)], ranges))


def misses_scene(off: Picture, on: Picture) -> bool:
    """Whether every detector's structure in ``on`` is missing in ``off``, in the pixels that both visited."""
    both = (off.coverage > 0) & (on.coverage > 1)
    if np.count_nonzero(both) < MIN_COMMON_PIXELS:
        return False
    dark, bright = (picture.image[both].reshape(np.count_nonzero(both), -1).astype(float) for picture in (off, on))
    dark, bright = dark - dark.mean(axis=0), bright - bright.mean(axis=0)
    slope = (dark * bright).sum(axis=0) / np.maximum((bright**2).sum(axis=0), 1e-300)
    neighbours = np.diff(on.image, axis=1).reshape(on.image.shape[0], on.image.shape[1] - 1, -1)
    noise = np.nanmedian(np.abs(neighbours), axis=(0, 1)) ** 2
    return bool((slope < MAX_SLOPE).all() and ((bright**2).mean(axis=0) > MIN_CONTRAST * noise).all())
