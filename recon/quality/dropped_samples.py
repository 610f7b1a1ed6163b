"""Samples that were dropped from the intensity only: from some time on the intensity is early against the motion.

No phase estimate contains this error, because the other channels are complete.

Forward and backward half-periods then disagree from there on, by a delay that is a whole number of samples and common
to both axes. The picture of the time before predicts the intensity along the beam's path, and the lag at which
prediction and intensity correlate is the number of dropped samples. Samples of one place at two times are compared;
the sharpness of a picture is not used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.imaging.gridding import map_samples, pixel_index
from recon.imaging.picture import Grid
from recon.imaging.scan_phase.bidirectional_phase import measure_motion_phase_errors, slow_period
from recon.imaging.scan_phase.phase_error import PhaseError
from scanner.arrays import Array
from scanner.channel import Channel, LazySamples
from scanner.device import AXES
from scanner.motion import Motion
from scanner.recording import Recording

MAX_DELAY_SAMPLES = 0.5
"""Delay of a slice below which it counts as aligned: dropped samples cause a delay of at least one."""

SEARCH_PERIODS = 4.0
"""Periods of the slower axis over which lags are searched, in both directions. It bounds the cost."""

COARSENING = 2
"""Pixels of the picture in one of the picture that predicts, which so has fewer holes and less noise."""

MAX_COMPARED_SAMPLES = 6000
"""Samples compared at each lag. More change the correlation by less than ``MIN_CORRELATION_MARGIN``."""

MIN_CORRELATION = 0.5
"""Smallest correlation of prediction and intensity at the lag that is accepted."""

MIN_CORRELATION_MARGIN = 0.1
"""Smallest margin of that correlation above those at other lags: a periodic target correlates at several."""

MIN_LAG_SEPARATION_SAMPLES = 8
"""Distance from which two lags count as different: samples at neighbouring lags fall into the same pixels."""

LOCATION_CHI2 = 12.0
"""Excess of the squared residuals over their minimum, in noise variances, up to which a place of the loss is possible
(about 3.5 standard deviations)."""


class DroppedSamples(NamedTuple):
    """Samples of the intensity that were dropped or repeated.

    Attributes:
        first, stop: range of samples in which the loss lies.
        missing: number of dropped samples; negative where samples are repeated.
    """

    first: int
    stop: int
    missing: int


class TimingBreak(NamedTuple):
    """A time from which on forward and backward half-periods disagree in the picture.

    Attributes:
        sample: first sample of the first slice that disagrees, not necessarily a whole number.
        dropped: the dropped samples that explain it; None where the picture cannot locate them.
    """

    sample: float
    dropped: DroppedSamples | None


def find_timing_break(
    phase_errors: Sequence[PhaseError], motion: Motion, intensity: Channel, grid: Grid
) -> TimingBreak | None:
    """Return where the intensity loses its timing; None where it does not, or not at one time.

    Args:
        phase_errors: of equal time slices that cover the whole intensity.
        motion: its angles on the intensity's clock.
    """
    if slices_aligned(phase_errors, motion).all():
        return None
    slices = len(phase_errors)
    late_slice = first_late_slice(register_slices_separately(motion, intensity, grid, slices), motion)
    if late_slice is None:
        return None
    dropped = locate_dropped_samples(motion, intensity, grid, slices, late_slice)
    return TimingBreak(late_slice * intensity.size / slices, dropped)


def find_timing_break_between(
    phase_errors: Sequence[PhaseError], motion: Motion, intensity: Channel, grid: Grid, slice_samples: int
) -> TimingBreak | None:
    """As :func:`find_timing_break`, for a long scan of which only parts were measured.

    The slice in which the timing is lost is found by bisection between the last slice that is aligned and the first
    that is late, so that the cost grows with the logarithm of the length.

    Args:
        phase_errors: of equal time slices in parts of the scan, in order of time, each in a picture of its part.
        motion, intensity, grid: as above.
        slice_samples: length of a slice.
    """
    late = first_late_slice(phase_errors, motion)
    if late is None:
        return None
    slices = intensity.size // slice_samples
    edges = _slice_edges(intensity, slices)
    begin, end = (
        min(int(phase_errors[at].time * intensity.sample_rate * slices / intensity.size), slices - 2)
        for at in (late - 1, late)
    )
    while end - begin > 1:
        middle = (begin + end) // 2
        part = [(edges[middle], edges[middle + 1])]
        aligned = slices_aligned(measure_motion_phase_errors(motion, intensity, grid, part), motion).all()
        begin, end = (middle, end) if aligned else (begin, middle)
    dropped = locate_dropped_samples(motion, intensity, grid, slices, end)
    return None if dropped is None else TimingBreak(edges[end], dropped)


def slice_delays(phase_errors: Sequence[PhaseError], motion: Motion) -> Array:
    """Return by how many samples the intensity is early in each slice, shape (slices,); NaN where undetermined.

    The delays of both axes are averaged with their information as weights.
    """
    delay, weight = _axis_delays(phase_errors, motion)
    return _average(delay, weight, axis=1)


def _axis_delays(phase_errors: Sequence[PhaseError], motion: Motion) -> tuple[Array, Array]:
    """By how many samples the intensity is early in each slice and axis, and the information, each (slices, 2).

    Both are zero where an axis is undetermined.
    """
    rate = motion.axes["x"].angle.sample_rate
    errors = np.array(
        [[getattr(error, axis) for axis in AXES] for error in phase_errors]
    )  # (slices, axes, (value, sd))
    phase_per_sample = 2 * np.pi * np.array([np.median(motion.axes[axis].frequency) for axis in AXES]) / rate
    weight = (phase_per_sample / np.maximum(errors[..., 1], 1e-9)) ** 2  # without noise a standard error can be 0
    return np.where(weight > 0, errors[..., 0], 0.0) / phase_per_sample, weight


def _average(values: Array, weights: Array, axis: int) -> Array:
    """Weighted average along an axis; NaN where there is no weight."""
    total = weights.sum(axis)
    return np.divide((weights * values).sum(axis), total, out=np.full(total.shape, np.nan), where=total > 0)


def slices_aligned(phase_errors: Sequence[PhaseError], motion: Motion) -> NDArray[np.bool_]:
    """Return which slices agree with their motion, shape (slices,)."""
    return np.abs(slice_delays(phase_errors, motion)) < MAX_DELAY_SAMPLES


def register_slices_separately(motion: Motion, intensity: Channel, grid: Grid, slices: int) -> list[PhaseError]:
    """Measure the phase errors of equal slices, each in a separate picture.

    In a picture shared by all slices, a late slice disturbs the others.
    """
    edges = _slice_edges(intensity, slices)
    return [error for part in pairwise(edges) for error in measure_motion_phase_errors(motion, intensity, grid, [part])]


def first_late_slice(phase_errors: Sequence[PhaseError], motion: Motion) -> int | None:
    """Return the first slice from which on none is aligned while all before it are; None where there is no such slice.

    The delay has to change there by as much as a slice may be late: a constant delay near that limit is within it in
    one slice and beyond it in another. It is compared in the axes that are determined before and after: dropped samples
    delay both, and the phase error of an axis that is determined only later may have been there from the start. The
    last slice alone is not accepted, because the location needs a whole slice after it. Slices after the end of the
    motion, as of sensors that were stopped first, are not counted.
    """
    end = min(float(axis.time[-1]) - axis.angle.start for axis in motion.axes.values())
    phase_errors = [error for error in phase_errors if error.time <= end]
    if not phase_errors:
        return None
    late = ~slices_aligned(phase_errors, motion)
    first = int(np.argmax(late))
    if not (0 < first < len(phase_errors) - 1 and late[first:].all()):
        return None
    delay, weight = _axis_delays(phase_errors, motion)
    if not weight[first:].any():  # later than the registration reaches
        return first
    before, after = (_average(delay[part], weight[part], axis=0) for part in (slice(first), slice(first, None)))
    in_both = np.minimum(weight[:first].sum(0), weight[first:].sum(0))
    change = _average(np.nan_to_num(after - before), in_both, axis=0)
    return first if abs(change) > MAX_DELAY_SAMPLES else None


def locate_dropped_samples(
    motion: Motion, intensity: Channel, grid: Grid, slices: int, late_slice: int
) -> DroppedSamples | None:
    """Return the samples dropped between the slices before and after ``late_slice``.

    Args:
        motion: its angles on the intensity's clock.
        intensity: shape (n,) or (n, detectors); detectors are averaged.
        grid: the pixels of the picture.
        slices: number of equal slices.
        late_slice: see :func:`first_late_slice`.

    Returns:
        None where the picture of the time before predicts the later intensity at no lag, or at several.
    """
    edges = _slice_edges(intensity, slices)
    coarse = Grid(
        max(1, grid.width // COARSENING), max(1, grid.height // COARSENING), grid.half_angle_x, grid.half_angle_y
    )
    begin = edges[late_slice + 1]
    end = (edges[late_slice + 1] + edges[late_slice + 2]) // 2  # half a slice, so that later lags fit after it
    values = intensity.read(0, end)
    values = values if values.ndim == 1 else values.mean(axis=1)
    values[~np.isfinite(values)] = np.nan
    reach = math.ceil(SEARCH_PERIODS * slow_period(motion) * intensity.sample_rate)
    x, y = (motion.axes[axis].angle.read(0, end + reach) for axis in AXES)
    aligned = slice(0, edges[late_slice])
    picture = map_samples(x[aligned], y[aligned], values[aligned], coarse).image.astype(float)
    column, row = pixel_index(x, grid.half_angle_x, coarse.width), pixel_index(y, grid.half_angle_y, coarse.height)
    predicted = np.where((column >= 0) & (row >= 0), picture[row, column], np.nan)
    lag = _find_lag(predicted, values, begin, reach)
    return None if lag is None else _locate_loss(predicted, values, edges[late_slice - 1], begin, lag)


def _slice_edges(intensity: Channel, slices: int) -> list[int]:
    """First samples of equal slices, and the end of the last one."""
    return [intensity.size * k // slices for k in range(slices + 1)]


def _find_lag(predicted: Array, values: Array, begin: int, reach: int) -> int | None:
    """Samples by which the intensity from ``begin`` on is early; None where it is 0 or ambiguous."""
    at = np.arange(begin, values.size, max(1, (values.size - begin) // MAX_COMPARED_SAMPLES))
    lags = np.arange(-min(reach, begin), min(reach, predicted.size - values.size) + 1)
    correlation = np.array([_correlation(predicted[at + lag], values[at]) for lag in lags.tolist()])
    best = int(np.argmax(correlation))
    others = correlation[np.abs(lags - lags[best]) >= MIN_LAG_SEPARATION_SAMPLES]
    above_others = correlation[best] > others.max(initial=0.0) + MIN_CORRELATION_MARGIN
    unambiguous = correlation[best] > MIN_CORRELATION and above_others
    return int(lags[best]) or None if unambiguous else None


def _correlation(one: Array, other: Array) -> float:
    """Correlation coefficient over the samples that both have; 0 for fewer than 100 of them."""
    both = np.isfinite(one) & np.isfinite(other)
    if np.count_nonzero(both) < 100:
        return 0.0
    one, other = one[both] - one[both].mean(), other[both] - other[both].mean()
    return float(one @ other / max(math.sqrt(float(one @ one) * float(other @ other)), 1e-300))


def _locate_loss(predicted: Array, values: Array, first: int, stop: int, lag: int) -> DroppedSamples:
    """The range within ``first`` to ``stop`` where the intensity turns from aligned to ``lag`` samples early.

    The sum of squared residuals for a loss at each place is compared with its minimum.
    """
    at = np.arange(max(first, -lag), stop)
    aligned, early = (np.square(predicted[at + shift] - values[at]) for shift in (0, lag))
    both = np.isfinite(aligned) & np.isfinite(early)
    cost = np.concatenate([[0.0], np.cumsum(np.where(both, aligned - early, 0.0))])
    # The median of a chi-square of one degree of freedom is 0.45.
    noise_variance = float(np.median(np.minimum(aligned, early)[both])) / 0.45 if both.any() else 0.0
    possible = np.flatnonzero(cost <= cost.min() + LOCATION_CHI2 * noise_variance)
    return DroppedSamples(int(at[0] + possible[0]), int(at[0] + possible[-1]) + 1, lag)


def restore_timing(recording: Recording, dropped: DroppedSamples) -> Recording:
    """Return the recording with an intensity in time again.

    Samples after the loss are shifted; the range in which the loss lies becomes a gap (NaN).
    """
    channel = recording["intensity"]
    unshifted_end = min(dropped.first, dropped.stop + dropped.missing)
    shifted_begin = dropped.stop + dropped.missing

    def read(first: int, stop: int) -> Array:
        out = np.full((stop - first, *channel.shape[1:]), np.nan)
        if first < unshifted_end:
            out[: unshifted_end - first] = channel.read(first, min(stop, unshifted_end))
        if stop > shifted_begin:
            begin = max(first, shifted_begin)
            out[begin - first :] = channel.read(begin - dropped.missing, stop - dropped.missing)
        return out

    shape = channel.size + dropped.missing, *channel.shape[1:]
    raw = LazySamples(shape, np.dtype(np.float64), read)
    restored = replace(channel, raw=raw, first=0, stop=shape[0], gain=1.0, offset=0.0)
    return recording.with_channel(restored)
