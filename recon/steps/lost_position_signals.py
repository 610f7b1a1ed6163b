"""Times at which a position signal shows a mirror at rest while the light shows that the beam moves.

A mirror that rests, as before its start, and a sensor whose cable came off give the same signal: noise around one
value. The intensity tells them apart. Under a beam at rest the samples of a pixel differ by their noise; under one that
moves they differ as much as those of the whole scan.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recon.imaging.gridding import find_sample_pixels
from recon.imaging.picture import Grid
from recon.imaging.pixel_noise import MAX_NOISE_SAMPLES, measure_sample_noise
from recon.quality.defects import LOST, Defect
from recon.steps.sign_after_rest import REST_AMPLITUDE
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import AXES
from scanner.motion import UNKNOWN_PHASE_SD_RAD, AxisMotion, Motion, typical_amplitude
from scanner.recording import Recording
from scanner.sample_ranges import runs_of_true, subtract_ranges, to_sample_ranges

MIN_EXCESS_SDS = 4.0
"""Excess of the scatter in its standard deviations from which it is none by chance: probability 3e-5."""


def find_lost_position_signals(beam: Motion, intensity: Channel, grid: Grid) -> dict[str, list[tuple[float, float]]]:
    """Return the intervals [s] in which an axis seems to rest and does not, by axis.

    Args:
        beam: motion whose angles are those of position signals, on the intensity's clock.
        intensity: shape (n,) or (n, detectors); detectors are averaged.
        grid: the pixels.
    """
    rests = {name: _rests(axis) for name, axis in beam.axes.items()}
    resting = to_sample_ranges((each for intervals in rests.values() for each in intervals), intensity)
    moving = subtract_ranges([(0, intensity.size)], resting)
    if not (resting and moving):
        return {}
    pixel, values = _read(beam, intensity, grid, max(moving, key=lambda part: part[1] - part[0]))
    noise = measure_sample_noise(pixel, values)
    if noise is None:
        return {}
    of_scan = float(values[np.isfinite(values)].var())

    def is_lost(interval: tuple[float, float]) -> bool:
        parts = to_sample_ranges([interval], intensity)
        if not parts:  # the sensor was recorded longer than the intensity
            return False
        scatter, level, freedom = _scatter_in_pixels(*_read(beam, intensity, grid, parts[0]))
        if not freedom:
            return False
        between = np.sqrt(float(noise.variance(np.array(level))) * of_scan)
        return scatter > between * (1.0 + MIN_EXCESS_SDS * np.sqrt(2.0 / freedom))

    lost = {name: [each for each in intervals if is_lost(each)] for name, intervals in rests.items()}
    return {name: intervals for name, intervals in lost.items() if intervals}


def leave_out_lost(
    motion: Motion, lost: Mapping[str, Sequence[tuple[float, float]]], recording: Recording
) -> tuple[Motion, list[Defect]]:
    """The motion without a known phase in some intervals, and these as defects.

    Args:
        motion: of the mirror.
        lost: intervals [s] by axis.
        recording: with the position signals.
    """
    axes, defects = dict(motion.axes), list[Defect]()
    for name, intervals in lost.items():
        channel = f"angle_{name}" if f"angle_{name}" in recording else f"sense_{name}"
        defects += [Defect(channel, LOST, *each) for each in intervals]
        time = axes[name].time
        unknown = np.any([(low <= time) & (time <= high) for low, high in intervals], axis=0)
        axes[name] = replace(axes[name], phase_sd=np.where(unknown, UNKNOWN_PHASE_SD_RAD, axes[name].phase_sd))
    return replace(motion, axes=axes), defects


def _rests(axis: AxisMotion) -> list[tuple[float, float]]:
    """Intervals [s] in which an axis nearly rests."""
    half_block = 0.5 * float(axis.time[1] - axis.time[0])
    small = axis.amplitude < REST_AMPLITUDE * typical_amplitude(axis.amplitude[axis.known])
    return [(float(axis.time[a]) - half_block, float(axis.time[b - 1]) + half_block) for a, b in runs_of_true(small)]


def _read(beam: Motion, intensity: Channel, grid: Grid, part: Sequence[int]) -> tuple[NDArray[np.int32], Array]:
    """Pixel and mean over the detectors of the first samples of a part."""
    first, stop = part[0], min(part[1], part[0] + MAX_NOISE_SAMPLES)
    x, y = (beam.axes[axis].angle.read(first, stop) for axis in AXES)
    values = intensity.read(first, stop).reshape(stop - first, -1).mean(axis=1)
    return find_sample_pixels(x, y, grid), values


def _scatter_in_pixels(pixel: NDArray[np.int32], values: Array) -> tuple[float, float, int]:
    """Variance of the samples around the means of their pixels, their mean, and the degrees of freedom."""
    used = (pixel >= 0) & np.isfinite(values)
    number, values = np.unique(pixel[used], return_inverse=True)[1], values[used]
    if not values.size:
        return 0.0, 0.0, 0
    counts = np.bincount(number)
    means = np.bincount(number, values) / counts
    freedom = int(values.size - counts.size)
    scatter = float(np.sum((values - means[number]) ** 2)) / max(freedom, 1)
    return scatter, float(values.mean()), freedom
