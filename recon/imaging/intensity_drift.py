"""Slow changes of the detector's offset or gain, solved through the self-crossings of the scan.

The model of sample i in pixel p and block k of consecutive samples is

    d_i = s_p + b_k + white noise          for an offset (1/f noise of a detector, stray light),
    d_i = s_p exp(b_k / S) + white noise   for a gain (bleaching, laser power), S the level of the scene.

A gain is thus positive however far it falls. Linearised around the present gain g, d_i / g is s_p + h_p (b_k - S ln g)
with h_p = s_p / S. Its samples are weighted by the inverse of their variance, a sum of read noise 1/g², photon noise
1/g and a constant that is fitted to the residual: with other weights, the noise in h_p is correlated with the residual
and a gain that falls to a tenth is wrong by 40 %. For an offset h_p and g are 1.
The scene s is free, so only samples that visit a pixel at different times determine b. The prior of b is
a Gaussian process whose power spectral density A/f + B/f² (flicker noise and random walk) is estimated from the same
recording. Eliminating s leaves linear equations in b that conjugate gradients solve (Keihänen, Kurki-Suonio and
Poutanen 2005, doi:10.1111/j.1365-2966.2005.09055.x, there for maps of the microwave background).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.optimize import nnls
from scipy.sparse.linalg import LinearOperator, cg

from scanner.arrays import Array

DriftKind = Literal["offset", "gain"]

SampleReader = Callable[[int, int], tuple[NDArray[np.int32], Array]]
"""Reads samples from the first number up to the second: the number of the pixel of each, negative where it belongs to
none, and the intensity, both of shape (n,). Samples that are not finite are left out."""

BLOCK_S = 3e-6
"""Length of a block [s]: blocks resolve drift up to 170 kHz. Faster drift lies below the noise of a sample."""

WINDOW_SAMPLES = 1 << 22
"""Samples solved together. It bounds the memory; later windows use the scene of the earlier ones."""

MIN_BLOCKS = 64
"""Shortest recording that is solved: six octaves determine the three coefficients of the spectrum."""

MEDIAN_OF_EXPONENTIAL = float(np.log(2.0))
"""Median of the power of Gaussian noise over its mean. Medians leave out lines of the scene in the residual."""

TRANSMISSION_DRAWS = 8
"""Simulated recordings of white noise: they determine the lowest octave, of one frequency, to a third."""

SPECTRUM_ROUNDS = 5
"""Fits of the spectrum, each weighted by the model of the previous one: weights then change by less than 1 %."""

GAIN_ROUNDS = 3
"""Linearisations of the product of scene and gain: each reduces the error of a gain change g to about its square."""

GAIN_GROUPS = 16
"""Groups of blocks of similar gain in which the variance of a sample is measured: five for each of its three terms."""

MAX_CG_STEPS = 200
"""Limit of the steps of conjugate gradients. Ten are usual; more are needed where few pixels cross."""

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
    """

    kind: DriftKind
    block: int
    rate: float
    free: float
    level: float
    white: float = 0.0
    flicker: float = 0.0
    walk: float = 0.0

    @property
    def drifts(self) -> bool:
        """Whether there is a drift."""
        return self.flicker > 0.0 or self.walk > 0.0

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
        """Inverse of the prior's power at frequencies from 0 on [Hz]; 0 at 0, because the mean is free."""
        power = (self.flicker / frequency[1:] + self.walk / frequency[1:] ** 2) * self.rate
        return np.concatenate([[0.0], 1.0 / power])


