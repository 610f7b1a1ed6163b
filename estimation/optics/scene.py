"""The scene that explains the samples of a scan best, and the part of the samples that no scene explains.

A sample is the scene at the beam's position, bilinear between the cells of a grid, times a gain, through the detector's
first-order low-pass:

    I_i = (H_lag [g · f(position(t - delay))])_i + noise.

The scene f is unknown and enters linearly, so it is eliminated exactly: for given optics it solves a least-squares
problem whose only prior is the variance of the difference between neighbouring cells (a Gauss-Markov field), which is
measured. The residual depends on the optics alone. Gauss-Newton steps of the optics use derivatives from which all that
a different scene would also cause is projected out (variable projection, Golub & Pereyra 1973). The criterion is that
two samples of one place at two times agree; the sharpness of the picture does not enter.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from scanner.arrays import Array
from scanner.lowpass import run_section, section_coefficients

CG_TOLERANCE = 1e-4
"""Relative residual at which the conjugate gradients stop: the misfit is then right to far less than one unit of
chi-square."""

MAX_CG_ITERATIONS = 400
"""Bound on the conjugate gradients, against a loop without end."""

MIN_LAG_SAMPLES = 1e-3
"""Detector time constant [samples] below which the low-pass changes no sample by more than 1e-3 and is left out."""

ABSOLUTE_LEVEL_PRECISION = 1e-9
"""Precision of a cell's absolute value, relative to the mean diagonal: makes the normal matrix regular for cells that
no sample and no neighbour determines."""


class SamplingGeometry(NamedTuple):
    """Where in the scene each sample was taken, and how it was attenuated and smoothed.

    Attributes:
        u, v: column and row from the first cell's centre, shape (n,) [cells].
        gain: of the light, shape (n,).
        lag: time constant of the detector [samples], 0 for none.
    """

    u: Array
    v: Array
    gain: Array
    lag: float


class CellVariances(NamedTuple):
    """Variances of the intensity, in its unit squared.

    Attributes:
        noise: of a sample about the mean of its cell.
        prior: of the difference between neighbouring cells, which is the scene's prior.
    """

    noise: float
    prior: float


@dataclass(frozen=True)
class SceneFit:
    """The scene that fits given intensities best.

    Attributes:
        scene: shape (cells, cells).
        residual: measured minus rendered intensity of all samples, shape (n,).
        penalty: part of the misfit that the scene's prior adds.
    """

    scene: Array
    residual: Array
    penalty: float


@numba.njit(cache=True, inline="always")
def _cell(position, cells):  # type: ignore[no-untyped-def]
    """Index of the cell below a position and the weight of the next one; the scene is constant beyond its edge."""
    inside = min(max(position, 0.0), cells - 1.000001)
    low = int(inside)
    return low, inside - low


@numba.njit(cache=True, nogil=True)
def _interpolate(u, v, scene, out):  # type: ignore[no-untyped-def]
    height, width = scene.shape
    for i in range(u.size):
        c, x = _cell(u[i], width)
        r, y = _cell(v[i], height)
        above = (1.0 - x) * scene[r, c] + x * scene[r, c + 1]
        below = (1.0 - x) * scene[r + 1, c] + x * scene[r + 1, c + 1]
        out[i] = (1.0 - y) * above + y * below


@numba.njit(cache=True, nogil=True)
def _interpolate_transposed(u, v, values, out):  # type: ignore[no-untyped-def]
    height, width = out.shape
    for i in range(u.size):
        c, x = _cell(u[i], width)
        r, y = _cell(v[i], height)
        value = values[i]
        out[r, c] += (1.0 - y) * (1.0 - x) * value
        out[r, c + 1] += (1.0 - y) * x * value
        out[r + 1, c] += y * (1.0 - x) * value
        out[r + 1, c + 1] += y * x * value


@numba.njit(cache=True, nogil=True)
def _add_normal_matrix(u, v, weight, stencil):  # type: ignore[no-untyped-def]
    """Add the normal matrix of the interpolation to ``stencil``: each cell with itself and its neighbours to the
    right, below, below right and below left."""
    _, height, width = stencil.shape
    for i in range(u.size):
        c, x = _cell(u[i], width)
        r, y = _cell(v[i], height)
        w = weight[i]
        a, b, d, e = (1.0 - y) * (1.0 - x), (1.0 - y) * x, y * (1.0 - x), y * x
        stencil[0, r, c] += w * a * a
        stencil[0, r, c + 1] += w * b * b
        stencil[0, r + 1, c] += w * d * d
        stencil[0, r + 1, c + 1] += w * e * e
        stencil[1, r, c] += w * a * b
        stencil[1, r + 1, c] += w * d * e
        stencil[2, r, c] += w * a * d
        stencil[2, r, c + 1] += w * b * e
        stencil[3, r, c] += w * a * e
        stencil[4, r, c + 1] += w * b * d


@numba.njit(cache=True, nogil=True)
def _multiply(stencil, scene, out):  # type: ignore[no-untyped-def]
    """Product of the symmetric matrix in ``stencil`` (5, cells, cells) and a scene; entries beyond the grid are 0."""
    height, width = scene.shape
    out[:] = 0.0
    for r in range(height):
        down = r + 1 if r + 1 < height else r
        for c in range(width):
            right, left = (c + 1 if c + 1 < width else c), (c - 1 if c else c)
            here = scene[r, c]
            a, b, d, e = stencil[1, r, c], stencil[2, r, c], stencil[3, r, c], stencil[4, r, c]
            out[r, c] += (
                stencil[0, r, c] * here + a * scene[r, right] + b * scene[down, c] + d * scene[down, right]
                + e * scene[down, left]
            )  # fmt: skip
            out[r, right] += a * here
            out[down, c] += b * here
            out[down, right] += d * here
            out[down, left] += e * here
    return out


@numba.njit(cache=True, nogil=True)
def _lowpass_transposed(signal, e, p, q):  # type: ignore[no-untyped-def]
    """Transpose of ``scanner.lowpass.run_section`` from its own first value on, in place."""
    later = 0.0
    n = signal.size
    for i in range(n - 1, 0, -1):
        here = signal[i] + e * later
        signal[i] = q * here + p * later
        later = here
    signal[0] = signal[0] + (e + p) * later


def _apply_detector(values: Array, lag: float, run_bounds: NDArray[np.int64], transposed: bool = False) -> Array:
    """The detector's low-pass or its transpose, applied to each run of consecutive samples alone; a copy."""
    if lag < MIN_LAG_SAMPLES:
        return values
    out = values.copy()
    coefficients = section_coefficients(1.0 / (2 * np.pi * lag), 1.0)
    for first, stop in pairwise(run_bounds.tolist()):
        part = out[first:stop]
        if transposed:
            _lowpass_transposed(part, *coefficients)
        else:
            run_section(part, *coefficients, part[0], part[0])
    return out


