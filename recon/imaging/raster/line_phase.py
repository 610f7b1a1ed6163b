"""Line phase of a resonant raster frame: how far the lines of the two directions lie apart.

Even lines run forward and odd lines backward, and the instrument has reversed the odd ones. A phase error d of the scan
moves what lies at x, counted from the middle of a sweep of half width A, by d sqrt(A² - x²) in forward lines and by as
much the other way in backward ones. With u = 2x/W for a frame of W columns the lines lie

    shift · sqrt(1 - fill² u²)

apart: ``shift`` is 2 d A [px], and ``fill`` = W/(2A) is the fraction of the sweep's width that the columns cover.
Pixels at equal distances in time show the same shift everywhere, which is ``fill`` = 0.

With f the picture, R its lines moved back by the assumed shift and D_i = (-1)^i (R_i - (R_(i-1) + R_(i+1))/2),

    D = remaining shift · sqrt(1 - fill² u²) ∂f/∂x + tilt · 2u ∂f/∂y + noise.

The second term is the slow axis, which moves on during a line. Both are solved for by Gauss-Newton with the gradient of
a smoothed picture as instrument z, that is z·D = 0 is solved with z·∂f/∂x of the frame as slope. The picture is the
frame's own, or that of other frames of the film (:mod:`recon.imaging.raster.film_reference`), which has less noise. The
instrument decides how precise the result is. It does not bias it, even where it shows another picture than the frame:
the noise of the own picture's gradient has no correlation with that of D, because its kernel along x is odd. The
alternating sign leaves only detail at the Nyquist frequency of the lines as an error of the picture itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from scanner.arrays import Array

SMOOTHING_SDS_PX = (0.8, 1.6, 3.2)
"""Standard deviations of the Gaussian that smooths the picture: fine detail in bright films, coarse in dim ones."""

MAX_SHIFT_FRACTION = 0.125
"""Largest shift that is searched for, as a fraction of the width: that of a phase error of 7°."""

BLOCKS_ACROSS = 8
"""Blocks along each side of the frame whose scores are treated as independent for the standard error."""

MAX_ITERATIONS = 12
"""Gauss-Newton steps; three to five are needed from the nearest whole pixel on."""

CONVERGED_PX = 1e-3
"""Step at which the iteration ends: a twentieth of the accuracy that a bright frame allows."""

MAX_SHIFT_SD_PX = 0.5
"""Standard error above which a frame's own estimate is not used: the search then takes noise for a match."""

MAX_FILL_SQUARED = 0.98
"""Bound on fill²: at 1 the lag has an infinite slope at the border."""


DIRECTIONS = (0, 1, 0)
"""Gradient that belongs to shift, tilt and fill²: along the lines (0) or across them (1)."""


class LinePhase(NamedTuple):
    """Distance between the lines of the two directions at the middle of the sweep, and its standard error [px].

    (nan, inf) where the frame does not determine it.
    """

    shift: float
    sd: float


UNDETERMINED = LinePhase(math.nan, math.inf)


class Gradients(NamedTuple):
    """Gradient of a reference picture on the pixels of a frame, each of shape (rows, columns), float32.

    Attributes:
        x, y: along and across the lines, divided by the variance of a pixel; 0 where there is no reference.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]


Instrument = float | Gradients
"""What a frame is compared with: its own lines, smoothed by this standard deviation [px], or a reference."""


class ShiftEquations(NamedTuple):
    """Normal equations of a frame for the remaining shift, the tilt and fill², at an assumed shift.

    Attributes:
        score: of each block, shape (BLOCKS_ACROSS², 3).
        slope: change of the score with the parameters, of each block, shape (BLOCKS_ACROSS², 3, 3).
        column_score, column_slope: of the remaining shift, by band of lines and column, shape (BLOCKS_ACROSS, columns).
    """

    score: Array
    slope: Array
    column_score: Array
    column_slope: Array


def lag_at(u: Array, fill_squared: float) -> Array:
    """Shift at the places ``u`` relative to the middle of the sweep; u is -1 and 1 at the borders of the frame."""
    return np.sqrt(np.maximum(1.0 - fill_squared * np.square(u), 0.0))


def column_places(columns: int) -> Array:
    """Places u of the columns' middles, shape (columns,)."""
    return (2.0 * np.arange(columns) - (columns - 1)) / columns


