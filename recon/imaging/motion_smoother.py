"""Smoothing of a slow plane motion whose position and velocity walk at random, with variances by maximum likelihood.

State of a block: position p and velocity w, with p' = p + w + noise of variance q1 and w' = w + noise of variance q2
(local linear trend; Harvey 1989, "Forecasting, structural time series models and the Kalman filter"). A block is
observed by the score and the information of its position, which may be singular. Variances are in units of the noise of
the observation, whose scale is eliminated from the likelihood.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from scanner.arrays import Array

INITIAL_SD_PX = 3.0
"""Standard deviation of the first position [px]. Its mean is not determined, so the value is of no effect."""

WALKS_PX = np.concatenate([[0.0], 10.0 ** np.arange(-4.5, 0.6, 0.5)])
"""Standard deviations of a step of the position from block to block that are compared [px]."""

VELOCITY_WALKS_PX = np.concatenate([[0.0], 10.0 ** np.arange(-6.0, -0.9, 0.5)])
"""Standard deviations of a step of the velocity that are compared [px per block]."""

MIN_SCALE = 1e-9
"""Lower bound on the scale of the noise, for the rounding errors of recordings without noise."""

JUMP_SD_PX = 5.0
"""Standard deviation of a jump [px]: half of the 10 pixels that are to be followed."""

MIN_JUMP_GAIN = 12.0
"""Gain of the log likelihood for which a jump is assumed: it outweighs the 10^5 blocks in which one may be."""

JUMP_WINDOW = 8
"""Blocks before and after a jump whose mean positions are compared to find candidates."""

CANDIDATES = 3
"""Largest candidates that are tried before the search for jumps ends."""

MAX_JUMPS = 50
"""Limit on the number of jumps, and so of the computing time."""


class SmoothedMotion(NamedTuple):
    """Smoothed motion.

    Attributes:
        position: of each block, shape (blocks, 2) [px].
        covariance: shape (blocks, 2, 2) [px²].
        gain: log likelihood of the chosen walk over a position at rest.
        scale: variance of the observations over that of their information.
        walk: numbers of the chosen ``WALKS_PX`` and ``VELOCITY_WALKS_PX``.
        jumps: blocks in which the position jumps.
    """

    position: Array
    covariance: Array
    gain: float
    scale: float
    walk: tuple[int, int]
    jumps: list[int]


class _Observations(NamedTuple):
    """Score around position 0 and information of each block, and the energy that free positions would explain."""

    linear: Array
    information: Array
    energy: float

    def log_likelihood(self, walk: tuple[int, int], jump_variance: Array) -> tuple[float, float]:
        """Log likelihood with the noise scale eliminated, and that scale."""
        steps, acceleration = WALKS_PX[walk[0]] ** 2 + jump_variance, VELOCITY_WALKS_PX[walk[1]] ** 2
        determinant, explained = _filter(self.linear, self.information, steps, acceleration, INITIAL_SD_PX**2)[:2]
        size = 2.0 * len(self.linear)
        # A scene without any structure has no energy; its scale is of no effect.
        scale = max((self.energy - explained) / size, MIN_SCALE) if self.energy > 0.0 else 1.0
        return -0.5 * determinant - 0.5 * size * np.log(scale), scale


def smooth_motion(
    score: Array, information: Array, around: Array, start: tuple[int, int] | None = None, jumps: bool = True
) -> SmoothedMotion:
    """Return the smoothed position under the most likely walk and jumps.

    Args:
        score: of each block around its position ``around``, shape (blocks, 2).
        information: shape (blocks, 2, 2).
        around: shape (blocks, 2) [px].
        start: numbers of a walk near the most likely one.
        jumps: whether jumps are searched.
    """
    linear = score + np.einsum("bij,bj->bi", information, around)
    energy = float(np.einsum("bi,bij,bj->", linear, np.linalg.pinv(information, rcond=1e-6, hermitian=True), linear))
    observed = _Observations(linear, information, energy)
    variance = np.zeros(len(linear))
    rest, _ = observed.log_likelihood((0, 0), variance)
    walk, best = _climb(observed, variance, start)
    found: list[int] = []
    if jumps:
        walk, best, variance, found = _find_jumps(observed, walk, best)
    scale = observed.log_likelihood(walk, variance)[1]
    steps, acceleration = WALKS_PX[walk[0]] ** 2 + variance, VELOCITY_WALKS_PX[walk[1]] ** 2
    filtered = _filter(linear, information, steps, acceleration, INITIAL_SD_PX**2)[2:]
    position, covariance = _smooth_back(*filtered)
    return SmoothedMotion(position, scale * covariance, best - rest, scale, walk, found)


def _climb(observed: _Observations, variance: Array, start: tuple[int, int] | None) -> tuple[tuple[int, int], float]:
    """The most likely walk and its log likelihood, from a start or from the best with one kind of noise."""
    known: dict[tuple[int, int], float] = {}

    def value(walk: tuple[int, int]) -> float:
        if walk not in known:
            known[walk] = observed.log_likelihood(walk, variance)[0]
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


def _find_jumps(
    observed: _Observations, walk: tuple[int, int], best: float
) -> tuple[tuple[int, int], float, Array, list[int]]:
    """Walk, log likelihood, variance of the steps, and jumps, found one after the other."""
    variance = np.zeros(len(observed.linear))
    found: list[int] = []
    free = np.ones(len(observed.linear), bool)
    while len(found) < MAX_JUMPS:
        size = np.where(free, _jump_sizes(observed), 0.0)
        for _ in range(CANDIDATES):
            block = int(np.argmax(size))
            trial = variance.copy()
            trial[block : block + 2] = JUMP_SD_PX**2  # a jump within a block is a step before and after it
            its_walk, likelihood = _climb(observed, trial, walk)
            near = slice(max(block - JUMP_WINDOW, 0), block + JUMP_WINDOW + 1)
            if likelihood > best + MIN_JUMP_GAIN:
                walk, best, variance, found = its_walk, likelihood, trial, [*found, block]
                free[near] = False
                break
            size[near] = 0.0
        else:
            break
    return walk, best, variance, found


def _jump_sizes(observed: _Observations) -> Array:
    """Difference of the mean positions after and before each block in the square of its noise, shape (blocks,)."""
    sums = [
        np.concatenate([np.zeros((1, *each.shape[1:])), np.cumsum(each, axis=0)])
        for each in (observed.linear, observed.information)
    ]
    blocks = len(observed.linear)
    first, stop = (
        np.maximum(np.arange(blocks) - JUMP_WINDOW, 0),
        np.minimum(np.arange(blocks) + 1 + JUMP_WINDOW, blocks),
    )
    before = [each[np.arange(blocks)] - each[first] for each in sums]
    after = [each[stop] - each[np.minimum(np.arange(blocks) + 1, blocks)] for each in sums]
    inverse = [np.linalg.pinv(side[1], rcond=1e-6, hermitian=True) for side in (before, after)]
    difference = np.einsum("bij,bj->bi", inverse[1], after[0]) - np.einsum("bij,bj->bi", inverse[0], before[0])
    precision = np.linalg.pinv(inverse[0] + inverse[1], rcond=1e-6, hermitian=True)
    size = np.einsum("bi,bij,bj->b", difference, precision, difference)
    size[: JUMP_WINDOW // 2] = size[blocks - JUMP_WINDOW // 2 :] = 0.0
    return np.asarray(size)


@njit(cache=True)
def _filter(linear, information, steps, acceleration, initial):  # type: ignore[no-untyped-def]
    """Forward pass: sum of log determinants, explained energy, means, covariances and predicted covariances."""
    blocks = linear.shape[0]
    means, covariances, predicted = np.zeros((blocks, 4)), np.zeros((blocks, 4, 4)), np.zeros((blocks, 4, 4))
    m, p = np.zeros(4), np.zeros((4, 4))
    p[0, 0] = p[1, 1] = initial
    f = np.eye(4)
    f[0, 2] = f[1, 3] = 1.0
    a, s = np.zeros((4, 4)), np.zeros(4)
    determinant, explained = 0.0, 0.0
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
        explained += 2.0 * (s @ m) - m @ (a @ m) + residual @ (post @ residual)
        # a and p have 2 x 2 blocks: the determinant is that of the upper left one
        determinant += np.log(innovation[0, 0] * innovation[1, 1] - innovation[0, 1] * innovation[1, 0])
        m = m + post @ residual
        p = post
        means[b], covariances[b] = m, p
    return determinant, explained, means, covariances, predicted


@njit(cache=True)
def _smooth_back(means, covariances, predicted):  # type: ignore[no-untyped-def]
    """Rauch-Tung-Striebel smoother: positions and their covariances."""
    blocks = means.shape[0]
    f = np.eye(4)
    f[0, 2] = f[1, 3] = 1.0
    m, p = means[-1].copy(), covariances[-1].copy()
    position, covariance = np.zeros((blocks, 2)), np.zeros((blocks, 2, 2))
    position[-1], covariance[-1] = m[:2], p[:2, :2]
    for b in range(blocks - 2, -1, -1):
        ahead = predicted[b + 1] + 1e-12 * np.eye(4)
        gain = covariances[b] @ f.T @ np.linalg.inv(ahead)
        m = means[b] + gain @ (m - f @ means[b])
        p = covariances[b] + gain @ (p - predicted[b + 1]) @ gain.T
        position[b], covariance[b] = m[:2], p[:2, :2]
    return position, covariance
