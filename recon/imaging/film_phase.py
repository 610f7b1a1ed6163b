"""Line phase of a film: what its frames share (the lag's shape, the smoothing), and the phase over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.imaging.line_phase import (
    BLOCKS_ACROSS,
    MAX_FILL_SQUARED,
    SMOOTHING_SDS_PX,
    UNDETERMINED,
    LinePhase,
    column_places,
    estimate_line_phase,
    lag_at,
    search_shift,
    shift_equations,
    standard_errors,
)
from scanner.arrays import Array
from scanner.errors import BadInput

MAX_SHIFT_SD_PX = 0.5
"""Standard error above which a frame's own estimate is not used: the search then takes noise for a match."""

MIN_MIRRORED_GAIN = 0.2
"""By how much lines have to correlate better with their mirrored neighbours to be reported as not reversed."""

MAX_FILL_ITERATIONS = 20
"""Steps of the fill's iteration; about five are needed."""

Frame = Sequence[NDArray[np.float32]]
"""Pictures of one frame by detector, each of shape (rows, columns)."""


MIN_NOISE_FRACTION = 0.1
"""Smallest share of a squared standard error that is attributed to noise, because the estimate of the other part
scatters."""

COLUMN_GROUPS = 16
"""Groups of columns whose lag is measured separately, for the figure that compares it with the law."""


class ColumnLag(NamedTuple):
    """Measured shift of groups of columns as a fraction of that at the middle, its standard error, and their places u.

    Each of shape (COLUMN_GROUPS,).
    """

    place: Array
    value: Array
    sd: Array


@dataclass(frozen=True)
class FilmModel:
    """What all frames of a film share.

    Attributes:
        smoothing: standard deviation of the Gaussian that gives the least standard error [px].
        fill: fraction of the sweep's width that the columns cover; 0 if the shift is the same in all columns.
        fill_sd: its standard error; nan if the film does not determine it.
        typical: median shift of the sampled frames [px].
        detail_sd: error of the shift by the specimen's own detail, which frames of one specimen share [px].
        fill_error: error of the shift by that of the fill, which all frames share [px].
        lag: measured lag in groups of columns.
    """

    smoothing: float
    fill: float
    fill_sd: float
    typical: float
    detail_sd: float
    fill_error: float
    lag: ColumnLag


def frame_phase(frame: Frame, model: FilmModel, before: float) -> LinePhase:
    """Estimate the line phase of one frame.

    Args:
        frame: pictures by detector.
        model: of the film.
        before: shift of the frame before [px]. The frame's own search is used where it fits better.
    """
    starts = [before]
    found = search_shift(np.sum(frame, axis=0))
    if abs(found - before) > 1.0:
        starts.append(found)
    estimates = [estimate_line_phase(frame, start, model.fill**2, model.smoothing) for start in starts]
    usable = [each for each in estimates if each.sd < MAX_SHIFT_SD_PX]
    return min(usable, key=lambda each: each.sd, default=UNDETERMINED)


def fit_film(frames: Sequence[Frame]) -> FilmModel:
    """Fit what the frames share to a sample of them.

    Raises:
        BadInput: no frame determines a line phase, or the lines of the second direction are not reversed.
    """
    _check_reversed(frames)
    start = _common_shift(frames)
    trials = {
        smoothing: [estimate_line_phase(frame, start, 0.0, smoothing) for frame in frames]
        for smoothing in SMOOTHING_SDS_PX
    }
    smoothing = min(trials, key=lambda each: float(np.median([phase.sd for phase in trials[each]])))
    shifts = [phase.shift if phase.sd < MAX_SHIFT_SD_PX else np.nan for phase in trials[smoothing]]
    if not np.isfinite(shifts).any():
        hint = "sum frames or channels, or take a film of a specimen with structure along the lines"
        raise BadInput("the frames have too little structure or too much noise to determine a line phase", hint=hint)
    used = [(frame, shift) for frame, shift in zip(frames, shifts, strict=True) if np.isfinite(shift)]
    fill_squared, sd, coupling = _fit_fill(used, smoothing)
    typical, sd_of_fill = float(np.nanmedian(shifts)), np.nan
    if fill_squared > 1.96 * sd:
        sd_of_fill = sd / (2.0 * np.sqrt(fill_squared))
    else:
        fill_squared = 0.0
    lag, detail_sd = _measure_lag(frames, fill_squared, smoothing, typical)
    return FilmModel(
        smoothing=smoothing,
        fill=float(np.sqrt(fill_squared)),
        fill_sd=float(sd_of_fill),
        typical=typical,
        detail_sd=detail_sd,
        fill_error=abs(coupling) * min(sd, MAX_FILL_SQUARED / 2),
        lag=lag,
    )