def moved_lines(frame: NDArray[np.float32], shift: float, fill_squared: float) -> NDArray[np.float32]:
    """The lines read where they show the same place, shape of ``frame``: for estimation, by cubic interpolation."""
    columns = frame.shape[1]
    half = 0.5 * shift * lag_at(column_places(columns), fill_squared)
    moved = np.empty_like(frame)
    for first, sign in ((0, -1.0), (1, 1.0)):
        _interpolate_lines(frame[first::2], np.arange(columns) + sign * half, moved[first::2])
    return moved


@numba.njit(cache=True, nogil=True)
def _interpolate_lines(lines, places, out):  # type: ignore[no-untyped-def]
    """Polynomial of the fifth degree through six pixels, of all lines at the same places (Lagrange); beyond the border
    the last pixel is repeated.

    Cubic convolution moves detail by up to 0.016 f'' pixels, in opposite directions in the lines of the two directions.
    """
    columns = lines.shape[1]
    index, weight = np.empty((6, columns), np.int64), np.empty((6, columns), np.float32)
    for j in range(columns):
        at = min(max(places[j], 0.0), columns - 1.0)
        low = min(int(at), columns - 2)
        t = at - low
        for k in range(6):
            index[k, j] = min(max(low + k - 2, 0), columns - 1)
            product = 1.0
            for m in range(6):
                if m != k:
                    product *= (t + 2.0 - m) / (k - m)
            weight[k, j] = product
    for i in range(lines.shape[0]):
        for j in range(columns):
            value = np.float32(0.0)
            for k in range(6):
                value += weight[k, j] * lines[i, index[k, j]]
            out[i, j] = value


def search_shift(frame: NDArray[Any]) -> float:
    """The whole number of pixels between the directions at which lines and their neighbours correlate most."""
    rows, columns = frame.shape
    lines = frame - frame.mean(axis=1, keepdims=True)
    neighbours = (lines[:-2] + lines[2:]) / 2
    sign = np.where(np.arange(1, rows - 1) % 2 == 0, 1.0, -1.0)
    size = 2 * columns
    spectrum = np.fft.rfft(lines[1:-1], size) * np.conj(np.fft.rfft(neighbours, size))
    even, odd = spectrum[sign > 0].sum(axis=0), spectrum[sign < 0].sum(axis=0)
    correlation = np.fft.irfft(even + np.conj(odd), size)
    reach = max(2, int(MAX_SHIFT_FRACTION * columns))
    shifts = np.arange(-reach, reach + 1)
    overlap = columns - np.abs(shifts)
    return float(shifts[np.argmax(correlation[-shifts] / overlap)])


