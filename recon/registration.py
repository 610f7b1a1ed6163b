"""Forward against backward: the phase error that the picture itself shows.

A sample whose true angle is A sin(α + d) but which was mapped to A sin α is shown d·A cos α behind its true place on
forward sweeps (cos α > 0) and ahead of it on backward ones. So sweeps in opposite directions show one place 2 m d
pixels apart at the centre of the line, and less towards its edges. What is estimated here is the d of both axes for
which all samples of one place agree in the least-squares sense, whichever way the mirror went; no sharpness of a
picture is looked at and no truth is needed. An error of the amplitude moves both directions alike and leaves d alone.

The model of a sample is I = f(u + d c) + noise, of the unknown picture f at its true place, where the mapped place u
and its motion with the phase, c = A cos α, are known. f is eliminated by smoothing intensities and places alike
(Robinson 1988, "Root-N-consistent semiparametric regression"): with the normalised convolution S,

    I - S[I] = ∇f · ((u - S[u]) + d (c - S[c])) + noise,

which is solved for d by Gauss-Newton, the samples being remapped with each new d.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from recon.mapping import Grid
from scanner.channel import Channel
from scanner.errors import BadInput
from scanner.motion import Motion

Array = NDArray[np.float64]

AXES = ("x", "y")
SLICE = 25  # periods of the slower axis registered as one: some 15 are needed, and in a long one a drift goes on
REACH = math.radians(15.0)  # errors looked for, either way; the directions' pictures still share 2/3 of the field there
SEARCH_CELLS = 128  # of phase, across half a turn
RESOLUTION = math.pi / SEARCH_CELLS / 4  # of the search; what is known no better than that is not known
SIGMA = 1.5  # of the smoothing, in cells
SAMPLES_PER_CELL = 2.0  # with fewer, the pattern of the scan lines shows in the result
BLOCKS = 64  # of time in a slice, whose scores count as independent; in space they would share the scan's pattern
DAMPING = 0.7  # a smoothed picture's gradient is too flat by up to a half, so that the full step overshoots


class Estimate(NamedTuple):
    """A value with its standard error; (nan, inf) where the samples do not tell."""

    value: float
    sd: float


@dataclass(frozen=True)
class PhaseError:
    """How far the true phase is ahead of the assumed one.

    Attributes:
        time: middle of the slice, from the first sample on [s].
        x, y: value and standard error [rad].
    """

    time: float
    x: Estimate
    y: Estimate


class _Samples(NamedTuple):
    """Mapped place from the field's centre [px], its motion with the phase [px/rad], what was seen, which block."""

    x: Array
    y: Array
    dx: Array
    dy: Array
    intensity: Array
    block: NDArray[np.int64]


class _Comparison(NamedTuple):
    """Normal equations of the module's model, for each slice: score (slices, BLOCKS, 2), information (slices, 2, 2)."""

    score: Array
    information: Array


class _Fit(NamedTuple):
    """Phase errors, standard errors (inf: untold) and whether noise leaves a picture to see; each (slices, 2)."""

    value: Array
    sd: Array
    clear: NDArray[np.bool_]


