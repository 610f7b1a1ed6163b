"""Normal equations of the sample's translation in short blocks of a scan, against the picture of the other blocks.

A sample of the scene f at place x, which is mapped with the translation u of its block, has the intensity

    I = f(x - u) + noise,        I - S[I] = ∇f · ((x - u) - S[x - u]) - ∇f · δ + noise,

where S is the mean under a Gaussian kernel around the pixel (Robinson 1988, "Root-N-consistent semiparametric
regression") and δ is the error of u. S and the gradient of S[I] leave out the block itself, whose noise would otherwise
bias δ towards 0. Phase, amplitude, brightness and gain have a free value in each block and are eliminated. A phase
error displaces a sample by a multiple of its velocity, an amplitude error by one of its distance from the centre.

A block is a period of the slower axis. Within it the translation is a polynomial of the time (``SHAPES``), which
resolves vibrations faster than the blocks.

Every equation is divided by the standard deviation of its residual (``residual_noise``): that of photon noise and of
detail is many times larger on a bright bead or an edge than in the background. With one variance for all of them, the
noise of the few bright places would be taken for information on the translation.

The residuals of a sharp scene hold detail that the kernel smooths, and that returns whenever the beam passes its place.
Where the visits of a place have a fixed phase against a vibration, whose frequency is then a difference of multiples of
the scan's frequencies, such detail looks like an amplitude. The variance of a fitted value is therefore that of the
sums of its contributions over places (Liang and Zeger 1986, "Longitudinal data analysis using generalized linear
models").
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from recon.imaging.sample_motion.gradient_noise import calibrate_gradients
from recon.imaging.sample_motion.placed_samples import MARGIN_PX, STEP_PX, PlacedSamples
from recon.imaging.sample_motion.residual_noise import ResidualNoise, fit_residual_noise
from recon.imaging.smoothing import REACH
from scanner.arrays import Array

FOLDS = 8
"""Parts of the blocks, each of which is compared with the picture of the others: that one lacks an eighth of them."""

MIN_WEIGHT = 0.05
"""Kernel-weighted number of samples, relative to the mean, below which a pixel is not compared."""

PARTS = 8
"""Parts of a block, in each of which equations take the translation as constant. Linear interpolation between their
middles lowers a vibration at half of the slower axis's frequency by 1.3 %, and one at a third of it by 0.5 %."""

SHAPES = np.sqrt(PARTS) * np.linalg.qr(np.vander(np.arange(PARTS) - 0.5 * (PARTS - 1), 4, increasing=True))[0].T
SHAPES *= np.sign(SHAPES[:, -1:])
"""Polynomials of degrees 0 to 3 over the parts of a block, orthogonal and of mean square 1, shape (4, PARTS). They
contain 99.6 % of the variance of a vibration at three quarters of the slower axis's frequency."""

PLACE_PX = 8
"""Side of the squares over which contributions are summed [px]: twice the widest kernel, the range of the correlation
of smoothed detail. A picture of 256 x 256 pixels has 1024 of them."""

NUISANCES = 6
"""Free values in each block: phase of x and y, amplitude of x and y, brightness, gain."""

MAX_NOISE_SAMPLES = 1 << 16
"""Samples from which the variance of the residuals is fitted: they determine it to 1 %."""

UNIT_NOISE = ResidualNoise(1.0, 0.0, 0.0, 0.0)
"""Variance under which equations remain in the unit of the intensity."""


class BlockEquations(NamedTuple):
    """Score and information of the translation of each block, under the variance of the residuals.

    Attributes:
        score: derivative of the log likelihood by x and y of the first of ``SHAPES``, of the second, and of the third,
            shape (blocks, 6) [1/px].
        information: shape (blocks, 6, 6) [1/px²].
        misfit: mean square of the residuals of all samples, in the square of the intensity's unit.
        compared: fraction of the samples that were compared with others.
        scatter: :func:`scatter_by_place` as a function of its last two arguments.
    """

    score: Array
    information: Array
    misfit: float
    compared: float
    scatter: Callable[[Array, Array], Array]