@dataclass(frozen=True)
class IntensityDrift:
    """Estimated drift of a detector.

    Attributes:
        kind: offset in the intensity's unit, or relative gain.
        block: samples in a block.
        values: drift of each block, for a gain relative to the mean one, shape (blocks,); the mean is 0.
        sd: standard deviation of a value.
    """

    kind: DriftKind
    block: int
    values: Array
    sd: float

    def correct(self, intensity: Array, first: int = 0) -> Array:
        """Return samples without the drift, shape (n,).

        Args:
            intensity: shape (n,).
            first: number of the first of these samples in the recording.
        """
        drift = self.values[(first + np.arange(intensity.size)) // self.block]
        return intensity - drift if self.kind == "offset" else intensity / (1.0 + drift)


def estimate_intensity_drift(
    read: SampleReader, size: int, pixels: int, sample_rate: float, kind: DriftKind
) -> IntensityDrift | None:
    """Estimate the drift of a detector; None where the samples do not determine one.

    Args:
        read: reads the samples; called once for each window, so memory does not grow with the recording.
        size: number of samples.
        pixels: number of pixels of the picture.
        sample_rate: [Hz].
        kind: what drifts.
    """
    block = max(1, round(BLOCK_S * sample_rate))
    window = WINDOW_SAMPLES // block * block
    nothing, model, parts = SceneSums(np.zeros(pixels + 1), np.zeros(pixels + 1)), None, []
    scene = nothing
    for first in range(0, size, window):
        pixel, intensity = _fill_blocks(*read(first, min(first + window, size)), pixels, block)
        if model is None:
            model = fit_drift_model(pixel, intensity, nothing, sample_rate / block, block, kind)
            if model is not None and model.drifts:
                model = refit_drift_model(pixel, intensity, nothing, model)
        if model is None:
            return None
        if not model.drifts:
            return IntensityDrift(kind, block, np.zeros(-(-size // block)), 0.0)
        drift = _solve_window(pixel, intensity, scene, model)
        corrected = model.remove(intensity, drift)
        scene = scene.add(pixel, corrected, np.repeat(_gain_weight(pixel, corrected, scene, drift, model), block))
        parts.append(drift)
    if model is None:
        return None
    drift = np.concatenate(parts)
    gain = model.gain(drift)
    values = drift - drift.mean() if kind == "offset" else gain / gain.mean() - 1.0
    return IntensityDrift(kind, block, values, drift_sd(model, window // block) / model.level)


def fit_drift_model(
    pixel: NDArray[np.int32],
    intensity: Array,
    nothing: SceneSums,
    rate: float,
    block: int,
    kind: DriftKind,
    removed: Array | None = None,
) -> DriftModel | None:
    """Fit the spectrum of the drift to the residual of the mean picture; None where the samples do not determine it.

    That needs pixels that were visited several times and, for a gain, that are not dark, and samples with noise.

    The mean picture takes some of the power out of the residual; simulated white noise on the same path shows how much.
    The median density of each octave is fitted by non-negative least squares on the relative deviation.

    Args:
        pixel: number of the pixel of each sample, the last one where a sample belongs to none, shape (n,).
        intensity: shape (n,), n a multiple of ``block``.
        nothing: sums without samples.
        rate, block, kind: as in :class:`DriftModel`.
        removed: drift over ``level`` that was removed from the samples. The residual that it has if all blocks are
            equally sensitive is added again. None for samples as recorded.
    """
    scene = nothing.add(pixel, intensity)
    samples = scene.number[:-1].sum()
    free = 1.0 - np.count_nonzero(scene.number[:-1]) / max(samples, 1.0)
    level = 1.0 if kind == "offset" else float(np.sqrt(scene.number[:-1] @ scene.mean[:-1] ** 2 / max(samples, 1.0)))
    if not free > 0.0 or not level > 0.0 or pixel.size < MIN_BLOCKS * block:
        return None
    model = DriftModel(kind, block, rate, free, level)
    sensitivity = model.sensitivity(scene)
    frequency = rfftfreq(pixel.size // block, 1.0 / rate)[1:]
    octave = np.floor(np.log2(frequency / frequency[0])).astype(int)
    number = np.bincount(octave)

    def residual_power(values: Array, added: Array | float = 0.0) -> Array:
        """Power of the residual of samples at each frequency above 0, relative to that of white noise of variance 1."""
        residual = _score(pixel, values, nothing.add(pixel, values), sensitivity, block) + added
        return np.abs(rfft(residual)[1:]) ** 2 / (block * samples)

    random = np.random.default_rng(0)
    white_noise = (residual_power(random.standard_normal(pixel.size)) for _ in range(TRANSMISSION_DRAWS))
    transmission = np.mean([np.bincount(octave, power) / number for power in white_noise], axis=0)
    information = free * float(np.mean(_sum_blocks(sensitivity**2, pixel, block)))
    power = residual_power(intensity, 0.0 if removed is None else information * level * removed)
    median = np.array([np.median(power[octave == k]) for k in range(number.size)]) / MEDIAN_OF_EXPONENTIAL
    density = median / transmission / (rate * block)
    if not (density > 0.0).all():  # NaN where no sample of an octave can show a drift
        return None
    middle = np.bincount(octave, frequency) / number
    terms = np.column_stack([np.ones_like(middle), 1.0 / middle, 1.0 / middle**2])
    expected, scale = density, terms.max(axis=0)
    for _ in range(SPECTRUM_ROUNDS):
        weight = np.sqrt(number) / expected
        coefficients = nnls(terms / scale * weight[:, None], density * weight)[0] / scale
        expected = terms @ coefficients
    return model._replace(white=coefficients[0], flicker=coefficients[1], walk=coefficients[2])


def refit_drift_model(pixel: NDArray[np.int32], intensity: Array, nothing: SceneSums, model: DriftModel) -> DriftModel:
    """Fit the spectrum again, with the residual of samples without the drift that is found with ``model``.

    Pixels are visited again in a pattern, which modulates a slow drift. The residual of the mean picture has some of
    its power at all frequencies, which the first fit takes for noise: 15 times the noise if a gain falls to 0.6.

    Returns:
        The new model; ``model`` where the samples without the drift determine none.
    """
    drift = _solve_window(pixel, intensity, nothing, model)
    corrected, relative = model.remove(intensity, drift), drift / model.level
    return fit_drift_model(pixel, corrected, nothing, model.rate, model.block, model.kind, relative) or model


def drift_sd(model: DriftModel, blocks: int) -> float:
    """Standard deviation of the drift of a block, in the intensity's unit, for noise that is the same in all blocks."""
    precision = model.precision(rfftfreq(blocks, 1.0 / model.rate))[1:]
    variance = model.white * model.rate
    return float(np.sqrt(np.mean(variance / (model.free + variance * precision))))


def _fill_blocks(
    pixel: NDArray[np.int32], intensity: Array, pixels: int, block: int
) -> tuple[NDArray[np.int32], Array]:
    """Samples of whole blocks; those without a pixel or a value, and those added, get one pixel more, the last."""
    used, missing = (pixel >= 0) & np.isfinite(intensity), -pixel.size % block
    pixel = np.pad(np.where(used, pixel, np.int32(pixels)), (0, missing), constant_values=pixels)
    return pixel, np.pad(np.where(used, intensity, 0.0), (0, missing))


def _solve_window(pixel: NDArray[np.int32], intensity: Array, earlier: SceneSums, model: DriftModel) -> Array:
    """Drift of the blocks of a window in the intensity's unit, with the scene of earlier windows known."""
    drift = np.zeros(pixel.size // model.block)
    for _ in range(1 if model.kind == "offset" else GAIN_ROUNDS):
        corrected = model.remove(intensity, drift)
        weight = _gain_weight(pixel, corrected, earlier, drift, model)
        scene = earlier.add(pixel, corrected, np.repeat(weight, model.block))
        sensitivity = model.sensitivity(scene)
        linear = corrected + sensitivity[pixel] * np.repeat(drift, model.block)
        drift = _solve_linear(pixel, linear, weight, earlier, sensitivity, model)
    return drift


def _gain_weight(
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


def _solve_linear(
    pixel: NDArray[np.int32], intensity: Array, weight: Array, earlier: SceneSums, sensitivity: Array, model: DriftModel
) -> Array:
    """Posterior mean of a drift whose effect is proportional to the given sensitivity of each pixel.

    ``weight`` is the inverse variance of the samples of each block, as ``_gain_weight`` returns it.
    """
    blocks = pixel.size // model.block
    size = next_fast_len(2 * blocks, real=True)  # the prior is periodic: the second half separates end and beginning
    scene = earlier.add(pixel, intensity, np.repeat(weight, model.block))
    scale = np.divide(sensitivity, scene.number, out=np.zeros_like(sensitivity), where=scene.number > 0.0)
    information = weight * _sum_blocks(sensitivity**2, pixel, model.block)
    sample_variance = model.white * model.rate * model.block
    precision = model.precision(rfftfreq(size, 1.0 / model.rate)) * sample_variance

    def apply(drift: Array) -> Array:
        mean = scale * sensitivity * _sum_pixels(weight * drift[:blocks], pixel, model.block, scale.size)
        result = irfft(rfft(drift) * precision, size)
        result[:blocks] += information * drift[:blocks] - weight * _sum_blocks(mean, pixel, model.block)
        return result

    def precondition(residual: Array) -> Array:
        return irfft(rfft(residual) / (model.block * float(weight.mean()) + precision), size)

    score = np.zeros(size)
    score[:blocks] = weight * _score(pixel, intensity, scene, sensitivity, model.block)
    shape = (size, size)
    solution, _ = cg(
        LinearOperator(shape, matvec=apply, dtype=float),
        score,
        rtol=CG_TOLERANCE,
        maxiter=MAX_CG_STEPS,
        M=LinearOperator(shape, matvec=precondition, dtype=float),
    )
    return np.asarray(solution[:blocks])


def _score(pixel: NDArray[np.int32], intensity: Array, scene: SceneSums, sensitivity: Array, block: int) -> Array:
    """Sum over each block of sensitivity times residual, shape (blocks,)."""
    weighted = sensitivity[pixel] * (intensity - scene.mean[pixel])
    return np.asarray(weighted.reshape(-1, block).sum(axis=1))


@njit(cache=True)
def _sum_blocks(picture, pixel, block):  # type: ignore[no-untyped-def]
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
