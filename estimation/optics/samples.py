"""The intensity samples of a scan, and where in the scene given optics place them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from estimation.optics.scene import CellVariances, SamplingGeometry
from scanner.angle_tracks import AngleTrack
from scanner.arrays import Array, Mask
from scanner.channel import Channel
from scanner.device import AXES
from scanner.errors import BadInput
from scanner.interpolation import shift_samples

OpticsParameters = Mapping[str, float]
"""Values by name, see ``PARAMETER_NAMES``."""

PARAMETER_NAMES = (
    "delay_x", "delay_y", "delay_growth_x", "delay_growth_y", "amplitude_growth_x", "amplitude_growth_y", "decay",
    "drift_x", "drift_y", "intensity_delay", "intensity_lag",
)  # fmt: skip
"""``delay_*``: time by which the motion of an axis lags behind its estimate [s]. ``delay_growth_*``: its growth over
the recording [s]. ``amplitude_growth_*``: relative growth of the amplitude over the recording. ``decay``: exponent of
the fall of the light over the recording. ``drift_*``: displacement of the sample over the recording [half swings].
``intensity_delay``, ``intensity_lag``: delay and low-pass time constant of the intensity [s]."""

NOMINAL: OpticsParameters = dict.fromkeys(PARAMETER_NAMES, 0.0)
"""Optics without any effect."""

MAX_SAMPLES = 200_000
"""Samples used. Of a longer recording three runs are used, at its start, middle and end: effects that grow over the
recording are largest between them, and more samples take longer without changing a finding."""

TIME_BLOCKS, VALIDATION_EVERY = 20, 5
"""A recording is cut into ``TIME_BLOCKS`` blocks of time; every ``VALIDATION_EVERY``-th is left out of every fit.
Blocks hold many half-periods each, so that samples left out are not neighbours of fitted ones."""

MIN_SAMPLES_PER_CELL = 6.0
"""Fitted samples per cell of the finest grid: each cell needs samples from several half-periods."""

MIN_CELLS, MAX_CELLS = 24, 200
"""Cells along a side. A coarse grid has the widest range of convergence; the largest bounds time and memory."""


@dataclass(frozen=True, eq=False)
class ScanSamples:
    """The samples of a scan from which its optics are diagnosed.

    Attributes:
        tracks: angle of both axes at the intensity's samples, for the whole recording.
        runs: (first, stop) of the runs of samples that are used; n samples in all.
        centre, half_swing: middle and half of the range of the angle, by axis [rad].
        elapsed: time of each sample as a fraction of the recording, shape (n,).
        speed: of each axis, shape (n,) [half swings / s].
        intensity: shape (n,), in the channel's unit; detectors are averaged.
        train_mask, validation_mask: samples that are fitted and that are left out, shape (n,).
        duration: of the recording [s].
    """

    tracks: Mapping[str, AngleTrack]
    runs: tuple[tuple[int, int], ...]
    centre: Mapping[str, float]
    half_swing: Mapping[str, float]
    elapsed: Array
    speed: Mapping[str, Array]
    intensity: Array
    train_mask: Mask
    validation_mask: Mask
    duration: float

    @property
    def run_bounds(self) -> NDArray[np.int64]:
        """Index of the first sample of each run, and n, shape (runs + 1,)."""
        return np.cumsum([0, *(stop - first for first, stop in self.runs)])

    @property
    def largest_speed(self) -> dict[str, float]:
        """95th percentile of each axis's speed, which it has near the middle of a half-period [half swings / s]."""
        return {axis: float(np.percentile(np.abs(self.speed[axis]), 95)) for axis in AXES}

    @property
    def finest_cells(self) -> int:
        """Cells along a side of the finest grid that the samples fill."""
        cells = np.sqrt(np.count_nonzero(self.train_mask) / MIN_SAMPLES_PER_CELL)
        return int(np.clip(cells, MIN_CELLS, MAX_CELLS))

    def position(self, axis: str, delay: float) -> Array:
        """Position of the mirror ``delay`` seconds before each sample, shape (n,) [half swings from the centre]."""
        return _position(self, axis, delay)

    def first_samples(self, count: int) -> ScanSamples:
        """The first ``count`` samples only, for a search that needs no precision."""
        first = self.runs[0][0]
        stop = min(first + count, self.runs[0][1])
        part = slice(0, stop - first)
        return replace(
            self,
            runs=((first, stop),),
            elapsed=self.elapsed[part],
            speed={axis: speed[part] for axis, speed in self.speed.items()},
            intensity=self.intensity[part],
            train_mask=self.train_mask[part],
            validation_mask=self.validation_mask[part],
        )


@lru_cache(maxsize=6)
def _position(scan: ScanSamples, axis: str, delay: float) -> Array:
    """``ScanSamples.position``, cached because most parameters do not change the delay."""
    angle = np.concatenate([read_delayed(scan.tracks[axis], *run, delay) for run in scan.runs])
    unknown = ~np.isfinite(angle)
    if unknown.any():  # of samples that the masks leave out, and of a few beside them
        angle[unknown] = np.interp(np.flatnonzero(unknown), np.flatnonzero(~unknown), angle[~unknown])
    return np.asarray((angle - scan.centre[axis]) / scan.half_swing[axis])