def smooth_phases(value: Array, sd: Array, shared_sd: float = 0.0) -> tuple[Array, Array]:
    """Smooth the shifts of successive frames as a random walk observed with noise; bridge undetermined frames.

    The walk's step is estimated by maximum likelihood.

    Args:
        value: shift of each frame [px], shape (n,); nan where undetermined.
        sd: standard errors [px], shape (n,).
        shared_sd: part of them that all frames share, which no averaging reduces [px].

    Returns:
        Shift and standard deviation of each frame [px], shape (n,).
    """
    known = np.isfinite(value)
    noise = np.where(known, np.maximum(np.square(sd) - shared_sd**2, MIN_NOISE_FRACTION * np.square(sd)), np.inf)
    typical = float(np.median(noise[known]))
    step = typical * np.logspace(-6.0, 3.0, 73)
    first = int(np.argmax(known))
    mean, variance, cost = np.full(step.size, value[first]), np.full(step.size, noise[first]), np.zeros(step.size)
    for v, r in zip(value[first + 1 :], noise[first + 1 :], strict=True):
        variance = variance + step
        if np.isfinite(v):
            total = variance + r
            cost += np.square(v - mean) / total + np.log(total)
            gain = variance / total
            mean, variance = mean + gain * (v - mean), (1.0 - gain) * variance
    smooth, left = _smooth_walk(np.where(known, value, 0.0), noise, float(step[np.argmin(cost)]))
    return smooth, np.sqrt(left + shared_sd**2)


def _smooth_walk(value: Array, noise: Array, step: float) -> tuple[Array, Array]:
    """Mean and variance of a random walk given all observations, by information from before and from behind."""

    def pass_over(values: Array, noises: Array) -> tuple[Array, Array]:
        """Weighted mean and information of the observations before each one, shape (n,)."""
        mean, information = 0.0, 0.0
        means, informations = np.zeros(values.size), np.zeros(values.size)
        for k, (v, r) in enumerate(zip(values, noises, strict=True)):
            information = 1.0 / (1.0 / information + step) if information > 0.0 else 0.0
            means[k], informations[k] = mean, information
            weight = 1.0 / r
            if weight > 0.0:
                mean = (information * mean + weight * v) / (information + weight)
                information += weight
        return means, informations

    before, before_information = pass_over(value, noise)
    behind, behind_information = (each[::-1] for each in pass_over(value[::-1], noise[::-1]))
    total = before_information + behind_information + 1.0 / noise
    return (before_information * before + behind_information * behind + value / noise) / total, 1.0 / total


def _common_shift(frames: Sequence[Frame]) -> float:
    """Median of the whole-pixel shifts of the frames [px]."""
    return float(np.median([search_shift(np.sum(frame, axis=0)) for frame in frames]))


def _fit_fill(used: Sequence[tuple[Frame, float]], smoothing: float) -> tuple[float, float, float]:
    """fill², its standard error, and the change of the mean shift with it [px].

    Shift and tilt of each frame are eliminated.
    """
    fill_squared, shifts = 0.0, [shift for _, shift in used]
    for _ in range(MAX_FILL_ITERATIONS):
        score, slope, coupling = 0.0, 0.0, 0.0
        for index, (frame, _) in enumerate(used):
            equations = [shift_equations(each, shifts[index], fill_squared, smoothing) for each in frame]
            blocks = np.sum([each.score for each in equations], axis=0)
            slopes = np.sum([each.slope for each in equations], axis=0)
            total = slopes.sum(axis=0)
            known = np.linalg.solve(total[:2, :2], blocks.sum(axis=0)[:2])
            shifts[index] += float(np.clip(known[0], -1.0, 1.0))
            coupling += total[0, 2] / total[0, 0] / len(used)
            projection = total[2, :2] @ np.linalg.inv(total[:2, :2])
            left = blocks - slopes[:, :, :2] @ known
            score = score + left[:, 2] - left[:, :2] @ projection
            slope += total[2, 2] - projection @ total[:2, 2]
        if not slope > 0.0:
            return 0.0, np.inf, coupling
        old, fill_squared = fill_squared, float(np.clip(fill_squared + np.sum(score) / slope, 0.0, MAX_FILL_SQUARED))
        if abs(fill_squared - old) < 1e-4:
            break
    score = np.asarray(score) - np.mean(score)
    return fill_squared, float(np.sqrt(np.sum(np.square(score)))) / slope, coupling


