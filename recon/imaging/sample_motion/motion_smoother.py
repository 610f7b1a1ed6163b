"""Smoothing of a plane motion: a walk, jumps at single blocks, and vibrations, by maximum likelihood."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from recon.imaging.sample_motion.block_equations import PARTS, BlockEquations, by_shape
from recon.imaging.sample_motion.motion_filter import Data, MotionUnderWalk, Observations, climb
from recon.imaging.sample_motion.vibrations import (
    Vibration,
    coefficient_covariance,
    find_vibrations,
    observe,
    refine_vibrations,
    vibration_shift,
)
from scanner.arrays import Array

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
        position: of each block without vibrations, shape (blocks, 2) [px].
        vibrations: that were found.
        motion: under the walk, with the variances that belong to the positions.
        equations: that were smoothed.
        around: displacement of each part in the equations, shape (blocks, PARTS, 2) [px].
        gain: log likelihood of the motion over a position at rest.
        walk: numbers of the chosen ``WALKS_PX`` and ``VELOCITY_WALKS_PX``.
        jumps: blocks in which the position jumps.
    """

    position: Array
    vibrations: list[Vibration]
    motion: MotionUnderWalk
    equations: BlockEquations
    around: Array
    gain: float
    walk: tuple[int, int]
    jumps: list[int]

    @property
    def shift(self) -> Array:
        """Displacement of each part, shape (blocks * PARTS, 2) [px]; without vibrations linear between blocks."""
        return part_shift(self.position, self.vibrations)

    def covariance(self) -> Array:
        """Covariance of the displacement of each part, shape (blocks, PARTS, 2, 2) [px²]."""
        free = self.motion.free
        covariance = np.repeat(self.motion.position_covariance[:, None], PARTS, axis=1)
        if self.vibrations:
            own = coefficient_covariance(self.equations, self.motion, self.around)
            covariance += np.einsum("bpik,kl,bpjl->bpij", free, own, free, optimize=True)
        return covariance


def part_shift(position: Array, vibrations: Sequence[Vibration]) -> Array:
    """Return the displacement of each part from positions of the blocks and vibrations, (blocks * PARTS, 2) [px]."""
    blocks = len(position)
    part = (np.arange(blocks * PARTS) + 0.5) / PARTS - 0.5
    walk = np.column_stack([np.interp(part, np.arange(blocks), each) for each in position.T])
    return walk + vibration_shift(vibrations, blocks)


def smooth_motion(
    equations: BlockEquations,
    position: Array,
    vibrations: Sequence[Vibration] = (),
    start: SmoothedMotion | None = None,
    jumps: bool = True,
    excluded: Sequence[float] = (),
) -> SmoothedMotion:
    """Return the smoothed position under the most likely walk, vibrations and jumps.

    Args:
        equations: around ``position`` and ``vibrations``.
        position: of each block, shape (blocks, 2) [px].
        vibrations: around which the equations are.
        start: a motion near the most likely one.
        jumps: whether jumps are searched.
        excluded: frequencies of vibrations that are not searched [cycles per block].
    """
    blocks = len(position)
    around = position[:, None] + vibration_shift(vibrations, blocks).reshape(blocks, PARTS, 2)
    data = Data.around(equations, by_shape(around))
    variance = _step_variance(blocks, start.jumps if start else [])
    rest = observe(data, []).log_likelihood((0, 0), np.zeros(blocks))
    walk, found, best = find_vibrations(equations, around, variance, start.walk if start else None, excluded)
    observed = observe(data, found)
    steps: list[int] = []
    if jumps:
        walk, best, variance, steps = _find_jumps(observed, walk)
    found = refine_vibrations(data, found, walk, variance)
    motion = observe(data, found).smoothed(walk, variance)
    return SmoothedMotion(motion.position, found, motion, equations, around, best - rest, walk, steps)


def _step_variance(blocks: int, jumps: Sequence[int]) -> Array:
    """Variance of the jump before each block, shape (blocks,) [px²]; one within a block is a step before and after."""
    variance = np.zeros(blocks)
    for block in jumps:
        variance[block : block + 2] = JUMP_SD_PX**2
    return variance


def _find_jumps(observed: Observations, walk: tuple[int, int]) -> tuple[tuple[int, int], float, Array, list[int]]:
    """Walk, log likelihood, variance of the steps, and jumps, found one after the other."""
    blocks = len(observed.linear)
    found: list[int] = []
    variance = _step_variance(blocks, found)
    walk, best = climb(observed, variance, walk)
    free = np.ones(blocks, bool)
    while len(found) < MAX_JUMPS:
        size = np.where(free, _jump_sizes(observed, observed.coefficients(walk, variance)), 0.0)
        for _ in range(CANDIDATES):
            block = int(np.argmax(size))
            trial = _step_variance(blocks, [*found, block])
            its_walk, likelihood = climb(observed, trial, walk)
            near = slice(max(block - JUMP_WINDOW, 0), block + JUMP_WINDOW + 1)
            if likelihood > best + MIN_JUMP_GAIN:
                walk, best, variance, found = its_walk, likelihood, trial, [*found, block]
                free[near] = False
                break
            size[near] = 0.0
        else:
            break
    return walk, best, variance, found


def _jump_sizes(observed: Observations, coefficients: Array) -> Array:
    """Difference of the mean positions after and before each block in the square of its noise, shape (blocks,)."""
    linear = observed.linear[..., 0] - observed.linear[..., 1:] @ coefficients
    sums = [
        np.concatenate([np.zeros((1, *each.shape[1:])), np.cumsum(each, axis=0)])
        for each in (linear, observed.information)
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
