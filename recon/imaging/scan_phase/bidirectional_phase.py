"""Bidirectional phase: the phase error that forward and backward half-periods show in the picture.

A sample whose true angle is A sin(α + d), but which was mapped to A sin α, appears d·A cos α behind its true position
in forward half-periods (cos α > 0) and ahead of it in backward ones. The two directions so show one place 2 m d pixels
apart at the centre of a line, and less towards its ends. The estimate is the d of both axes for which all samples of
one place agree in the least-squares sense. The sharpness of a picture is not used, and no truth is needed. An error of
the amplitude displaces both directions equally and does not change d.

The model of a sample is I = f(u + d c) + noise: the unknown picture f at the true position, where the mapped position u
and its change with the phase, c = A cos α, are known. f is eliminated by smoothing intensities and positions in the
same way (Robinson 1988, "Root-N-consistent semiparametric regression"): with the normalised convolution S,

    I - S[I] = ∇f · ((u - S[u]) + d (c - S[c])) + noise,

which is solved for d by Gauss-Newton. The samples are mapped again with each new d.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.imaging.picture import Grid
from recon.imaging.scan_phase.bidirectional_equations import BLOCKS_PER_SLICE, normal_equations
from recon.imaging.scan_phase.bidirectional_search import (
    SEARCH_RESOLUTION_RAD,
    RegistrationSamples,
    search_phase_errors,
)
from recon.imaging.scan_phase.common_shift import common_place_factor, common_shift_factor
from recon.imaging.scan_phase.phase_error import PhaseError, PhaseErrorParts, PhaseEstimate
from recon.imaging.scan_phase.registration_cells import finest_cell
from recon.imaging.scan_phase.slow_gain import SlowGain, estimate_slow_gain
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import AXES
from scanner.errors import BadInput
from scanner.motion import Motion

PERIODS_PER_SLICE = 25
"""Periods of the slower axis in one time slice. About 15 are needed; within a longer slice the phase drifts."""

PARTS_PER_SLICE = 16
"""Parts of a slice with a phase error each: 1.5 periods of the slower axis, so that each has both directions."""

MIN_FINE_SLOPE_RATIO = 0.9
"""Slope of the score over the information from which cells finer than the coarsest are used. Below, a tenth of the
information or more is noise in the gradient, which correlates with the noise of the samples that it is compared with:
the result is then biased by several standard errors."""

STEP_DAMPING = 0.7
"""Factor on the Gauss-Newton step: the gradient of a smoothed picture is up to a half too flat, so a full step
overshoots."""


class _Fit(NamedTuple):
    """Phase errors and standard errors, (nan, inf) where undetermined.

    Attributes:
        value, sd: of each slice, shape (slices, 2).
        clear: whether the features of the picture exceed its noise, shape (slices, 2).
        unbiased: whether they exceed it so far that noise in the gradient does not bias the result, shape (slices, 1).
        parts: value and sd of each part of each slice, shape (slices, PARTS_PER_SLICE, 2, 2).
        factor: on the standard errors, for what repeats at the same places in all slices, shape (2,).
    """

    value: Array
    sd: Array
    clear: NDArray[np.bool_]
    unbiased: NDArray[np.bool_]
    parts: Array
    factor: Array


def measure_phase_errors(
    theta_x: NDArray[Any],
    theta_y: NDArray[Any],
    intensity: NDArray[Any],
    rate: float,
    grid: Grid,
    amplitude_x: float | Array,
    amplitude_y: float | Array,
    slices: int = 1,
) -> list[PhaseError]:
    """Measure the phase errors of both axes in each time slice of a scan.

    The slices share one picture, because a short slice alone leaves most of the field unvisited. Within a slice the
    error is constant by assumption. A slice needs about 15 periods of the slower axis.

    Args:
        theta_x, theta_y: angles the samples were mapped with, shape (n,) [rad].
        intensity: shape (n,) or (n, detectors); detectors are averaged. Samples with NaN are left out.
        rate: sample rate [Hz].
        grid: the pixels; detail finer than a pixel is not compared.
        amplitude_x, amplitude_y: of the angles, a number or shape (n,) [rad].
        slices: number of equal parts in time.

    Returns:
        One entry per slice. An axis whose error the samples do not determine has value nan and sd inf.

    Raises:
        BadInput: the shapes do not match, or there is less than one slice.
    """
    theta_x, theta_y, intensity = np.asarray(theta_x, float), np.asarray(theta_y, float), np.asarray(intensity, float)
    if not theta_x.shape == theta_y.shape == intensity.shape[:1]:
        raise BadInput(
            f"angles of shape {theta_x.shape} and {theta_y.shape} with an intensity of shape {intensity.shape}",
            hint="give one angle of each axis for each intensity",
        )
    if slices < 1:
        raise BadInput(f"{slices} slices", hint="give at least 1")
    n = theta_x.size
    pixels_x, pixels_y = 0.5 * grid.width / grid.half_angle_x, 0.5 * grid.height / grid.half_angle_y
    columns: list[NDArray[Any]] = [
        theta_x * pixels_x,
        theta_y * pixels_y,
        quadrature(theta_x, amplitude_x) * pixels_x,
        quadrature(theta_y, amplitude_y) * pixels_y,
        intensity.mean(axis=1) if intensity.ndim == 2 else intensity,
        np.arange(n) * (slices * BLOCKS_PER_SLICE) // max(n, 1),
    ]
    finite = np.all([np.isfinite(column) for column in columns], axis=0)
    value, sd, parts, gain, factor = _estimate_phase_errors(
        RegistrationSamples(*(column[finite] for column in columns)), grid, slices
    )
    length = n / slices / rate
    within = (np.arange(PARTS_PER_SLICE) + 0.5) * length / PARTS_PER_SLICE
    return [
        PhaseError(
            (s + 0.5) * length,
            PhaseEstimate(float(value[s, 0]), float(sd[s, 0])),
            PhaseEstimate(float(value[s, 1]), float(sd[s, 1])),
            PhaseErrorParts(s * length + within, parts[s, ..., 0], parts[s, ..., 1]),
            gain,
            (float(factor[s, 0]), float(factor[s, 1])),
        )
        for s in range(slices)
    ]


def measure_motion_phase_errors(
    motion: Motion, intensity: Channel, grid: Grid, parts: Iterable[tuple[int, int]]
) -> list[PhaseError]:
    """Measure the phase errors of a motion in slices of ``PERIODS_PER_SLICE``.

    Args:
        motion: its angles on the intensity's clock.
        intensity: shape (n,) or (n, detectors).
        grid: the pixels.
        parts: ranges of samples (first, stop); the slices of one part share one picture.

    Returns:
        One entry per slice; times are counted from the first sample of the intensity.
    """
    x, y = (motion.axes[axis].angle for axis in AXES)
    phase_errors = []
    for first, stop in parts:
        time = x.start + np.arange(first, stop) / x.sample_rate
        amplitude_x, amplitude_y = (
            np.interp(time, motion.axes[axis].time, motion.axes[axis].amplitude) for axis in AXES
        )
        slices = max(1, round((stop - first) / x.sample_rate / slow_period(motion) / PERIODS_PER_SLICE))
        angles, values = (x.read(first, stop), y.read(first, stop)), intensity.read(first, stop)
        errors = measure_phase_errors(*angles, values, x.sample_rate, grid, amplitude_x, amplitude_y, slices)
        phase_errors += [_later(error, first / x.sample_rate) for error in errors]
    return phase_errors


def _later(error: PhaseError, delay: float) -> PhaseError:
    """The phase error with its times counted from ``delay`` [s] earlier."""
    parts = error.parts and error.parts._replace(time=error.parts.time + delay)
    return replace(error, time=error.time + delay, parts=parts)


def slow_period(motion: Motion) -> float:
    """Return the period of the slower axis [s]."""
    return 1.0 / min(float(np.median(axis.frequency)) for axis in motion.axes.values())


def quadrature(theta: Array, amplitude: float | Array) -> Array:
    """Return A cos α of the angle A sin α, shape (n,) [rad]: positive in forward half-periods, else negative.

    Args:
        theta: angles A sin α, shape (n,) [rad].
        amplitude: A, a number or shape (n,) [rad].
    """
    if theta.size < 2:
        return np.zeros_like(theta)
    magnitude = np.abs(np.fft.rfft(np.nan_to_num(theta)))
    period = theta.size / (1 + int(np.argmax(magnitude[1:])))
    lag = max(round(period / 16), 1)  # long enough that noise does not invert the direction
    index = np.arange(theta.size)
    rise = theta[np.minimum(index + lag, theta.size - 1)] - theta[np.maximum(index - lag, 0)]
    return np.sign(rise) * np.sqrt(np.maximum(np.square(amplitude) - np.square(theta), 0.0))


def _estimate_phase_errors(
    samples: RegistrationSamples, grid: Grid, slices: int
) -> tuple[Array, Array, Array, SlowGain | None, Array]:
    """Phase errors, standard errors and parts as in ``_Fit``, each at the cell size with the least standard error, the
    slow gain, and the factors for a common shift, shape (slices, 2)."""
    part = samples.block // BLOCKS_PER_SLICE
    filled = np.bincount(part, minlength=slices) >= 4 * BLOCKS_PER_SLICE  # others lie in a gap and determine nothing
    if not filled.any():
        nothing = np.full((slices, 2), np.nan), np.full((slices, 2), np.inf)
        return *nothing, _undetermined_parts(slices), None, np.ones((slices, 2))
    inside = (2.0 * np.abs(samples.x) < grid.width) & (2.0 * np.abs(samples.y) < grid.height)
    finest, repeats = finest_cell(samples, inside, grid)
    gain = _slow_gain(samples.select(inside), grid, finest, slices)
    samples = samples._replace(intensity=samples.intensity / gain.at(_slice_time(samples)))
    unknown = np.full(2, np.nan)
    start = np.array([search_phase_errors(samples.select(part == s)) if filled[s] else unknown for s in range(slices)])
    clear = np.isfinite(start)
    start = np.where(clear, start, 0.0)
    covered = int(filled.sum())
    groups = _blocks_of_a_period(samples.dx, covered), _blocks_of_a_period(samples.dy, covered)
    best, limit = start, np.full_like(start, SEARCH_RESOLUTION_RAD)
    best_parts, factor, coarser = _undetermined_parts(slices), np.ones_like(start), None
    for cell in (4 * finest, 2 * finest, finest):  # noisy pictures need large cells, fine detail small ones
        fit = _fit_cells(samples, best, grid, cell, groups)
        clear &= fit.clear  # noise that hides coarse detail also hides fine detail
        fine_enough = fit.unbiased | (cell == 4 * finest)
        better = (
            clear & fine_enough & (fit.sd < limit) & (np.abs(fit.value - start) < 2 * SEARCH_RESOLUTION_RAD)
        )  # further away is another minimum
        best, limit = np.where(better, fit.value, best), np.where(better, fit.sd, limit)
        best_parts = np.where(better[:, None, :, None], fit.parts, best_parts)
        common = common_shift_factor(coarser, (fit.value, fit.sd)) if coarser else 1.0
        factor = np.where(better, np.maximum(common, fit.factor) if repeats else common, factor)
        coarser = fit.value, fit.sd
    determined = limit < SEARCH_RESOLUTION_RAD
    return np.where(determined, best, np.nan), np.where(determined, limit, np.inf), best_parts, gain, factor


def _slow_gain(samples: RegistrationSamples, grid: Grid, cell: float, slices: int) -> SlowGain:
    """The slow change of the detector's gain, found in cells of one size [px]."""
    columns, rows = math.ceil(grid.width / cell), math.ceil(grid.height / cell)
    column, row = (
        np.clip((place / cell + 0.5 * number).astype(np.int64), 0, number - 1)
        for place, number in ((samples.x, columns), (samples.y, rows))
    )
    return estimate_slow_gain(row * columns + column, _slice_time(samples), samples.intensity, slices)