def block_equations(
    samples: PlacedSamples, shift: Array, length: int, shape: tuple[int, int], width: float
) -> BlockEquations:
    """Return the equations of the translation of each block, around given ones of its parts.

    Args:
        samples: of the scan; NaN values and places outside the picture are left out.
        shift: translation of each part, shape (blocks * PARTS, 2) [px].
        length: samples in a part.
        shape: height and width of the picture.
        width: standard deviation of the kernel [px].
    """
    reference = fold_references(samples, shift, length, shape, width)
    moments = np.zeros((len(shift), 2 + NUISANCES + 1, 2 + NUISANCES + 1))
    counts = np.zeros((len(shift), 3))
    centre = 0.5 * np.array(shape[::-1], float)
    noise = measure_residual_noise(samples, shift, length, reference)
    _add_products(*samples, shift, length, reference, centre, noise, moments, counts)
    moments += np.swapaxes(np.triu(moments, 1), 1, 2)
    total = counts.sum(axis=0)
    compared = float(total[0] / max(total[1], 1.0))
    misfit = float(total[2] / max(total[0], 1.0))
    blocks, size = len(shift) // PARTS, 2 * len(SHAPES)
    moments = np.reshape(moments, (blocks, PARTS, *moments.shape[1:]))
    nuisance = moments[..., 2:-1, 2:-1].sum(axis=1)
    scale = np.sqrt(np.einsum("bii->bi", nuisance)) + 1e-12
    scaled = nuisance / scale[:, :, None] / scale[:, None, :] + 1e-6 * np.eye(NUISANCES)
    columns = np.einsum("kp,bpij->bkij", SHAPES, moments[..., :2, 2:]).reshape(blocks, size, NUISANCES + 1)
    residual = moments[..., 2:-1, -1].sum(axis=1)
    right = np.concatenate([np.swapaxes(columns[..., :-1], 1, 2), residual[..., None]], axis=-1) / scale[..., None]
    coefficients = np.linalg.solve(scaled, right) / scale[..., None]
    explained = columns[..., :-1] @ coefficients
    own = np.einsum("kp,lp,bpij->bkilj", SHAPES, SHAPES, moments[..., :2, :2], optimize=True)
    information, score = own.reshape(blocks, size, size) - explained[..., :-1], columns[..., -1] - explained[..., -1]
    scatter = partial(scatter_by_place, samples, shift, length, reference, noise, coefficients)
    return BlockEquations(score, information, misfit, compared, scatter)


