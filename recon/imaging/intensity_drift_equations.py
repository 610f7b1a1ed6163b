"""Equations of a drift of the detector, given its spectrum, and their solution.

The model of sample i in pixel p and block k of consecutive samples is

    d_i = s_p + b_k + white noise          for an offset (1/f noise of a detector, stray light),
    d_i = s_p exp(b_k / S) + white noise   for a gain (bleaching, laser power), S the level of the scene.

A gain is thus positive however far it falls. Linearised around the present gain g, d_i / g is s_p + h_p (b_k - S ln g)
with h_p = s_p / S. Its samples are weighted by the inverse of their variance, a sum of read noise 1/g², photon noise
1/g and a constant that is fitted to the residual: with other weights, the noise in h_p is correlated with the residual
and a gain that falls to a tenth is wrong by 40 %. For an offset h_p and g are 1.

Eliminating s leaves linear equations in b that conjugate gradients solve (Keihänen, Kurki-Suonio and Poutanen 2005,
doi:10.1111/j.1365-2966.2005.09055.x, there for maps of the microwave background).
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.optimize import nnls
from scipy.sparse.linalg import LinearOperator, cg

from estimation.device_fit.noise import near_lines
from scanner.arrays import Array

DriftKind = Literal["offset", "gain"]

GAIN_ROUNDS = 3
"""Linearisations of the product of scene and gain: each reduces the error of a gain change g to about its square."""

GAIN_GROUPS = 16
"""Groups of blocks of similar gain in which the variance of a sample is measured: five for each of its three terms."""

MAX_CG_STEPS = 200
"""Limit of the steps of conjugate gradients. Ten are usual; more are needed where few pixels cross."""

LINE_BINS = 3
"""Bins on either side of a line that are free. The periodic prior has two bins for each cycle in a window, so that this
is one and a half bins of the window, over which a line of any frequency leaks."""

LEAST_DRIFT_DENSITY = 1e-6
"""Least spectral density of a drift over that of the noise in block means: it is 0 where there are lines alone."""

CG_TOLERANCE = 1e-3
"""Relative residual at which conjugate gradients end: a thousandth of the drift, far below its standard deviation."""


class SceneSums(NamedTuple):
    """Weighted sum ``total`` of corrected samples and their ``number``, the sum of weights, each of shape (pixels,)."""

    total: Array
    number: Array

    @property
    def mean(self) -> Array:
        """Mean of each pixel, shape (pixels,); 0 where there is no sample."""
        return np.divide(self.total, self.number, out=np.zeros_like(self.total), where=self.number > 0.0)

    def add(self, pixel: NDArray[np.int32], values: Array, weight: Array | None = None) -> SceneSums:
        """Return the sums with further samples and their weights, 1 where none are given, all of shape (n,)."""
        weighted = values if weight is None else weight * values
        return SceneSums(
            self.total + np.bincount(pixel, weighted, self.total.size),
            self.number + np.bincount(pixel, weight, self.number.size),
        )


class DriftModel(NamedTuple):
    """What is known of a drift before it is solved.

    Attributes:
        kind: offset or gain.
        block: samples in a block.
        rate: blocks by second [Hz].
        free: degrees of freedom of the samples that the means of the pixels leave, as a fraction.
        level: what a gain multiplies on average: root mean square of the scene; 1 for an offset.
        white, flicker, walk: two-sided power spectral density [unit²/Hz] of the noise in the means of blocks, and
            coefficients of that of the drift, ``flicker / f + walk / f²``. The drift of a gain is its logarithm times
            ``level``.
        lines: frequencies of which amplitude and phase are unknown a priori, as of a lamp at the mains [Hz].
    """

    kind: DriftKind
    block: int
    rate: float
    free: float
    level: float
    white: float = 0.0
    flicker: float = 0.0
    walk: float = 0.0
    lines: tuple[float, ...] = ()

    @property
    def drifts(self) -> bool:
        """Whether there is a drift."""
        return self.flicker > 0.0 or self.walk > 0.0 or bool(self.lines)

    def sensitivity(self, scene: SceneSums) -> Array:
        """Change of a sample of each pixel with the drift, 0 in the pixel of samples that are left out."""
        change = np.ones(scene.number.size) if self.kind == "offset" else scene.mean / self.level
        change[-1] = 0.0
        return change

    def remove(self, intensity: Array, drift: Array) -> Array:
        """Return samples of whole blocks, shape (n,), without a drift, shape (blocks,)."""
        if self.kind == "offset":
            return intensity - np.repeat(drift, self.block)
        return intensity / np.repeat(self.gain(drift), self.block)

    def gain(self, drift: Array) -> Array:
        """The gain in blocks of a drift, shape (blocks,); 1 for an offset."""
        return np.ones_like(drift) if self.kind == "offset" else np.exp(drift / self.level)

    def precision(self, frequency: Array) -> Array:
        """Inverse of the prior's power at frequencies from 0 on [Hz]; 0 at 0, as the mean is free, and at lines."""
        density = self.flicker / frequency[1:] + self.walk / frequency[1:] ** 2
        power = np.maximum(density, LEAST_DRIFT_DENSITY * self.white) * self.rate
        precision = np.concatenate([[0.0], 1.0 / power])
        precision[near_lines(frequency, self.lines, LINE_BINS * frequency[1])] = 0.0
        return precision


