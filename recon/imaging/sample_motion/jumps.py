"""Moments at which the sample jumps, to single samples of the scan."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.imaging.sample_motion.block_equations import FOLDS, PARTS, fold_references
from recon.imaging.sample_motion.motion_smoother import SmoothedMotion
from recon.imaging.sample_motion.placed_samples import PlacedSamples
from recon.imaging.sample_motion.vibrations import vibration_shift
from scanner.arrays import Array

MARGIN_BLOCKS = 2
"""Blocks from that of a jump to those whose displacements hold before and after it: noise may show it a block away."""


class MotionKnots(NamedTuple):
    """Displacement that is linear between its knots: sample numbers (n,), displacement and sd (n, 2) [px]."""

    sample: Array
    shift: Array
    sd: Array


def place_jumps(
    samples: PlacedSamples, motion: SmoothedMotion, part_length: int, shape: tuple[int, int], width: float
) -> MotionKnots:
    """Return the motion with knots in the middles of blocks, and two knots at each jump in place of those around it.

    Where the sample vibrates, there are knots in the middles of the parts of the blocks too.

    The jump lies where the squared residuals under the displacement before it, up to there, and under that after it,
    from there on, have the least sum.

    Args:
        samples: of the scan.
        motion: of the sample.
        part_length, shape, width: as for :func:`recon.imaging.sample_motion.block_equations.block_equations`.
    """
    blocks, length = len(motion.position), part_length * PARTS
    middle = (np.arange(blocks) + 0.5) * length - 0.5
    parts: Array = np.asarray((np.arange(blocks * PARTS) + 0.5) * part_length - 0.5, np.float64)
    vibration = vibration_shift(motion.vibrations, blocks)
    inside = sorted(block for block in motion.jumps if MARGIN_BLOCKS <= block < blocks - MARGIN_BLOCKS)
    references = (
        fold_references(samples, motion.shift, part_length, shape, width) if inside else np.empty(0, np.float32)
    )
    keep, knots, places = np.ones(blocks, bool), [], []
    for block in inside:
        before, after = block - MARGIN_BLOCKS, block + MARGIN_BLOCKS
        part = np.arange((before + 1) * length, after * length)
        fold = part // length % FOLDS
        own = _interpolated(part, parts, vibration)
        errors = [_residuals(samples, part, motion.position[at] + own, references, fold) ** 2 for at in (before, after)]
        change = np.nan_to_num(errors[0] - errors[1])
        misfit = np.concatenate([[0.0], np.cumsum(change)])
        least = np.flatnonzero(misfit == misfit.min())  # several where samples lie outside the picture
        place = part[0] + int(least[[0, -1]].mean())
        keep[before + 1 : after] = False
        knots += [before, after]
        places += [place - 1.0, float(place)]
    at = np.concatenate([middle[keep], places])
    source = np.concatenate([np.flatnonzero(keep), np.array(knots, int)])
    order = np.argsort(at, kind="stable")
    variance = np.einsum("bpii->bi", motion.covariance()) / PARTS
    walk = MotionKnots(at[order], motion.position[source[order]], np.sqrt(variance)[source[order]])
    if not motion.vibrations:
        return walk
    sample = np.union1d(walk.sample, parts)
    shift = _interpolated(sample, walk.sample, walk.shift) + _interpolated(sample, parts, vibration)
    return MotionKnots(sample, shift, _interpolated(sample, walk.sample, walk.sd))


def _interpolated(sample: NDArray[Any], knots: Array, values: Array) -> Array:
    """Values at samples, linear between knots, shape (n, 2)."""
    return np.column_stack([np.interp(sample, knots, each) for each in values.T])


def _residuals(
    samples: PlacedSamples,
    part: NDArray[np.int64],
    shift: Array,
    references: NDArray[np.float32],
    fold: NDArray[np.int64],
) -> Array:
    """Intensity less the picture of the other blocks under displacements (n, 2) [px]; NaN where it is not known."""
    x, y = (place - by for place, by in zip(samples.places(part), shift.T, strict=True))
    height, width = references.shape[1:3]
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    row, column = np.where(inside, y, 0).astype(int), np.where(inside, x, 0).astype(int)
    value, cx, cy, gx, gy = np.moveaxis(references[fold, row, column], -1, 0)
    residual = samples.value[part] - value - gx * (x - cx) - gy * (y - cy)
    return np.where(inside, residual, np.nan)