def scatter_by_place(
    samples: PlacedSamples,
    shift: Array,
    length: int,
    reference: NDArray[np.float32],
    noise: ResidualNoise,
    coefficients: Array,
    columns: Array,
    change: Array,
) -> Array:
    """Return the sum over places of the products of what the samples there contribute to the scores of some values.

    Args:
        samples, shift, length: as for :func:`block_equations`.
        reference: of :func:`fold_references`.
        noise: of :func:`measure_residual_noise`.
        coefficients: of the eliminated values of each block in the gradients along ``SHAPES`` and in the residual,
            shape (blocks, NUISANCES, 7).
        columns: displacement of each part by each value, shape (blocks, PARTS, 2, k).
        change: displacement of each part from ``shift`` under the fitted values, shape (blocks * PARTS, 2) [px].
    """
    across = -(-np.array(reference.shape[1:3]) // PLACE_PX)
    sums = np.zeros((*across, columns.shape[-1]))
    nuisances = coefficients[..., :-1] @ by_shape(columns)
    parts = np.ascontiguousarray(columns.reshape(len(shift), 2, -1))
    residual = np.ascontiguousarray(coefficients[..., -1])
    centre = 0.5 * np.array(reference.shape[2:0:-1], float)
    _add_by_place(*samples, shift, length, reference, centre, noise, nuisances, residual, parts, change, sums)
    total = sums.reshape(-1, sums.shape[-1])
    return np.asarray(total.T @ total)


def measure_residual_noise(
    samples: PlacedSamples, shift: Array, length: int, reference: NDArray[np.float32]
) -> ResidualNoise:
    """Return the variance of the residuals, from ``MAX_NOISE_SAMPLES``; args as in :func:`scatter_by_place`."""
    step = -(-samples.x.size // MAX_NOISE_SAMPLES)
    found = np.full((max(samples.x.size - 2, 0) // step, 3), np.nan)
    centre = 0.5 * np.array(reference.shape[2:0:-1], float)
    _residuals(*samples, shift, length, reference, centre, step, found)
    return fit_residual_noise(*found[np.isfinite(found[:, 0])].T)


def sample_log_likelihoods(
    samples: PlacedSamples, shift: Array, length: int, shape: tuple[int, int], width: float
) -> NDArray[np.float32]:
    """Return the log likelihood of each sample under the picture of the other blocks, up to a constant, shape (n,).

    It is NaN where a sample is not compared. Args as in :func:`block_equations`.
    """
    reference = fold_references(samples, shift, length, shape, width)
    noise = measure_residual_noise(samples, shift, length, reference)
    found = np.full(samples.x.size, np.nan, np.float32)
    _log_likelihoods(*samples, shift, length, reference, 0.5 * np.array(shape[::-1], float), noise, found)
    return found


def by_shape(displacement: Array) -> Array:
    """Return displacements of the parts, shape (blocks, PARTS, 2, …), as those of ``SHAPES``, shape (blocks, 6, …)."""
    shapes = np.einsum("kp,bp...->bk...", SHAPES, displacement) / PARTS
    return shapes.reshape(len(shapes), 2 * len(SHAPES), *displacement.shape[3:])


def fold_references(
    samples: PlacedSamples, shift: Array, length: int, shape: tuple[int, int], width: float
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
    calibrate_gradients(references)
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
    """Translation at a sample, linear between the middles of parts."""
    position = min(max((i + 0.5) / length - 0.5, 0.0), shift.shape[0] - 1.0)
    first = min(int(position), max(shift.shape[0] - 2, 0))
    last = min(first + 1, shift.shape[0] - 1)
    fraction = position - first
    return (
        shift[first, 0] + fraction * (shift[last, 0] - shift[first, 0]),
        shift[first, 1] + fraction * (shift[last, 1] - shift[first, 1]),
    )


@njit(cache=True)
def _accumulate(x, y, value, shift, length, sums):  # type: ignore[no-untyped-def]
    folds, height, width = sums.shape[:3]
    for i in range(x.size):
        u, v = _shift_at(shift, length, i)
        px, py = x[i] * STEP_PX - MARGIN_PX - u, y[i] * STEP_PX - MARGIN_PX - v
        if not (px >= 0.0 and px < width and py >= 0.0 and py < height and np.isfinite(value[i])):
            continue
        cell = sums[min(i // length, shift.shape[0] - 1) // PARTS % folds, int(py), int(px)]
        cell[0] += 1.0
        cell[1] += value[i]
        cell[2] += px
        cell[3] += py


@njit(cache=True)
def _residuals(x, y, value, shift, length, reference, centre, step, found):  # type: ignore[no-untyped-def]
    """Write expected value, squared gradient and residual of every ``step``-th sample."""
    row = np.empty(2 + NUISANCES + 1)
    for k in range(found.shape[0]):
        i = 1 + k * step
        if _row(x, y, value, shift, length, reference, centre, UNIT_NOISE, i, row)[3]:
            found[k, 0], found[k, 1], found[k, 2] = row[7], row[0] ** 2 + row[1] ** 2, row[8]


@njit(cache=True)
def _log_likelihoods(x, y, value, shift, length, reference, centre, noise, found):  # type: ignore[no-untyped-def]
    row = np.empty(2 + NUISANCES + 1)
    for i in range(1, x.size - 1):
        if _row(x, y, value, shift, length, reference, centre, noise, i, row)[3]:
            found[i] = np.log(row[6]) - 0.5 * row[8] ** 2


@njit(cache=True)
def _row(x, y, value, shift, length, reference, centre, noise, i, row):  # type: ignore[no-untyped-def]
    """Write a sample's equation; return its part, its square of the scene, and whether it is compared with others."""
    folds, height, width = reference.shape[:3]
    u, v = _shift_at(shift, length, i)
    px, py = x[i] * STEP_PX - MARGIN_PX - u, y[i] * STEP_PX - MARGIN_PX - v
    if not (px >= 0.0 and px < width and py >= 0.0 and py < height and np.isfinite(value[i])):
        return -1, 0, 0, False
    part = min(i // length, shift.shape[0] - 1)
    f, cx, cy, gx, gy = reference[part // PARTS % folds, int(py), int(px)]
    if not np.isfinite(gx + gy + f):
        return part, 0, 0, False
    row[0], row[1] = -gx, -gy
    row[2] = gx * STEP_PX * (np.int64(x[i + 1]) - np.int64(x[i - 1]))
    row[3] = gy * STEP_PX * (np.int64(y[i + 1]) - np.int64(y[i - 1]))
    row[4], row[5] = gx * (px - centre[0]), gy * (py - centre[1])
    row[6], row[7] = 1.0, f
    row[8] = value[i] - f - gx * (px - cx) - gy * (py - cy)
    row /= np.sqrt(noise[0] + noise[1] * max(f - noise[3], 0.0) + noise[2] * (gx * gx + gy * gy))
    return part, int(py) // PLACE_PX, int(px) // PLACE_PX, True


@njit(cache=True)
def _add_products(x, y, value, shift, length, reference, centre, noise, moments, counts):  # type: ignore[no-untyped-def]
    columns = moments.shape[1]
    row = np.empty(columns)
    for i in range(1, x.size - 1):
        part, _, _, compared = _row(x, y, value, shift, length, reference, centre, noise, i, row)
        if part >= 0:
            counts[part, 1] += 1.0
        if compared:
            counts[part, 0] += 1.0
            counts[part, 2] += (row[8] / row[6]) ** 2
            for j in range(columns):
                for k in range(j, columns):
                    moments[part, j, k] += row[j] * row[k]


@njit(cache=True)
def _add_by_place(  # type: ignore[no-untyped-def]
    x, y, value, shift, length, reference, centre, noise, nuisances, residual, columns, change, sums
):
    row = np.empty(2 + NUISANCES + 1)
    for i in range(1, x.size - 1):
        part, down, across, compared = _row(x, y, value, shift, length, reference, centre, noise, i, row)
        if not compared:
            continue
        block = part // PARTS
        left = row[8] - row[0] * change[part, 0] - row[1] * change[part, 1]
        for j in range(NUISANCES):
            left -= row[2 + j] * residual[block, j]
        for k in range(sums.shape[2]):
            by = row[0] * columns[part, 0, k] + row[1] * columns[part, 1, k]
            for j in range(NUISANCES):
                by -= row[2 + j] * nuisances[block, j, k]
            sums[down, across, k] += by * left