def _measure_lag(
    frames: Sequence[Frame], fill_squared: float, smoothing: float, typical: float
) -> tuple[ColumnLag, float]:
    """Lag in groups of columns, the law and what is left to it, and the error by the specimen's own detail [px].

    Scores of a block are added up over the frames. What their noise is averages out; what the specimen's detail adds to
    them is the same in each frame of one specimen.
    """
    columns = frames[0][0].shape[1]
    group = np.arange(columns) * COLUMN_GROUPS // columns
    first = np.searchsorted(group, np.arange(COLUMN_GROUPS))
    score, slope = np.zeros((2, BLOCKS_ACROSS, COLUMN_GROUPS))
    block_score, block_slope = np.zeros((BLOCKS_ACROSS**2, 2)), np.zeros((BLOCKS_ACROSS**2, 2, 2))
    variances = []
    for frame in frames:
        phase = estimate_line_phase(frame, typical, fill_squared, smoothing)
        if phase.sd < MAX_SHIFT_SD_PX:
            variances.append(phase.sd**2)
            for each in frame:
                equations = shift_equations(each, phase.shift, fill_squared, smoothing)
                score += phase.shift * np.add.reduceat(equations.column_score, first, axis=1)
                slope += phase.shift**2 * np.add.reduceat(equations.column_slope, first, axis=1)
                block_score += equations.score[:, :2]
                block_slope += equations.slope[:, :2, :2]
    total = np.where(slope.sum(axis=0) > 0.0, slope.sum(axis=0), np.nan)
    left = score.sum(axis=0) / total
    scatter = np.sum(np.square(score - slope * left), axis=0) * BLOCKS_ACROSS / (BLOCKS_ACROSS - 1)
    place = np.add.reduceat(column_places(columns), first) / np.bincount(group)
    lag = ColumnLag(place, lag_at(place, fill_squared) + left, np.sqrt(scatter) / total)
    if len(variances) < 2:
        return lag, 0.0
    step = np.linalg.solve(block_slope.sum(axis=0), block_score.sum(axis=0))
    pooled = float(standard_errors(block_score, block_slope, step)[0]) ** 2
    count = len(variances)
    detail = (pooled - np.mean(variances) / count) * count / (count - 1)
    return lag, float(np.sqrt(np.clip(detail, 0.0, np.mean(variances))))


def _check_reversed(frames: Sequence[Frame]) -> None:
    """Check that odd lines show the specimen in the direction of even ones."""
    direct, mirrored = [], []
    for frame in frames:
        lines = np.asarray(np.sum(frame, axis=0, dtype=np.float64))
        even, odd = lines[0::2].mean(axis=0), lines[1::2].mean(axis=0)
        direct.append(_best_correlation(even, odd))
        mirrored.append(_best_correlation(even, odd[::-1]))
    if np.median(mirrored) > np.median(direct) + MIN_MIRRORED_GAIN:
        hint = "reverse every other line first"
        raise BadInput("lines of odd number fit their neighbours better mirrored: they are not reversed", hint=hint)


def _best_correlation(a: Array, b: Array) -> float:
    """Largest correlation coefficient of two profiles over shifts of up to an eighth of their length."""
    a, b = a - a.mean(), b - b.mean()
    reach = len(a) // 8
    full = np.correlate(a, b, "full")[len(a) - 1 - reach : len(a) + reach]
    return float(full.max() / max(np.sqrt((a @ a) * (b @ b)), 1e-300))
