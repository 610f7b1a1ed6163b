"""Likelihood of a plane motion whose position and velocity walk at random, beside displacements of known form.

State of a block: position p and velocity w, with p' = p + w + noise of variance q1 and w' = w + noise of variance q2
(local linear trend; Harvey 1989, "Forecasting, structural time series models and the Kalman filter"). The displacement
within a block is p + X β, with columns X over its ``SHAPES``. A block is observed by score and information, which may
be singular. The filter is linear, so the columns pass through it like the observations, and β follows by generalised
least squares (de Jong 1991, "The diffuse Kalman filter"). Variances are in units of the noise of the observation, whose
scale is eliminated from the likelihood.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from recon.imaging.sample_motion.block_equations import BlockEquations, by_shape
from scanner.arrays import Array

INITIAL_SD_PX = 3.0
"""Standard deviation of the first position [px]. Its mean is not determined, so the value is of no effect."""

WALKS_PX = np.concatenate([[0.0], 10.0 ** np.arange(-4.5, 0.6, 0.5)])
"""Standard deviations of a step of the position from block to block that are compared [px]."""

VELOCITY_WALKS_PX = np.concatenate([[0.0], 10.0 ** np.arange(-6.0, -0.9, 0.5)])
"""Standard deviations of a step of the velocity that are compared [px per block]."""

MIN_SCALE = 1e-9
"""Lower bound on the scale of the noise, for the rounding errors of recordings without noise."""

MIN_RELATIVE_INFORMATION = 1e-6
"""Information on a combination of a block's displacements, over that of the best one, below which it has none."""


class Data(NamedTuple):
    """Observed displacements of all blocks, weighted by their information.

    Attributes:
        weighted: x and y of each of ``SHAPES``, shape (blocks, 6) [1/px].
        information: shape (blocks, 6, 6) [1/px²].
        energy: reduction of the squared residuals, over their variance, by free displacements of all blocks.
        freedom: number of combinations of the displacements that are observed.
    """

    weighted: Array
    information: Array
    energy: float
    freedom: int

    @classmethod
    def around(cls, equations: BlockEquations, shift: Array) -> Data:
        """Return the data of equations around displacements, shape (blocks, 6) [px]."""
        weighted = equations.score + np.einsum("bij,bj->bi", equations.information, shift)
        values, vectors = np.linalg.eigh(equations.information)
        used = values > np.maximum(MIN_RELATIVE_INFORMATION * values[:, -1:], 0.0)
        along = np.einsum("bij,bi->bj", vectors, weighted)
        energy = np.sum(np.divide(along**2, values, out=np.zeros_like(values), where=used))
        return cls(weighted, equations.information, float(energy), max(int(used.sum()), 1))


class MotionUnderWalk(NamedTuple):
    """Motion of the sample under a walk.

    Attributes:
        position: of the walk in each block, shape (blocks, 2) [px].
        position_covariance: for known β, shape (blocks, 2, 2) [px²].
        displacement: of each part, shape (blocks, PARTS, 2) [px].
        coefficients: β, shape (k,).
        inverse: of the normal equations of β, shape (k, k).
        free: displacement of each part by β with the walk's response, shape (blocks, PARTS, 2, k).
        scale: variance of the observations over that of their information.
    """

    position: Array
    position_covariance: Array
    displacement: Array
    coefficients: Array
    inverse: Array
    free: Array
    scale: float


class Observations(NamedTuple):
    """Data and columns for the walk, and the normal equations of β before it.

    Attributes:
        columns: X by part, shape (blocks, PARTS, 2, k).
        linear: weighted data and columns of the constant displacement, shape (blocks, 2, 1 + k).
        information: on the constant displacement, shape (blocks, 2, 2) [1/px²].
        normal: products of data and columns, shape (1 + k, 1 + k); the first is the energy of the data.
        precision: of the normal prior of β around 0, shape (k,).
        freedom: number of observed displacements.
    """

    columns: Array
    linear: Array
    information: Array
    normal: Array
    precision: Array
    freedom: int

    @classmethod
    def of(cls, data: Data, columns: Array, precision: Array) -> Observations:
        """Return the observations for columns, shape (blocks, PARTS, 2, k), whose β has a prior."""
        count = columns.shape[-1]
        shapes = by_shape(columns)
        weighted = np.concatenate([data.weighted[..., None], data.information @ shapes], axis=-1)
        normal = np.empty((1 + count, 1 + count))
        normal[0, 0] = data.energy
        normal[1:] = np.tensordot(shapes, weighted, axes=((0, 1), (0, 1)))
        normal[0, 1:] = normal[1:, 0]
        linear, information = (np.ascontiguousarray(each) for each in (weighted[:, :2], data.information[:, :2, :2]))
        return cls(columns, linear, information, normal, precision, data.freedom)

    def log_likelihood(self, walk: tuple[int, int], jump_variance: Array) -> float:
        """Log likelihood with β and the noise scale eliminated."""
        determinant, explained = self._filtered(walk, jump_variance)[:2]
        return float(-0.5 * determinant - 0.5 * self.freedom * np.log(self._solved(explained)[1]))

    def coefficients(self, walk: tuple[int, int], jump_variance: Array) -> Array:
        """β, shape (k,)."""
        return self._solved(self._filtered(walk, jump_variance)[1])[0]

    def smoothed(self, walk: tuple[int, int], jump_variance: Array) -> MotionUnderWalk:
        """Return the motion under a walk."""
        _, explained, means, covariances, predicted = self._filtered(walk, jump_variance)
        coefficients, scale, inverse = self._solved(explained)
        smoothed, covariance = _smooth_back(means, covariances, predicted)
        position = smoothed[..., 0] - smoothed[..., 1:] @ coefficients
        free = self.columns - smoothed[:, None, :, 1:]
        displacement = position[:, None] + self.columns @ coefficients
        return MotionUnderWalk(position, scale * covariance, displacement, coefficients, inverse, free, scale)

    def _filtered(self, walk: tuple[int, int], jump_variance: Array) -> tuple[float, Array, Array, Array, Array]:
        steps, acceleration = WALKS_PX[walk[0]] ** 2 + jump_variance, VELOCITY_WALKS_PX[walk[1]] ** 2
        return _filter(self.linear, self.information, steps, acceleration, INITIAL_SD_PX**2)

    def _solved(self, explained: Array) -> tuple[Array, float, Array]:
        """β, the scale of the noise, and the inverse of the normal equations of β."""
        normal = self.normal - explained
        inverse = np.linalg.inv(normal[1:, 1:] + np.diag(self.precision))
        coefficients = inverse @ normal[1:, 0]
        # A scene without any structure has no energy; its scale is of no effect.
        left = normal[0, 0] - normal[0, 1:] @ coefficients
        scale = max(left / self.freedom, MIN_SCALE) if self.normal[0, 0] > 0.0 else 1.0
        return coefficients, float(scale), np.asarray(inverse, np.float64)


