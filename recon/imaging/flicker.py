"""Light that flickers: lines in the brightness of all places together, such as those of a lamp at the mains.

The model of sample i in cell p and block b of time is I_i = g_b s_p + noise. Least squares for the gains of the blocks
and for the scene in turn give g_b, which is searched for lines. A place that is visited once shows no gain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation.isolated_spikes import MAX_VALUE
from estimation.sensor_hum import Line, LineBlock, find_lines, part_edges, sum_of_lines
from recon.imaging.gridding import find_sample_pixels
from recon.imaging.picture import Grid
from scanner.arrays import Array
from scanner.channel import Channel, LazySamples
from scanner.device import AXES
from scanner.motion import Motion
from scanner.wording import counted

BLOCKS_PER_PERIOD = 2
"""Blocks in a period of the slower axis: each crosses the whole field."""

MAX_FLICKER_FREQUENCY = 0.25
"""Frequency of flicker over that of the slower axis at most: eight blocks in a cycle, over which the scene averages."""

SAMPLES_PER_CELL = 16
"""Samples in a cell, in the mean: the scene then takes a sixteenth of a change of the gain at first."""

ROUNDS = 3
"""Times that gains and scene are fitted in turn; each leaves a tenth of what the scene took, at this many samples."""

MIN_GAIN = 0.2
"""Least gain by which samples are divided: below, their noise would be multiplied by more than 5."""

MIN_AMPLITUDE = 0.01
"""Relative amplitude from which flicker counts: a third of the noise of a pixel of 1000 photons."""


def find_flicker(beam: Motion, intensity: Channel, grid: Grid) -> list[LineBlock]:
    """Lines in the relative gain of an intensity, in consecutive parts of the scan; empty if the first one has none.

    Args:
        beam: motion whose angles are on the intensity's clock.
        intensity: shape (n,) or (n, detectors); detectors are averaged.
        grid: whose field is used.
    """
    slower = min(float(np.median(axis.frequency)) for axis in beam.axes.values())
    if not slower > 0.0:
        return []
    length = max(round(intensity.sample_rate / (BLOCKS_PER_PERIOD * slower)), 1)
    edges = part_edges(intensity, length / intensity.sample_rate)
    found = list[LineBlock]()
    for first, stop in pairwise(edges):
        lines = _lines_of_part(beam, intensity, grid, (first, stop), length, MAX_FLICKER_FREQUENCY * slower)
        if not found and not lines:
            return []
        begin, end = (intensity.start + at / intensity.sample_rate for at in (first, stop))
        found.append(LineBlock(begin, end, tuple(lines)))
    return found


def _lines_of_part(
    beam: Motion, intensity: Channel, grid: Grid, part: tuple[int, int], length: int, highest: float
) -> list[Line]:
    """Lines in the gain of a part of the samples, the largest first.

    Args:
        beam, intensity, grid: as for :func:`find_flicker`.
        part: range of the samples (first, stop).
        length: samples of a block.
        highest: frequency of a line at most [Hz].
    """
    first, stop = part
    across = max(int(sqrt((stop - first) / SAMPLES_PER_CELL)), 1)
    cells = replace(grid, width=min(across, grid.width), height=min(across, grid.height))
    x, y = (beam.axes[axis].angle.read(first, stop) for axis in AXES)
    cell = find_sample_pixels(x, y, cells)
    values = intensity.read(first, stop).reshape(stop - first, -1).mean(axis=1)
    used = (cell >= 0) & (np.abs(values) < MAX_VALUE)
    block = np.arange(stop - first) // length
    gain = _block_gains(cell[used], block[used], values[used], cells.width * cells.height, int(block[-1]) + 1)
    middle = first + (np.arange(gain.size) + 0.5) * length
    time = np.asarray(intensity.start + middle / intensity.sample_rate, np.float64)
    time, gain = time[np.isfinite(gain)], gain[np.isfinite(gain)]
    lines = find_lines(time, gain, highest, MIN_AMPLITUDE)
    steady = float(np.mean(gain - sum(line.at(time) for line in lines))) if lines else 1.0  # of cycles that are cut
    return [Line(line.frequency, line.cosine / steady, line.sine / steady) for line in lines]


def _block_gains(cell: NDArray[np.int32], block: NDArray[np.int64], values: Array, cells: int, blocks: int) -> Array:
    """The gain of each block relative to the mean one, shape (blocks,); NaN where nothing shows it."""
    gain = np.ones(blocks)
    for _ in range(ROUNDS):
        own = gain[block]
        scene = _ratio(np.bincount(cell, own * values, cells), np.bincount(cell, own**2, cells))[cell]
        gain = _ratio(np.bincount(block, scene * values, blocks), np.bincount(block, scene**2, blocks))
        known = np.isfinite(gain)
        mean = np.full(blocks, np.mean(gain[known]) if known.any() else 0.0)
        gain = np.where(known, _ratio(gain, mean), 1.0)
    return np.where(known, gain, np.nan)


def _ratio(above: NDArray[Any], below: NDArray[Any]) -> Array:
    """The ratio of two arrays; NaN where it is not determined."""
    return np.divide(above, below, out=np.full(above.shape, np.nan), where=np.abs(below) > 0.0)


def without_flicker(intensity: Channel, flicker: Sequence[LineBlock]) -> Channel:
    """The intensity over its flicker, corrected as it is read; where it is below ``MIN_GAIN``, over that."""
    if not flicker:
        return intensity

    def fetch(first: int, stop: int) -> Array:
        values, time = intensity.read(first, stop), intensity.time(first, stop)
        gain = np.maximum(1.0 + sum_of_lines(flicker, time), MIN_GAIN)
        return values / (gain if values.ndim == 1 else gain[:, None])

    samples = LazySamples(intensity.shape, np.dtype(np.float64), fetch)
    return replace(intensity, raw=samples, first=0, stop=intensity.size, gain=1.0, offset=0.0)


def describe_flicker(flicker: Sequence[LineBlock]) -> list[str]:
    """A line on flicker, with the option that removes it from the picture.

    Args:
        flicker: of the relative gain.
    """
    if not flicker:
        return []
    lines = flicker[0].lines
    others = f", and at {counted(len(lines) - 1, 'further line')}" if len(lines) > 1 else ""
    return [
        f"intensity: all places vary by ±{100 * lines[0].amplitude:.3g} % at {lines[0].frequency:.4g} Hz{others}: the "
        "light flickers, the gain of the detector does, or ambient light adds to the signal. The phase allows for it, "
        "the picture does not: run again with --intensity-drift gain, or offset for ambient light"
    ]