def render_intensity(geometry: SamplingGeometry, scene: Array, run_bounds: NDArray[np.int64]) -> Array:
    """Intensity of all samples of a scene.

    Args:
        scene: shape (cells, cells).
        run_bounds: first sample of each run of consecutive samples, and the number of samples, shape (runs + 1,).

    Returns:
        shape (n,), in the scene's unit.
    """
    out = np.empty(geometry.u.size)
    _interpolate(geometry.u, geometry.v, scene, out)
    return _apply_detector(out * geometry.gain, geometry.lag, run_bounds)


class SceneSolver:
    """The linear least-squares problem of the scene for given optics.

    Args:
        geometry: position, gain and lag of the samples.
        weight: inverse variance of the samples, 0 for those that are not fitted, shape (n,).
        prior_variance: of the difference between neighbouring cells.
        cells: along each side of the grid.
        run_bounds: as for ``render_intensity``.
    """

    def __init__(
        self,
        geometry: SamplingGeometry,
        weight: Array,
        prior_variance: float,
        cells: int,
        run_bounds: NDArray[np.int64],
    ):
        self.geometry, self.weight, self.run_bounds, self.cells = geometry, weight, run_bounds, cells
        self.stencil = np.zeros((5, cells, cells))
        _add_normal_matrix(geometry.u, geometry.v, weight * geometry.gain**2, self.stencil)
        prior = np.zeros_like(self.stencil)
        precision = 1.0 / prior_variance
        prior[1, :, :-1], prior[2, :-1] = -precision, -precision
        prior[0, :, :-1] += precision
        prior[0, :, 1:] += precision
        prior[0, :-1] += precision
        prior[0, 1:] += precision
        prior[0] += ABSOLUTE_LEVEL_PRECISION * (self.stencil[0].mean() + precision)
        self.prior = prior
        self.stencil += prior

    def render(self, scene: Array) -> Array:
        """Intensity of a scene, shape (n,)."""
        return render_intensity(self.geometry, scene, self.run_bounds)

    def _render_transposed(self, values: Array) -> Array:
        out = np.zeros((self.cells, self.cells))
        undetected = _apply_detector(self.weight * values, self.geometry.lag, self.run_bounds, transposed=True)
        _interpolate_transposed(self.geometry.u, self.geometry.v, undetected * self.geometry.gain, out)
        return out

    def _multiply_normal_matrix(self, scene: Array) -> Array:
        if self.geometry.lag < MIN_LAG_SAMPLES:
            return _multiply(self.stencil, scene, np.empty_like(scene))
        return self._render_transposed(self.render(scene)) + _multiply(self.prior, scene, np.empty_like(scene))

    def solve(self, values: Array, start: Array | None = None) -> Array:
        """The scene that explains ``values`` (n,) best, shape (cells, cells), by preconditioned conjugate gradients."""
        target = self._render_transposed(values)
        scene = np.zeros_like(target) if start is None else start.copy()
        remainder = target - self._multiply_normal_matrix(scene) if start is not None else target.copy()
        preconditioner = 1.0 / self.stencil[0]
        z = preconditioner * remainder
        direction, power = z, float(np.vdot(remainder, z))
        goal = CG_TOLERANCE**2 * float(np.vdot(target, preconditioner * target))
        for _ in range(MAX_CG_ITERATIONS):
            if power <= goal:
                break
            image = self._multiply_normal_matrix(direction)
            step = power / float(np.vdot(direction, image))
            scene += step * direction
            remainder = remainder - step * image
            z = preconditioner * remainder
            power, previous = float(np.vdot(remainder, z)), power
            direction = z + power / previous * direction
        return scene

    def project_out_scene(self, values: Array) -> Array:
        """``values`` (n,) minus the intensities of the scene that explains them best."""
        return values - self.render(self.solve(values))

    def fit(self, values: Array, start: Array | None = None) -> SceneFit:
        """The best scene for measured ``values`` (n,), iterated from the scene ``start``."""
        scene = self.solve(values, start)
        penalty = float(np.vdot(scene, _multiply(self.prior, scene, np.empty_like(scene))))
        return SceneFit(scene, values - self.render(scene), penalty)