def read_delayed(track: AngleTrack, first: int, stop: int, delay: float) -> Array:
    """Angles ``delay`` seconds before samples ``first`` up to ``stop``, shape (stop - first,) [rad]."""
    phasors = track.phasors()
    if phasors is not None:
        return phasors.delayed(delay).read(first, stop)
    margin = int(abs(delay) * track.sample_rate) + 4
    low = max(first - margin, 0)
    return shift_samples(track.read(low, stop + margin), -delay * track.sample_rate)[first - low : stop - low]


def read_scan(tracks: Mapping[str, AngleTrack], intensity: Channel) -> ScanSamples:
    """The samples of a recording from which its optics are diagnosed.

    Args:
        tracks: angle of each axis at the intensity's samples.
        intensity: shape (n,) or (n, detectors).

    Raises:
        BadInput: no sample is finite and has known angles, or the intensity is constant.
    """
    size = min(intensity.size, *(tracks[axis].size for axis in AXES))
    part = MAX_SAMPLES // 3
    runs = ((0, size),) if size <= MAX_SAMPLES else tuple((f, f + part) for f in (0, (size - part) // 2, size - part))
    index = np.concatenate([np.arange(*run) for run in runs])
    values = np.concatenate([intensity.read(*run) for run in runs])
    values = values.mean(axis=1) if values.ndim == 2 else values
    angles = {axis: np.concatenate([tracks[axis].read(*run) for run in runs]) for axis in AXES}
    finite = np.isfinite(values) & np.isfinite(angles["x"]) & np.isfinite(angles["y"])
    if not finite.any():
        what, hint = "has no sample at which both angles are known", "check the channels' start times"
        raise BadInput(what, file=intensity.file, channel=intensity.name, hint=hint)
    if np.ptp(values[finite]) == 0.0:
        what, hint = f"is constant, {values[finite][0]:.9g} {intensity.unit}", "check that it was connected"
        raise BadInput(what, file=intensity.file, channel=intensity.name, hint=hint)
    low, high = ({axis: float(end(angles[axis])) for axis in AXES} for end in (np.nanmin, np.nanmax))
    validation = (index * TIME_BLOCKS // size) % VALIDATION_EVERY == VALIDATION_EVERY // 2
    scan = ScanSamples(
        tracks={axis: tracks[axis] for axis in AXES},
        runs=runs,
        centre={axis: (high[axis] + low[axis]) / 2 for axis in AXES},
        half_swing={axis: (high[axis] - low[axis]) / 2 for axis in AXES},
        elapsed=(index + 0.5) / size,
        speed={},
        intensity=np.where(finite, values, 0.0),
        train_mask=finite & ~validation,
        validation_mask=finite & validation,
        duration=size / intensity.sample_rate,
    )
    step = 0.5 / intensity.sample_rate
    speed = {axis: (scan.position(axis, -step) - scan.position(axis, step)) / (2 * step) for axis in AXES}
    return replace(scan, speed=speed)


def project_samples(scan: ScanSamples, parameters: OpticsParameters, cells: int) -> SamplingGeometry:
    """Position, gain and lag of all samples under given optics, on a grid of ``cells`` along each side."""
    positions = []
    for axis in AXES:
        position = scan.position(axis, parameters["intensity_delay"] + parameters[f"delay_{axis}"])
        position = position - parameters[f"delay_growth_{axis}"] * (scan.elapsed - 0.5) * scan.speed[axis]
        position = position * (1.0 + parameters[f"amplitude_growth_{axis}"] * (scan.elapsed - 0.5))
        position = position - parameters[f"drift_{axis}"] * scan.elapsed
        positions.append(0.5 * (position + 1.0) * (cells - 1))
    lag_samples = max(parameters["intensity_lag"], 0.0) * scan.tracks["x"].sample_rate
    gain = np.exp(-parameters["decay"] * (scan.elapsed - 0.5))
    return SamplingGeometry(positions[0], positions[1], gain, lag_samples)


def measure_cell_variances(scan: ScanSamples, geometry: SamplingGeometry, cells: int) -> CellVariances:
    """Noise variance within cells and prior variance between neighbouring cells, by moments.

    The difference of two neighbours' means exceeds what the noise of both explains by the prior variance.
    """
    column, row = np.rint(geometry.u).astype(np.intp), np.rint(geometry.v).astype(np.intp)
    inside = scan.train_mask & (column >= 0) & (column < cells) & (row >= 0) & (row < cells)
    cell = (row * cells + column)[inside]
    values = scan.intensity[inside] / geometry.gain[inside]
    count = np.bincount(cell, minlength=cells**2).astype(np.float64)
    mean, square = (np.bincount(cell, values**power, cells**2) / np.maximum(count, 1) for power in (1, 2))
    noise = float(((square - mean**2) * count).sum() / np.maximum(count - 1, 0).sum())
    mean, count = mean.reshape(cells, cells), count.reshape(cells, cells)
    mean_variance = noise / np.maximum(count, 1)
    excess, pairs = 0.0, 1
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        both = (count[a] > 0) & (count[b] > 0)
        excess += ((mean[a] - mean[b]) ** 2 - mean_variance[a] - mean_variance[b])[both].sum()
        pairs += int(both.sum())
    return CellVariances(noise, max(float(excess) / pairs, 1e-4 * noise))
