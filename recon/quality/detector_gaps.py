"""Times in which the detector did not show the scene: it was off, covered or disconnected for a part of the scan."""

from __future__ import annotations

import numpy as np

from recon.imaging.intensity_gridding import grid_intensity
from recon.imaging.picture import Grid, Picture
from recon.imaging.scan_phase.bidirectional_phase import quadrature, slow_period
from recon.imaging.wild_samples import MAX_CHECKED_SAMPLES, WildLimits, usable_samples, wild_limits
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.motion import Motion
from scanner.sample_ranges import SampleRanges, runs_of_true, subtract_ranges

BLOCK_PERIODS = 2.0
"""Periods of the slower axis in a block: it crosses the whole field, so that most blocks scatter alike."""

MAX_BLOCKS = 2048
"""Most blocks that are inspected; those of a longer scan are longer."""

QUIET_SD_SHARE = 0.3
"""Scatter of a block, over the third quartile of all, below which its samples may not show the scene."""

MIN_COMMON_PIXELS = 100
"""Pixels that both parts of the scan visited from which they can be compared."""

MAX_SLOPE = 0.2
"""Slope of the quiet part's means against those of the rest up to which the quiet part does not show the scene.
Parts that are quiet because the scene is dark there have a slope near 1."""

MIN_SIGNIFICANCE = 3.0
"""Lacking structure of the quiet blocks, in its standard deviations, from which it is more than chance: few points of
light are missed by many paths of the beam, and few photons scatter."""

PIECES_PER_PERIOD = 3
"""Pieces of a period of the slower axis, used in turn to choose the quiet blocks and to judge them. It is odd, so that
either purpose has every phase of that axis in two periods."""


def find_detector_gaps(beam: Motion, intensity: Channel, grid: Grid, unlocated: SampleRanges) -> SampleRanges:
    """Return the samples in which no detector shows the scene that it shows in the rest of the scan.

    Blocks of the scan are chosen because they scatter little. Where points of light are smaller than a pixel, or fewer
    than the blocks, a block may do so because the beam passed between them. Therefore half of each block's samples
    choose, and the other half is compared with the rest of the scan. If the longest run of quiet blocks is a gap and
    others are not, it is found by itself.

    A scan that retraces one path in every period of the slower axis, sampled at the same places, shows both halves the
    same: there, quiet blocks that missed points of light may still be returned.

    Args:
        beam, intensity, grid, unlocated: as for :func:`recon.imaging.intensity_gridding.grid_intensity`.
    """
    pieces = round(BLOCK_PERIODS * PIECES_PER_PERIOD)
    length = max(
        round(BLOCK_PERIODS * slow_period(beam) * intensity.sample_rate), -(-intensity.size // MAX_BLOCKS), pieces
    )
    count = intensity.size // length
    if count < 2:
        return []
    edges = [round(length * piece / pieces) for piece in range(pieces + 1)]
    choosing, judging = (list(zip(edges[k:-1:2], edges[k + 1 :: 2], strict=True)) for k in (0, 1))
    quiet = _quiet_blocks(intensity, length, count, choosing)
    if not quiet:
        return []

    def picture(blocks: SampleRanges, parts: SampleRanges) -> Picture:
        starts = (block * length for run in blocks for block in range(*run))
        inside = [(start + first, start + stop) for start in starts for first, stop in parts]
        return _grid(beam, intensity, grid, subtract_ranges(inside, unlocated))

    rest = subtract_ranges([(0, count)], quiet)
    shown, again = picture(rest, judging), picture(rest, choosing)
    longest = [max(quiet, key=lambda run: run[1] - run[0])]
    for blocks in (quiet, longest) if len(quiet) > 1 else (quiet,):
        if lacks_structure(picture(blocks, judging), shown, again):
            return [(first * length, stop * length) for first, stop in blocks]
    return []


def describe_detector_gaps(beam: Motion, intensity: Channel, grid: Grid, unlocated: SampleRanges) -> list[str]:
    """A line if the detector did not show the scene for a part of the scan; arguments as ``find_detector_gaps``."""
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


def _quiet_blocks(intensity: Channel, length: int, count: int, parts: SampleRanges) -> SampleRanges:
    """Runs of blocks that scatter less than others.

    Args:
        intensity: of one or several detectors.
        length: of a block [samples].
        count: of the blocks.
        parts: samples of each block that are used.
    """
    limits = wild_limits(intensity.read(0, MAX_CHECKED_SAMPLES))
    used = np.concatenate([np.arange(*part) for part in parts])
    scatter = np.array([_scatter(intensity.read(k * length, (k + 1) * length)[used], limits) for k in range(count)])
    loud = np.nanpercentile(scatter, 75) if np.isfinite(scatter).any() else 0.0
    return runs_of_true(scatter < QUIET_SD_SHARE * loud)


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


def lacks_structure(quiet: Picture, shown: Picture, again: Picture) -> bool:
    """Whether structure of every detector that two pictures of the scene have in common is missing in a third.

    The slope of the quiet picture against the scene is cov(quiet, again) / cov(shown, again): noise, and points of
    light that a pixel's samples met by chance, are independent in ``shown`` and ``again`` and do not lower it. The
    difference of the covariances is compared with its standard deviation among the pixels.

    Args:
        quiet: of the samples that are judged.
        shown, again: of two separate sets of the other samples.
    """
    common = (quiet.coverage > 0) & (shown.coverage > 0) & (again.coverage > 0)
    count = np.count_nonzero(common)
    if count < MIN_COMMON_PIXELS:
        return False
    means = (picture.image[common].reshape(count, -1).astype(float) for picture in (quiet, shown, again))
    judged, scene, reference = (values - values.mean(axis=0) for values in means)
    missing = (scene - judged) * reference
    significant = missing.sum(axis=0) > MIN_SIGNIFICANCE * np.sqrt((missing**2).sum(axis=0))
    flat = (judged * reference).sum(axis=0) < MAX_SLOPE * (scene * reference).sum(axis=0)
    return bool((significant & flat).all())