def shift_equations(frame: NDArray[Any], shift: float, fill_squared: float, instrument: Instrument) -> ShiftEquations:
    """Normal equations of a frame at an assumed shift; the model is in the module's description.

    Args:
        frame: shape (rows, columns), float32.
        shift: assumed [px].
        fill_squared: assumed.
        instrument: own lines or reference.
    """
    rows, columns = frame.shape
    moved = moved_lines(frame, shift, fill_squared)
    if isinstance(instrument, Gradients):
        mean_x, mean_y = other_x, other_y = instrument
        own_y = gradients(moved).y
    else:
        even, odd = (_smoothed_lines(moved, parity, instrument) for parity in (0, 1))
        mean_x, mean_y, other_x, other_y, own_y = (np.zeros_like(moved) for _ in range(5))
        _own_gradients(even, odd, mean_x, mean_y, other_x, other_y, own_y)
    band = np.arange(rows) * BLOCKS_ACROSS // rows
    border = math.ceil(abs(shift) / 2) + 2  # columns that one direction did not record, and those of the difference
    score_sums, slope_sums = np.zeros((2, BLOCKS_ACROSS, columns)), np.zeros((4, BLOCKS_ACROSS, columns))
    _sum_products(moved, mean_x, mean_y, other_x, other_y, own_y, border, band, score_sums, slope_sums)
    u = column_places(columns)
    lag = lag_at(u, fill_squared)
    factors = np.array([lag, u, -0.5 * shift * u * u / np.maximum(lag, 0.1)])
    first = np.searchsorted(np.arange(columns) * BLOCKS_ACROSS // columns, np.arange(BLOCKS_ACROSS))
    score = np.add.reduceat(factors[:, None] * score_sums[list(DIRECTIONS)], first, axis=-1)
    pairs = slope_sums.reshape(2, 2, BLOCKS_ACROSS, columns)[np.ix_(DIRECTIONS, DIRECTIONS)]
    slope = np.add.reduceat(factors[:, None, None] * factors[None, :, None] * pairs, first, axis=-1)
    blocks = BLOCKS_ACROSS**2
    return ShiftEquations(
        score.reshape(3, blocks).T, slope.reshape(3, 3, blocks).transpose(2, 0, 1), score_sums[0], slope_sums[0]
    )


@numba.njit(cache=True, nogil=True)
def _sum_products(  # type: ignore[no-untyped-def]
    moved, mean_x, mean_y, other_x, other_y, own_y, border, band, score, slope
):
    """Add up, by band of lines and column, the products of which scores and slopes consist.

    Factors that depend on the column alone are left out.

    Args:
        score: the gradient along and across the lines times the difference, shape (2, bands, columns).
        slope: the independent gradient along, then across the lines times the frame's own gradient along and across
            them, shape (4, bands, columns).
    """
    rows, columns = moved.shape
    for i in range(1, rows - 1):
        half = np.float32(0.5)
        sign = np.float32(1.0) if i % 2 == 0 else np.float32(-1.0)
        b = band[i]
        for j in range(border, columns - border):
            difference = sign * (moved[i, j] - half * (moved[i - 1, j] + moved[i + 1, j]))
            near, far = moved[i, j + 1] - moved[i, j - 1], moved[i, j + 2] - moved[i, j - 2]
            own_x = (8.0 * near - far) / 12.0
            score[0, b, j] += mean_x[i, j] * difference
            score[1, b, j] += mean_y[i, j] * difference
            slope[0, b, j] += other_x[i, j] * own_x
            slope[1, b, j] += other_x[i, j] * own_y[i, j]
            slope[2, b, j] += other_y[i, j] * own_x
            slope[3, b, j] += other_y[i, j] * own_y[i, j]


def estimate_line_phase(
    channels: Sequence[NDArray[Any]], start: float, fill_squared: float, instruments: Sequence[Instrument]
) -> LinePhase:
    """Estimate the distance of the two directions' lines in one frame. Arguments as of ``solve_line_phase``."""
    return solve_line_phase(channels, start, fill_squared, instruments)[0]


def solve_line_phase(
    channels: Sequence[NDArray[Any]], start: float, fill_squared: float, instruments: Sequence[Instrument]
) -> tuple[LinePhase, ShiftEquations | None]:
    """Estimate the distance of the two directions' lines in one frame, and return the equations that determine it.

    Args:
        channels: pictures of the frame by detector, each of shape (rows, columns), float32.
        start: shift that is right to about a pixel [px].
        fill_squared: of the scan.
        instruments: own lines or reference, by detector.

    Returns:
        The phase, and the equations at it, added up over the detectors; their scores are those that the frame's own
        shift and tilt leave. None where the frame determines no phase.
    """
    shift, columns = start, channels[0].shape[1]
    for _ in range(MAX_ITERATIONS):
        each = [
            shift_equations(frame, shift, fill_squared, instrument)
            for frame, instrument in zip(channels, instruments, strict=True)
        ]
        equations = ShiftEquations(*(np.sum(parts, axis=0) for parts in zip(*each, strict=True)))
        score, slope = equations.score[:, :2], equations.slope[:, :2, :2]
        total = slope.sum(axis=0)
        if not total[0, 0] > 0.0 or not total[1, 1] > 0.0 or not np.linalg.det(total) > 0.0:
            return UNDETERMINED, None
        step = np.linalg.solve(total, score.sum(axis=0))
        shift += float(np.clip(step[0], -1.0, 1.0))
        if abs(shift - start) > MAX_SHIFT_FRACTION * columns:
            return UNDETERMINED, None
        if abs(step[0]) < CONVERGED_PX:
            left = equations.score - equations.slope[:, :, :2] @ step
            return LinePhase(shift, float(standard_errors(score, slope, step)[0])), equations._replace(score=left)
    return UNDETERMINED, None


def standard_errors(score: Array, slope: Array, step: Array) -> Array:
    """Standard errors from the scatter of the blocks' scores, shape (parameters,) [of ``step``].

    Each block is compared with the parameters that the other blocks give (jackknife), because a few blocks with most of
    the structure pull the parameters towards themselves.

    Source:
        MacKinnon and White 1985, "Some heteroskedasticity-consistent covariance matrix estimators" (HC3).
    """
    inverse = np.linalg.inv(slope.sum(axis=0))
    left = score - slope @ step
    others = np.eye(len(step)) - slope @ inverse
    left = (np.linalg.pinv(others) @ left[..., None])[..., 0]
    return np.sqrt(np.diag(inverse @ (left.T @ left) @ inverse.T))


def _smoothed_lines(lines: NDArray[np.float32], parity: int, smoothing: float) -> NDArray[np.float32]:
    """The picture of one direction alone, smoothed and interpolated to all lines by normalised convolution."""
    import cv2

    one, weight = np.zeros_like(lines), np.zeros((len(lines), 1), np.float32)
    one[parity::2], weight[parity::2] = lines[parity::2], 1.0
    reach = 2 * math.ceil(4.0 * smoothing) + 1
    border = cv2.BORDER_REFLECT_101  # keeps the parity of the lines
    smooth = cv2.GaussianBlur(one, (reach, reach), smoothing, borderType=border)
    return np.asarray(smooth / cv2.GaussianBlur(weight, (1, reach), smoothing, borderType=border), np.float32)


def gradients(picture: NDArray[np.float32]) -> Gradients:
    """Central differences of a picture along and across the lines; 0 at its border."""
    x, y = np.zeros_like(picture), np.zeros_like(picture)
    x[:, 1:-1] = 0.5 * (picture[:, 2:] - picture[:, :-2])
    y[1:-1] = 0.5 * (picture[2:] - picture[:-2])
    return Gradients(x, y)


@numba.njit(cache=True, nogil=True)
def _own_gradients(even, odd, mean_x, mean_y, other_x, other_y, own_y):  # type: ignore[no-untyped-def]
    """Central differences at each line: of its own direction, of the other direction, and their mean."""
    rows, columns = even.shape
    for i in range(1, rows - 1):
        own, other = (even, odd) if i % 2 == 0 else (odd, even)
        for j in range(1, columns - 1):
            own_x, other_x[i, j] = 0.5 * (own[i, j + 1] - own[i, j - 1]), 0.5 * (other[i, j + 1] - other[i, j - 1])
            own_y[i, j], other_y[i, j] = (
                0.5 * (own[i + 1, j] - own[i - 1, j]),
                0.5 * (other[i + 1, j] - other[i - 1, j]),
            )
            mean_x[i, j], mean_y[i, j] = 0.5 * (own_x + other_x[i, j]), 0.5 * (own_y[i, j] + other_y[i, j])
