"""One picture under all samples of a scan: what of the samples no picture whatever explains.

A sample is light of the scene at the beam's place, bilinear between the cells of a grid, times a gain, through the
detector's first-order section:

    I_i = (H_lag [g · f(place(t - delay))])_i + noise.

The scene f is unknown and enters linearly, so that it is eliminated exactly: for given optics it solves a least-squares
problem whose only prior says how much neighbouring cells differ (Gauss-Markov, its size measured). What is left depends
on the optics alone, whose Gauss-Newton steps use columns with all that a picture can imitate projected out (variable
projection, Golub & Pereyra 1973). Two samples of one place at two times must agree; no sharpness is looked at.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from scanner.lowpass import lowpass, step_coefficients

Array = NDArray[np.float64]

TOLERANCE = 1e-4  # relative residual of the conjugate gradients


class Look(NamedTuple):
    """How the samples see the scene.

    Attributes:
        u, v: place in cells from the first cell's centre, shape (n,).
        gain: shape (n,).
        lag: time constant of the detector in samples, 0 for none.
    """

    u: Array
    v: Array
    gain: Array
    lag: float


class Noise(NamedTuple):
    """Variances: of a sample about its cell's mean, and of the difference between neighbouring cells."""

    scatter: float
    contrast: float


@dataclass(frozen=True)
class Seen:
    """The scene that fits best.

    Attributes:
        scene: shape (cells, cells).
        residual: of all samples, shape (n,).
        misfit: sum of squares of the weighted residual plus the scene's own penalty.
    """

    scene: Array
    residual: Array
    misfit: float


@numba.njit(cache=True, inline="always")
def _cell(place, cells):  # type: ignore[no-untyped-def]
    """Cell below a place and the share of the next; beyond its edge the scene goes on as it ends there."""
    place = min(max(place, 0.0), cells - 1.000001)
    low = int(place)
    return low, place - low


@numba.njit(cache=True, nogil=True)
def _gather(u, v, scene, out):  # type: ignore[no-untyped-def]
    height, width = scene.shape
    for i in range(u.size):
        c, x = _cell(u[i], width)
        r, y = _cell(v[i], height)
        above = (1.0 - x) * scene[r, c] + x * scene[r, c + 1]
        below = (1.0 - x) * scene[r + 1, c] + x * scene[r + 1, c + 1]
        out[i] = (1.0 - y) * above + y * below


@numba.njit(cache=True, nogil=True)
def _spread(u, v, values, out):  # type: ignore[no-untyped-def]
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
def _normal(u, v, weight, links):  # type: ignore[no-untyped-def]
    """Normal matrix of the look-up: of every cell with itself, right, down, down-right and down-left."""
    _, height, width = links.shape
    for i in range(u.size):
        c, x = _cell(u[i], width)
        r, y = _cell(v[i], height)
        w = weight[i]
        a, b, d, e = (1.0 - y) * (1.0 - x), (1.0 - y) * x, y * (1.0 - x), y * x
        links[0, r, c] += w * a * a
        links[0, r, c + 1] += w * b * b
        links[0, r + 1, c] += w * d * d
        links[0, r + 1, c + 1] += w * e * e
        links[1, r, c] += w * a * b
        links[1, r + 1, c] += w * d * e
        links[2, r, c] += w * a * d
        links[2, r, c + 1] += w * b * e
        links[3, r, c] += w * a * e
        links[4, r, c + 1] += w * b * d


@numba.njit(cache=True, nogil=True)
def _apply(links, scene, out):  # type: ignore[no-untyped-def]
    """The symmetric matrix that ``links`` (5, cells, cells) hold, times a scene; what leads off the grid holds 0."""
    height, width = scene.shape
    out[:] = 0.0
    for r in range(height):
        down = r + 1 if r + 1 < height else r
        for c in range(width):
            right, left = (c + 1 if c + 1 < width else c), (c - 1 if c else c)
            here = scene[r, c]
            a, b, d, e = links[1, r, c], links[2, r, c], links[3, r, c], links[4, r, c]
            out[r, c] += (
                links[0, r, c] * here + a * scene[r, right] + b * scene[down, c] + d * scene[down, right]
                + e * scene[down, left]
            )  # fmt: skip
            out[r, right] += a * here
            out[down, c] += b * here
            out[down, right] += d * here
            out[down, left] += e * here
    return out


