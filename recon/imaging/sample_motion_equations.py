"""Normal equations of the sample's translation in short blocks of a scan, against the picture of the other blocks.

A sample of the scene f at place x, which is mapped with the translation u of its block, has the intensity

    I = f(x - u) + noise,        I - S[I] = ∇f · ((x - u) - S[x - u]) - ∇f · δ + noise,

where S is the mean under a Gaussian kernel around the pixel (Robinson 1988, "Root-N-consistent semiparametric
regression") and δ is the error of u. S and the gradient of S[I] leave out the block itself, whose noise would otherwise
bias δ towards 0. Phase, amplitude, brightness and gain have a free value in each block and are eliminated. A phase
error displaces a sample by a multiple of its velocity, an amplitude error by one of its distance from the centre.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from recon.imaging.smoothing import REACH
from scanner.arrays import Array

FOLDS = 8
"""Parts of the blocks, each of which is compared with the picture of the others: that one lacks an eighth of them."""

MIN_WEIGHT = 0.05
"""Kernel-weighted number of samples, relative to the mean, below which a pixel is not compared."""

NUISANCES = 6
"""Free values in each block: phase of x and y, amplitude of x and y, brightness, gain."""


STEP_PX = 0.01
"""Step of the places that are kept [px]: its rounding, 0.003 px rms, is far below what a block determines."""

MARGIN_PX = 64.0
"""Distance beyond the field up to which places are kept [px]: a motion of the sample brings them into the picture."""


class ScanSamples(NamedTuple):
    """Samples of a scan, each of shape (n,): place of the beam from the corner of the field, and intensity.

    Places are integers in steps of ``STEP_PX`` from ``-MARGIN_PX`` on: 8 bytes a sample in place of 12.

    Attributes:
        x, y: place [STEP_PX].
        value: intensity; NaN where the place is unknown or beyond the margin.
    """

    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    value: NDArray[np.float32]

    @classmethod
    def empty(cls, size: int) -> ScanSamples:
        """Return ``size`` samples without values."""
        return cls(np.zeros(size, np.uint16), np.zeros(size, np.uint16), np.full(size, np.nan, np.float32))

    @classmethod
    def from_arrays(cls, x: Array, y: Array, value: Array) -> ScanSamples:
        """Return samples at places in pixels, arrays of shape (n,)."""
        samples = cls.empty(x.size)
        samples.write(0, x, y, value)
        return samples

    def write(self, first: int, x: Array, y: Array, value: Array) -> None:
        """Write samples at places in pixels, arrays of shape (n,), from sample ``first`` on."""
        part = slice(first, first + value.size)
        steps = [np.rint((each + MARGIN_PX) / STEP_PX) for each in (x, y)]
        inside = np.all([(each >= 0.0) & (each <= np.iinfo(np.uint16).max) for each in steps], axis=0)
        self.x[part], self.y[part] = (np.where(inside, each, 0.0) for each in steps)
        self.value[part] = np.where(inside, value, np.nan)

    def places(self, part: slice | NDArray[np.int64]) -> tuple[Array, Array]:
        """Return the places x and y of some samples [px]."""
        x, y = (np.multiply(each[part], STEP_PX, dtype=np.float64) - MARGIN_PX for each in (self.x, self.y))
        return x, y


class BlockEquations(NamedTuple):
    """Score and information of the translation of each block, for noise of variance 1.

    Attributes:
        score: derivative of the log likelihood by the translation, shape (blocks, 2) [1/px].
        information: shape (blocks, 2, 2) [1/px²].
        misfit: mean square of the residuals of all samples, in the square of the intensity's unit.
        compared: fraction of the samples that were compared with others.
    """

    score: Array
    information: Array
    misfit: float
    compared: float


def block_equations(
    samples: ScanSamples, shift: Array, length: int, shape: tuple[int, int], width: float
) -> BlockEquations:
    """Return the equations of the translation of each block, around a given one.

    Args:
        samples: of the scan; NaN values and places outside the picture are left out.
        shift: translation of each block, shape (blocks, 2) [px].
        length: samples in a block.
        shape: height and width of the picture.
        width: standard deviation of the kernel [px].
    """
    reference = fold_references(samples, shift, length, shape, width)
    moments = np.zeros((len(shift), 2 + NUISANCES + 1, 2 + NUISANCES + 1))
    counts = np.zeros((len(shift), 2))
    centre = 0.5 * np.array(shape[::-1], float)
    _add_products(*samples, shift, length, reference, centre, moments, counts)
    moments += np.swapaxes(np.triu(moments, 1), 1, 2)
    total = counts.sum(axis=0)
    compared = float(total[0] / max(total[1], 1.0))
    misfit = float(moments[:, -1, -1].sum() / max(total[0], 1.0))
    if not misfit > 0.0:
        return BlockEquations(np.zeros((len(shift), 2)), np.zeros((len(shift), 2, 2)), 0.0, compared)
    nuisance = moments[:, 2:-1, 2:-1] / misfit
    scale = np.sqrt(np.einsum("bii->bi", nuisance)) + 1e-12
    scaled = nuisance / scale[:, :, None] / scale[:, None, :] + 1e-6 * np.eye(NUISANCES)
    coupling = moments[:, :2, 2:-1] / misfit / scale[:, None, :]
    gain = np.swapaxes(np.linalg.solve(scaled, np.swapaxes(coupling, 1, 2)), 1, 2)
    information = moments[:, :2, :2] / misfit - gain @ np.swapaxes(coupling, 1, 2)
    score = moments[:, :2, -1] / misfit - (gain @ (moments[:, 2:-1, -1:] / misfit / scale[..., None]))[..., 0]
    return BlockEquations(score, information, misfit, compared)


def fold_references(
    samples: ScanSamples, shift: Array, length: int, shape: tuple[int, int], width: float
) -> NDArray[np.float32]:
    """Return the picture of the samples of all other folds, by fold, shape (FOLDS, height, width, 5).

    It holds kernel mean, mean place x and y, and gradient in x and y of the intensity by pixel; NaN where unknown.
    Block k belongs to fold k modulo ``FOLDS``. Args as in :func:`block_equations`.
    """
    sums = np.zeros((FOLDS, *shape, 4))
    _accumulate(*samples, shift, length, sums)
    total = sums.sum(axis=0)
    references = np.empty((FOLDS, *shape, 5), np.float32)
    for reference, own in zip(references, sums, strict=True):
        reference[:] = _reference(total - own, width)
    return references


def _reference(sums: Array, width: float) -> Array:
    """Kernel mean, mean place and gradient of the intensity by pixel, shape (height, width, 5); NaN where unknown."""
    import cv2

    size = 2 * max(int(REACH * width + 0.5), 1) + 1
    smooth = cv2.GaussianBlur(sums, (size, size), width, borderType=cv2.BORDER_CONSTANT)
    weight = smooth[..., :1]
    known = weight[..., 0] > MIN_WEIGHT * sums[..., 0].mean()
    means = np.divide(smooth[..., 1:], weight, out=np.full(smooth[..., 1:].shape, np.nan), where=known[..., None])
    value, x, y = np.moveaxis(means, -1, 0)
    down, across = np.gradient(value)
    return np.dstack([value, x, y, across, down])


@njit(cache=True)
def _shift_at(shift, length, i):  # type: ignore[no-untyped-def]
    """Translation at a sample, linear between the middles of blocks."""
    position = min(max((i + 0.5) / length - 0.5, 0.0), shift.shape[0] - 1.0)
    first = min(int(position), max(shift.shape[0] - 2, 0))
    last = min(first + 1, shift.shape[0] - 1)
    part = position - first
    return (
        shift[first, 0] + part * (shift[last, 0] - shift[first, 0]),
        shift[first, 1] + part * (shift[last, 1] - shift[first, 1]),
    )


@njit(cache=True)
def _accumulate(x, y, value, shift, length, sums):  # type: ignore[no-untyped-def]
    folds, height, width = sums.shape[:3]
    for i in range(x.size):
        u, v = _shift_at(shift, length, i)
        px, py = x[i] * STEP_PX - MARGIN_PX - u, y[i] * STEP_PX - MARGIN_PX - v
        if not (px >= 0.0 and px < width and py >= 0.0 and py < height and np.isfinite(value[i])):
            continue
        cell = sums[min(i // length, shift.shape[0] - 1) % folds, int(py), int(px)]
        cell[0] += 1.0
        cell[1] += value[i]
        cell[2] += px
        cell[3] += py


@njit(cache=True)
def _add_products(x, y, value, shift, length, reference, centre, moments, counts):  # type: ignore[no-untyped-def]
    folds, height, width = reference.shape[:3]
    columns = moments.shape[1]
    row = np.empty(columns)
    for i in range(1, x.size - 1):
        u, v = _shift_at(shift, length, i)
        px, py = x[i] * STEP_PX - MARGIN_PX - u, y[i] * STEP_PX - MARGIN_PX - v
        if not (px >= 0.0 and px < width and py >= 0.0 and py < height and np.isfinite(value[i])):
            continue
        block = min(i // length, shift.shape[0] - 1)
        counts[block, 1] += 1.0
        f, cx, cy, gx, gy = reference[block % folds, int(py), int(px)]
        if not np.isfinite(gx + gy + f):
            continue
        counts[block, 0] += 1.0
        row[0], row[1] = -gx, -gy
        row[2] = gx * STEP_PX * (np.int64(x[i + 1]) - np.int64(x[i - 1]))
        row[3] = gy * STEP_PX * (np.int64(y[i + 1]) - np.int64(y[i - 1]))
        row[4], row[5] = gx * (px - centre[0]), gy * (py - centre[1])
        row[6], row[7] = 1.0, f
        row[8] = value[i] - f - gx * (px - cx) - gy * (py - cy)
        for j in range(columns):
            for k in range(j, columns):
                moments[block, j, k] += row[j] * row[k]