def phase_error(
    theta_x: NDArray[Any],
    theta_y: NDArray[Any],
    intensity: NDArray[Any],
    rate: float,
    grid: Grid,
    amplitude_x: float | Array,
    amplitude_y: float | Array,
    slices: int = 1,
) -> list[PhaseError]:
    """Phase error of both axes in each slice of a scan, from the agreement of forward and backward sweeps.

    The slices share one picture, so that short ones, which leave most of the field unseen, have something to be
    compared with; within a slice the error counts as constant. A slice wants some 15 periods of the slower axis.

    Args:
        theta_x, theta_y: angles the samples were mapped with, shape (n,) [rad].
        intensity: shape (n,) or (n, detectors); detectors are averaged. Samples with NaN are left out.
        rate: samples a second [Hz].
        grid: the pixels; no detail finer than a pixel is compared.
        amplitude_x, amplitude_y: of the angles, a number or shape (n,) [rad].
        slices: equal parts in time.

    Returns:
        One entry a slice. An axis whose error the samples do not tell has value nan and sd inf.

    Raises:
        BadInput: shapes that do not belong together, or fewer than one slice.
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
        np.arange(n) * (slices * BLOCKS) // max(n, 1),
    ]
    seen = np.all([np.isfinite(column) for column in columns], axis=0)
    value, sd = _register(_Samples(*(column[seen] for column in columns)), grid, slices)
    times = (np.arange(slices) + 0.5) * n / slices / rate
    return [
        PhaseError(float(t), *(Estimate(float(v), float(s)) for v, s in zip(values, sds, strict=True)))
        for t, values, sds in zip(times, value, sd, strict=True)
    ]


def registered(motion: Motion, intensity: Channel, grid: Grid, parts: Iterable[tuple[int, int]]) -> list[PhaseError]:
    """Phase errors of a motion in slices of SLICE periods of its slower axis.

    Args:
        motion: its angles on the intensity's clock.
        parts: samples (first, stop) that share one picture.
    """
    x, y = (motion.axes[axis].angle for axis in AXES)
    found = []
    for first, stop in parts:
        time = x.start + np.arange(first, stop) / x.sample_rate
        swing_x, swing_y = (np.interp(time, motion.axes[axis].time, motion.axes[axis].amplitude) for axis in AXES)
        slices = max(1, round((stop - first) / x.sample_rate / slow_period(motion) / SLICE))
        places, seen = (x.read(first, stop), y.read(first, stop)), intensity.read(first, stop)
        errors = phase_error(*places, seen, x.sample_rate, grid, swing_x, swing_y, slices)
        found += [replace(error, time=error.time + first / x.sample_rate) for error in errors]
    return found


def slow_period(motion: Motion) -> float:
    """Of the slower axis [s]."""
    return 1.0 / min(float(np.median(axis.frequency)) for axis in motion.axes.values())


def quadrature(theta: Array, amplitude: float | Array) -> Array:
    """A cos α of the angle A sin α, shape (n,) [rad]: positive on forward sweeps, negative on backward ones."""
    if theta.size < 2:
        return np.zeros_like(theta)
    magnitude = np.abs(np.fft.rfft(np.nan_to_num(theta)))
    period = theta.size / (1 + int(np.argmax(magnitude[1:])))
    lag = max(round(period / 16), 1)  # long enough that noise does not turn the direction round
    index = np.arange(theta.size)
    rise = theta[np.minimum(index + lag, theta.size - 1)] - theta[np.maximum(index - lag, 0)]
    return np.sign(rise) * np.sqrt(np.maximum(np.square(amplitude) - np.square(theta), 0.0))


def _register(samples: _Samples, grid: Grid, slices: int) -> tuple[Array, Array]:
    """Phase errors and their standard errors, shape (slices, 2), of the cell size that tells each of them best."""
    part = samples.block // BLOCKS
    if np.bincount(part, minlength=slices).min() < 4 * BLOCKS:
        return np.full((slices, 2), np.nan), np.full((slices, 2), np.inf)
    start = np.array([_search(_Samples(*(column[part == s] for column in samples))) for s in range(slices)])
    best, limit = start, np.full_like(start, RESOLUTION)
    finest = max(1.0, math.sqrt(SAMPLES_PER_CELL * grid.width * grid.height / samples.x.size))
    clear = np.full_like(start, True, bool)
    for cell in (4 * finest, 2 * finest, finest):  # noise asks for large cells, fine detail for small ones
        fit = _solve(samples, best, grid, cell)
        clear &= fit.clear  # noise that hides the coarse detail hides the fine
        better = clear & (fit.sd < limit) & (np.abs(fit.value - start) < 2 * RESOLUTION)  # further is another minimum
        best, limit = np.where(better, fit.value, best), np.where(better, fit.sd, limit)
    told = limit < RESOLUTION
    return np.where(told, best, np.nan), np.where(told, limit, np.inf)


def _solve(samples: _Samples, error: Array, grid: Grid, cell: float) -> _Fit:
    """Gauss-Newton from ``error`` on, over cells of one size [px]."""
    to_cells = 0.5 * np.array([grid.width, grid.height]) / cell
    for _ in range(10):
        here = _compare(samples, error, grid, cell)
        step = DAMPING * (np.linalg.pinv(here.information) @ here.score.sum(1)[..., None])[..., 0]
        step = np.clip(step, -1 / to_cells, 1 / to_cells)  # the gradient reaches no further than a cell
        error = error + step
        if np.abs(step * to_cells).max() < 0.01:
            break
    here = _compare(samples, error, grid, cell)
    slope = np.empty_like(here.information)  # measured: noise in a gradient would count as a feature there
    for axis in range(2):
        shift = np.eye(2)[axis] / to_cells
        ahead, behind = (_compare(samples, error + s, grid, cell).score.sum(1) for s in (shift, -shift))
        slope[:, :, axis] = (behind - ahead) * to_cells[axis] / 2
    slope_of, expected = (np.diagonal(matrix, axis1=1, axis2=2) for matrix in (slope, here.information))
    # Noise in the gradient shows as a slope too small, detail lost in the smoothing as one too large, and what the
    # scan's pattern makes of the other axis's features as little information.
    clear = slope_of > 0.5 * expected
    told = clear & (slope_of < 2 * expected) & (expected > 0.05 * expected.max(1, keepdims=True))
    value, sd = error.copy(), np.full_like(error, np.inf)
    for s, axes in enumerate(told):
        if axes.any():
            shares = here.score[s][:, axes] @ np.linalg.pinv(slope[s][np.ix_(axes, axes)]).T
            value[s, axes] += shares.sum(0)
            sd[s, axes] = np.linalg.norm(shares, axis=0)
    return _Fit(value, sd, clear)


def _compare(samples: _Samples, error: Array, grid: Grid, cell: float) -> _Comparison:
    """Remap with the phase errors given, smooth over cells of one size [px], and compare each sample with its place."""
    import cv2

    shape = (math.ceil(grid.height / cell) + 1, math.ceil(grid.width / cell) + 1)
    fields = np.zeros((*shape, 8))  # sums of count, intensity, x, y, dx, dy; then the picture's gradient
    cos, sin = np.cos(error), np.sin(error)
    _splat(samples, cos, sin, cell, fields)
    size = 2 * math.ceil(3 * SIGMA) + 1
    cv2.GaussianBlur(fields, (size, size), SIGMA, dst=fields, borderType=cv2.BORDER_CONSTANT)
    counts, sums = fields[..., 0], fields[..., 1]
    picture = np.divide(sums, counts, out=np.full(shape, np.nan), where=counts > 1e-9)
    fields[..., 7], fields[..., 6] = np.nan_to_num(np.gradient(picture)) / cell
    score, information = np.zeros((len(error), BLOCKS, 2)), np.zeros((len(error), 2, 2))
    _accumulate_normal(samples, cos, sin, cell, fields, score, information)
    return _Comparison(score, information)


@numba.njit(cache=True, inline="always")
def _locate(place, motion, cos, sin, cell, n):  # type: ignore[no-untyped-def]
    """Corrected place, its motion, and the cell below it with the fraction of the way to the next; cell -1 outside."""
    corrected = place * cos + motion * sin
    position = corrected / cell + 0.5 * (n - 1)
    inside = 0.0 <= position < n - 1
    index = int(position) if inside else -1
    return corrected, motion * cos - place * sin, index, position - index


@numba.njit(cache=True, nogil=True)
def _splat(samples, cos, sin, cell, fields):  # type: ignore[no-untyped-def]
    """Spread count, intensity, place and motion of each sample over the four cells around its corrected place."""
    height, width, _ = fields.shape
    for i in range(samples.x.size):
        s = samples.block[i] // BLOCKS
        x, dx, column, right = _locate(samples.x[i], samples.dx[i], cos[s, 0], sin[s, 0], cell, width)
        y, dy, row, down = _locate(samples.y[i], samples.dy[i], cos[s, 1], sin[s, 1], cell, height)
        if column < 0 or row < 0:
            continue
        for r in range(2):
            for c in range(2):
                weight = (down if r else 1.0 - down) * (right if c else 1.0 - right)
                place = fields[row + r, column + c]
                place[0] += weight
                place[1] += weight * samples.intensity[i]
                place[2] += weight * x
                place[3] += weight * y
                place[4] += weight * dx
                place[5] += weight * dy


@numba.njit(cache=True, nogil=True)
def _accumulate_normal(samples, cos, sin, cell, fields, score, information):  # type: ignore[no-untyped-def]
    height, width, _ = fields.shape
    mean = np.empty(8)
    for i in range(samples.x.size):
        s, block = divmod(samples.block[i], BLOCKS)
        x, dx, column, right = _locate(samples.x[i], samples.dx[i], cos[s, 0], sin[s, 0], cell, width)
        y, dy, row, down = _locate(samples.y[i], samples.dy[i], cos[s, 1], sin[s, 1], cell, height)
        if column < 0 or row < 0:
            continue
        for k in range(8):
            above = (1.0 - right) * fields[row, column, k] + right * fields[row, column + 1, k]
            below = (1.0 - right) * fields[row + 1, column, k] + right * fields[row + 1, column + 1, k]
            mean[k] = (1.0 - down) * above + down * below
        count, slope_x, slope_y = mean[0], mean[6], mean[7]
        residual = samples.intensity[i] - mean[1] / count
        residual -= slope_x * (x - mean[2] / count) + slope_y * (y - mean[3] / count)
        z_x, z_y = slope_x * (dx - mean[4] / count), slope_y * (dy - mean[5] / count)
        score[s, block, 0] += z_x * residual
        score[s, block, 1] += z_y * residual
        information[s, 0, 0] += z_x * z_x
        information[s, 0, 1] += z_x * z_y
        information[s, 1, 0] += z_x * z_y
        information[s, 1, 1] += z_y * z_y


def _search(samples: _Samples) -> Array:
    """A coarse start: the phase errors (x, y) within REACH for which the pictures of opposite directions match best.

    Over arcsin(θ/A) instead of θ, forward and backward pictures are shifted against each other by 2 d everywhere, so
    that all errors can be tried at once: by the normalised correlation of the pairs of samples that come to lie in one
    cell (Padfield 2012, "Masked object registration in the Fourier domain").
    """
    from scipy.ndimage import gaussian_filter

    n = SEARCH_CELLS
    column, row = (
        np.minimum((np.arcsin(place / np.hypot(place, motion).max()) / math.pi + 0.5) * n, n - 1).astype(int)
        for place, motion in ((samples.x, samples.dx), (samples.y, samples.dy))
    )
    index = ((2 * (samples.dy > 0) + (samples.dx > 0)) * n + row) * n + column
    value = samples.intensity - samples.intensity.mean()

    def transforms(weights: Array) -> NDArray[np.complex128]:
        backward, forward_x, forward_y, forward = np.bincount(index, weights, 4 * n * n).reshape(4, n, n)
        # upside down, the mixed pair is shifted the same way as the other one
        pairs = [[forward, backward], [forward_x[::-1], forward_y[::-1]]]
        return np.asarray(np.fft.rfft2(pairs, (2 * n, 2 * n)))

    one, first, second = (transforms(value**power) for power in range(3))
    lag = np.fft.fftfreq(2 * n, 1 / (2 * n)) * math.pi / n
    allowed = np.abs(lag) <= 2 * REACH
    window = np.ix_(allowed, allowed)

    def correlate(a: NDArray[np.complex128], b: NDArray[np.complex128]) -> Array:
        sums = np.fft.irfft2((a[:, 0].conj() * b[:, 1]).sum(0), (2 * n, 2 * n))
        return np.asarray(gaussian_filter(sums, 0.7, mode="wrap")[window])  # few pairs fall on one lag alone

    pairs = np.maximum(correlate(one, one), 0.5)
    mean_a, mean_b, square_a, square_b, product = (
        correlate(*sums) / pairs for sums in ((first, one), (one, first), (second, one), (one, second), (first, first))
    )
    variance = np.maximum((square_a - mean_a**2) * (square_b - mean_b**2), np.finfo(float).tiny)
    match = (product - mean_a * mean_b) / np.sqrt(variance)
    best_y, best_x = np.unravel_index(np.argmax(match), match.shape)
    return np.array([lag[allowed][best_x], lag[allowed][best_y]]) / 2