def _slice_time(samples: RegistrationSamples) -> Array:
    """Middle of each sample's block, in slices from the first sample, shape (n,)."""
    return (samples.block + 0.5) / BLOCKS_PER_SLICE


def _undetermined_parts(slices: int) -> Array:
    """Parts as in ``_Fit`` of which none is determined."""
    return np.tile([np.nan, np.inf], (slices, PARTS_PER_SLICE, 2, 1))


def _blocks_of_a_period(change: Array, slices: int) -> int:
    """Blocks of about one period of an axis: the power of two nearest to it, at least 1.

    Detail that the cells do not resolve acts on both directions of an axis with opposite signs. In blocks of half a
    period it would count as noise, although it cancels.

    Args:
        change: of the position with the phase, whose sign is the direction, shape (n,).
    """
    periods = np.count_nonzero(np.diff(np.sign(change[change != 0.0]))) / 2.0 / slices
    nearest = 2 ** round(math.log2(BLOCKS_PER_SLICE / max(periods, 1.0)))
    return min(max(nearest, 1), BLOCKS_PER_SLICE // 4)


def _fit_cells(samples: RegistrationSamples, error: Array, grid: Grid, cell: float, groups: tuple[int, int]) -> _Fit:
    """Gauss-Newton from ``error`` on, over cells of one size [px]; the scores of groups of blocks are independent."""
    to_cells = 0.5 * np.array([grid.width, grid.height]) / cell
    for _ in range(10):
        here = normal_equations(samples, error, grid, cell)
        step = STEP_DAMPING * (np.linalg.pinv(here.information) @ here.score.sum(1)[..., None])[..., 0]
        step = np.clip(step, -1 / to_cells, 1 / to_cells)  # the gradient is valid within a cell
        error = error + step
        if np.abs(step * to_cells).max() < 0.01:
            break
    here = normal_equations(samples, error, grid, cell)
    slope = np.empty_like(here.information)  # by differences: the information would count noise in the gradient
    for axis in range(2):
        shift = np.eye(2)[axis] / to_cells
        ahead, behind = (normal_equations(samples, error + s, grid, cell).score.sum(1) for s in (shift, -shift))
        slope[:, :, axis] = (behind - ahead) * to_cells[axis] / 2
    slope_of, expected = (np.diagonal(matrix, axis1=1, axis2=2) for matrix in (slope, here.information))
    # Noise in the gradient makes the slope too small, and detail lost in the smoothing makes it too large. Features of
    # the other axis that leak in through the pattern of the scan give little information.
    clear = slope_of > 0.5 * expected
    determined = clear & (slope_of < 2 * expected) & (expected > 0.05 * expected.max(1, keepdims=True))
    unbiased = ((slope_of > MIN_FINE_SLOPE_RATIO * expected) | ~determined).all(axis=1, keepdims=True)
    value, sd, parts = error.copy(), np.full_like(error, np.inf), _undetermined_parts(len(error))
    by_place = np.zeros_like(here.tile_score)
    for s, axes in enumerate(determined):
        if axes.any():
            inverse = np.linalg.pinv(slope[s][np.ix_(axes, axes)]).T
            shares, by_place[s][:, axes] = here.score[s][:, axes] @ inverse, here.tile_score[s][:, axes] @ inverse
            sd[s, axes] = [
                np.linalg.norm(share.reshape(-1, group).sum(axis=1))
                for share, group in zip(shares.T, np.array(groups)[axes], strict=True)
            ]
            weight = here.block_information[s][:, axes].reshape(PARTS_PER_SLICE, -1, axes.sum()).sum(1)
            weight = np.maximum(weight / weight.sum(0), np.finfo(float).tiny)
            by_part = shares.reshape(PARTS_PER_SLICE, -1, axes.sum()).sum(1)
            parts[s][:, axes, 0] = value[s, axes] + by_part / weight
            parts[s][:, axes, 1] = sd[s, axes] / np.sqrt(weight)
            value[s, axes] += shares.sum(0)
    return _Fit(value, sd, clear, unbiased, parts, common_place_factor(by_place, sd))