@numba.njit(cache=True, nogil=True)
def _lowpass_transposed(signal, e, p, q):  # type: ignore[no-untyped-def]
    """Transpose of ``scanner.lowpass.lowpass`` from its own first value on, in place."""
    later = 0.0
    n = signal.size
    for i in range(n - 1, 0, -1):
        here = signal[i] + e * later
        signal[i] = q * here + p * later
        later = here
    signal[0] = signal[0] + (e + p) * later


def _lagged(values: Array, lag: float, pieces: NDArray[np.int64], transposed: bool = False) -> Array:
    """Through the detector, every piece of consecutive samples on its own; a copy."""
    if lag < 1e-3:
        return values
    out = values.copy()
    coefficients = step_coefficients(1.0 / (2 * np.pi * lag), 1.0)
    for first, stop in pairwise(pieces.tolist()):
        part = out[first:stop]
        if transposed:
            _lowpass_transposed(part, *coefficients)
        else:
            lowpass(part, *coefficients, part[0], part[0])
    return out


def light(look: Look, scene: Array, pieces: NDArray[np.int64]) -> Array:
    """Intensity of a scene (cells, cells) as the samples see it, shape (n,)."""
    out = np.empty(look.u.size)
    _gather(look.u, look.v, scene, out)
    return _lagged(out * look.gain, look.lag, pieces)


class Projector:
    """For given optics: what light a scene gives, and what scene explains given values best.

    Args:
        look: how the samples see.
        weight: of the samples, shape (n,); those held out have 0.
        contrast: variance between neighbouring cells.
        cells: of the grid, along each side.
        pieces: bounds of the runs of consecutive samples.
    """

    def __init__(self, look: Look, weight: Array, contrast: float, cells: int, pieces: NDArray[np.int64]):
        self.look, self.weight, self.pieces, self.cells = look, weight, pieces, cells
        self.links = np.zeros((5, cells, cells))
        _normal(look.u, look.v, weight * look.gain**2, self.links)
        prior = np.zeros_like(self.links)
        stiff = 1.0 / contrast
        prior[1, :, :-1], prior[2, :-1] = -stiff, -stiff
        prior[0, :, :-1] += stiff
        prior[0, :, 1:] += stiff
        prior[0, :-1] += stiff
        prior[0, 1:] += stiff
        prior[0] += 1e-9 * (self.links[0].mean() + stiff)
        self.prior = prior
        self.links += prior

    def light(self, scene: Array) -> Array:
        """Intensity of a scene, shape (n,)."""
        return light(self.look, scene, self.pieces)

    def _back(self, values: Array) -> Array:
        out = np.zeros((self.cells, self.cells))
        back = _lagged(self.weight * values, self.look.lag, self.pieces, transposed=True)
        _spread(self.look.u, self.look.v, back * self.look.gain, out)
        return out

    def _matrix(self, scene: Array) -> Array:
        if self.look.lag < 1e-3:
            return _apply(self.links, scene, np.empty_like(scene))
        return self._back(self.light(scene)) + _apply(self.prior, scene, np.empty_like(scene))

    def scene(self, values: Array, start: Array | None = None) -> Array:
        """The scene that explains ``values`` (n,) best, by conjugate gradients, shape (cells, cells)."""
        target = self._back(values)
        scene = np.zeros_like(target) if start is None else start.copy()
        left = target - self._matrix(scene) if start is not None else target.copy()
        scale = 1.0 / self.links[0]
        z = scale * left
        direction, power = z, float(np.vdot(left, z))
        goal = TOLERANCE**2 * float(np.vdot(target, scale * target))
        for _ in range(400):
            if power <= goal:
                break
            image = self._matrix(direction)
            step = power / float(np.vdot(direction, image))
            scene += step * direction
            left = left - step * image
            z = scale * left
            power, before = float(np.vdot(left, z)), power
            direction = z + power / before * direction
        return scene

    def unexplained(self, values: Array) -> Array:
        """``values`` (n,) less what the best scene makes of them."""
        return values - self.light(self.scene(values))

    def seen(self, values: Array, start: Array | None = None) -> Seen:
        """The best scene under measured ``values`` (n,)."""
        scene = self.scene(values, start)
        residual = values - self.light(scene)
        own = float(np.vdot(scene, _apply(self.prior, scene, np.empty_like(scene))))
        return Seen(scene, residual, float(self.weight @ residual**2) + own)