def solve_window(pixel: NDArray[np.int32], intensity: Array, earlier: SceneSums, model: DriftModel) -> Array:
    """Drift of the blocks of a window in the intensity's unit, with the scene of earlier windows known."""
    drift = np.zeros(pixel.size // model.block)
    for _ in range(1 if model.kind == "offset" else GAIN_ROUNDS):
        corrected = model.remove(intensity, drift)
        weight = gain_weight(pixel, corrected, earlier, drift, model)
        scene = earlier.add(pixel, corrected, np.repeat(weight, model.block))
        sensitivity = model.sensitivity(scene)
        linear = corrected + sensitivity[pixel] * np.repeat(drift, model.block)
        drift = solve_linear(pixel, linear, weight, earlier, sensitivity, model)
    return drift


def gain_weight(
    pixel: NDArray[np.int32], corrected: Array, earlier: SceneSums, drift: Array, model: DriftModel
) -> Array:
    """Mean variance of the samples without drift over that in each block, shape (blocks,); 1 for a steady gain."""
    gain = model.gain(drift)
    if not np.ptp(gain) > 0.0:
        return np.ones_like(gain)
    residual = corrected - earlier.add(pixel, corrected).mean[pixel]
    power = np.where(pixel < earlier.number.size - 1, residual**2, 0.0).reshape(-1, model.block).mean(axis=1)
    order = np.array_split(np.argsort(gain), GAIN_GROUPS)
    variance, middle = (np.array([each[group].mean() for group in order]) for each in (power, gain))
    if not (variance > 0.0).all():
        return np.ones_like(gain)
    coefficients = nnls(_noise_terms(middle) / variance[:, None], np.ones(GAIN_GROUPS))[0]
    modelled = _noise_terms(gain) @ coefficients
    return np.asarray(modelled.mean() / modelled)


def _noise_terms(gain: Array) -> Array:
    """Dependence of the variance of a sample without drift on the gain: read noise, photon noise, and a constant."""
    return np.column_stack([gain**-2, gain**-1, np.ones_like(gain)])


def solve_linear(
    pixel: NDArray[np.int32], intensity: Array, weight: Array, earlier: SceneSums, sensitivity: Array, model: DriftModel
) -> Array:
    """Posterior mean of a drift whose effect is proportional to the given sensitivity of each pixel.

    ``weight`` is the inverse variance of the samples of each block, as :func:`gain_weight` returns it.
    """
    blocks = pixel.size // model.block
    size = next_fast_len(2 * blocks, real=True)  # the prior is periodic: the second half separates end and beginning
    scene = earlier.add(pixel, intensity, np.repeat(weight, model.block))
    scale = np.divide(sensitivity, scene.number, out=np.zeros_like(sensitivity), where=scene.number > 0.0)
    information = weight * sum_blocks(sensitivity**2, pixel, model.block)
    sample_variance = model.white * model.rate * model.block
    precision = model.precision(rfftfreq(size, 1.0 / model.rate)) * sample_variance

    def apply(drift: Array) -> Array:
        mean = scale * sensitivity * _sum_pixels(weight * drift[:blocks], pixel, model.block, scale.size)
        result = irfft(rfft(drift) * precision, size)
        result[:blocks] += information * drift[:blocks] - weight * sum_blocks(mean, pixel, model.block)
        return result

    def precondition(residual: Array) -> Array:
        return irfft(rfft(residual) / (model.block * float(weight.mean()) + precision), size)

    weighted = np.zeros(size)
    weighted[:blocks] = weight * score(pixel, intensity, scene, sensitivity, model.block)
    shape = (size, size)
    solution, _ = cg(
        LinearOperator(shape, matvec=apply, dtype=float),
        weighted,
        rtol=CG_TOLERANCE,
        maxiter=MAX_CG_STEPS,
        M=LinearOperator(shape, matvec=precondition, dtype=float),
    )
    return np.asarray(solution[:blocks])


def score(pixel: NDArray[np.int32], intensity: Array, scene: SceneSums, sensitivity: Array, block: int) -> Array:
    """Sum over each block of sensitivity times residual, shape (blocks,)."""
    weighted = sensitivity[pixel] * (intensity - scene.mean[pixel])
    return np.asarray(weighted.reshape(-1, block).sum(axis=1))


@njit(cache=True)
def sum_blocks(picture, pixel, block):  # type: ignore[no-untyped-def]
    """Sum over each block of the values of its pixels, shape (blocks,)."""
    sums = np.zeros(pixel.size // block)
    for k in range(sums.size):
        for i in range(k * block, (k + 1) * block):
            sums[k] += picture[pixel[i]]
    return sums


@njit(cache=True)
def _sum_pixels(drift, pixel, block, pixels):  # type: ignore[no-untyped-def]
    """Sum over the samples of each pixel of the drift of their blocks, shape (pixels,)."""
    sums = np.zeros(pixels)
    for k in range(drift.size):
        for i in range(k * block, (k + 1) * block):
            sums[pixel[i]] += drift[k]
    return sums