def climb(observed: Observations, variance: Array, start: tuple[int, int] | None) -> tuple[tuple[int, int], float]:
    """Return the most likely walk and its log likelihood, from a start or from the best with one kind of noise."""
    known: dict[tuple[int, int], float] = {}

    def value(walk: tuple[int, int]) -> float:
        if walk not in known:
            known[walk] = observed.log_likelihood(walk, variance)
        return known[walk]

    lines = [(i, 0) for i in range(WALKS_PX.size)] + [(0, j) for j in range(1, VELOCITY_WALKS_PX.size)]
    best = start or max(lines, key=value)
    while True:
        around = [(best[0] + i, best[1] + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        inside = [walk for walk in around if 0 <= walk[0] < WALKS_PX.size and 0 <= walk[1] < VELOCITY_WALKS_PX.size]
        better = max(inside, key=value)
        if value(better) <= value(best):
            return best, value(best)
        best = better


@njit(cache=True)
def _filter(linear, information, steps, acceleration, initial):  # type: ignore[no-untyped-def]
    """Forward pass: sum of log determinants, explained products, means, covariances and predicted covariances."""
    blocks, columns = linear.shape[0], linear.shape[2]
    means, covariances = np.zeros((blocks, 4, columns)), np.zeros((blocks, 4, 4))
    predicted = np.zeros((blocks, 4, 4))
    m, p = np.zeros((4, columns)), np.zeros((4, 4))
    p[0, 0] = p[1, 1] = initial
    f = np.eye(4)
    f[0, 2] = f[1, 3] = 1.0
    a, s = np.zeros((4, 4)), np.zeros((4, columns))
    determinant, explained = 0.0, np.zeros((columns, columns))
    for b in range(blocks):
        if b:
            m = f @ m
            p = f @ p @ f.T
            p[0, 0] += steps[b]
            p[1, 1] += steps[b]
            p[2, 2] += acceleration
            p[3, 3] += acceleration
        predicted[b] = p
        a[:2, :2] = information[b]
        innovation = np.eye(4) + a @ p
        post = p @ np.linalg.inv(innovation)
        post = 0.5 * (post + post.T)
        s[:2] = linear[b]
        residual = s - a @ m
        explained += s.T @ m + m.T @ residual + residual.T @ (post @ residual)
        # a and p have 2 x 2 blocks: the determinant is that of the upper left one
        determinant += np.log(innovation[0, 0] * innovation[1, 1] - innovation[0, 1] * innovation[1, 0])
        m = m + post @ residual
        p = post
        means[b], covariances[b] = m, p
    return determinant, explained, means, covariances, predicted


@njit(cache=True)
def _smooth_back(means, covariances, predicted):  # type: ignore[no-untyped-def]
    """Rauch-Tung-Striebel smoother: positions, shape (blocks, 2, columns), and their covariances."""
    blocks, _, columns = means.shape
    f = np.eye(4)
    f[0, 2] = f[1, 3] = 1.0
    m, p = means[-1].copy(), covariances[-1].copy()
    position, covariance = np.zeros((blocks, 2, columns)), np.zeros((blocks, 2, 2))
    position[-1], covariance[-1] = m[:2], p[:2, :2]
    for b in range(blocks - 2, -1, -1):
        ahead = predicted[b + 1] + 1e-12 * np.eye(4)
        gain = covariances[b] @ f.T @ np.linalg.inv(ahead)
        m = means[b] + gain @ (m - f @ means[b])
        p = covariances[b] + gain @ (p - predicted[b + 1]) @ gain.T
        position[b], covariance[b] = m[:2], p[:2, :2]
    return position, covariance
