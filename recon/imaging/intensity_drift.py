"""Slow changes of the detector's offset or gain, solved through the self-crossings of the scan.

Sample i in pixel p and block k of consecutive samples is d_i = s_p + b_k for an offset (1/f noise of a detector, stray
light), and d_i = s_p exp(b_k / S) for a gain (bleaching, laser power). The scene s is free, so only samples that visit
a pixel at different times determine b. The prior of b is a Gaussian process whose power spectral density A/f + B/f²
(flicker noise and random walk) is estimated here, from the same recording; ``intensity_drift_equations`` solves for b.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, rfft, rfftfreq
from scipy.optimize import nnls

from estimation.device_fit.noise import near_lines
from recon.imaging.intensity_drift_equations import (
    LINE_BINS,
    DriftKind,
    DriftModel,
    SceneSums,
    gain_weight,
    score,
    solve_linear,
    solve_window,
    sum_blocks,
)
from recon.imaging.pixel_noise import measure_sample_noise
from recon.imaging.revisits import is_revisited
from scanner.arrays import Array

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

SIGN_DRAWS = 4
"""Draws of the signs of the pixels' residuals: the drift that these show, of few frequencies, is right to 20 %."""

LINE_HARMONICS = {"offset": (1,), "gain": (1, 2, 3)}
"""Harmonics of a line that a drift has: the logarithm of a gain that varies by 20 % has 1 % at twice its frequency, and
0.07 % at three times."""

SPECTRUM_ROUNDS = 5
"""Fits of the spectrum, each weighted by the model of the previous one: weights then change by less than 1 %."""


@dataclass(frozen=True)
class IntensityDrift:
    """Estimated drift of a detector.

    Attributes:
        kind: offset in the intensity's unit, or relative gain.
        block: samples in a block.
        values: drift of each block, for a gain relative to the mean one, shape (blocks,); the mean is 0.
        sd: standard deviation of a value.
        noise_factor: variance of the mean of a pixel without the drift, over that by the scatter of its samples. The
            drift is found from this scatter and reduces it, and its own error is common to samples of one moment.
    """

    kind: DriftKind
    block: int
    values: Array
    sd: float
    noise_factor: float = 1.0

    def correct(self, intensity: Array, first: int = 0) -> Array:
        """Return samples without the drift, shape (n,).

        Args:
            intensity: shape (n,).
            first: number of the first of these samples in the recording.
        """
        drift = self.values[(first + np.arange(intensity.size)) // self.block]
        return intensity - drift if self.kind == "offset" else intensity / (1.0 + drift)


def estimate_intensity_drift(
    read: SampleReader, size: int, pixels: int, sample_rate: float, kind: DriftKind, lines: Sequence[float] = ()
) -> IntensityDrift | None:
    """Estimate the drift of a detector; None where the samples do not determine one.

    Args:
        read: reads the samples; called once for each window, so memory does not grow with the recording.
        size: number of samples.
        pixels: number of pixels of the picture.
        sample_rate: [Hz].
        kind: what drifts.
        lines: frequencies at which it varies in any case [Hz].
    """
    block = max(1, round(BLOCK_S * sample_rate))
    window = WINDOW_SAMPLES // block * block
    nothing, model, parts = SceneSums(np.zeros(pixels + 1), np.zeros(pixels + 1)), None, list[Array]()
    scene, sd, noise_factor = nothing, 0.0, 1.0
    for first in range(0, size, window):
        pixel, intensity = _fill_blocks(*read(first, min(first + window, size)), pixels, block)
        if model is None:
            used = pixel < pixels
            if not is_revisited(pixel[used], np.flatnonzero(used).astype(np.float64)):
                return None
            of_drift = [n * line for n in LINE_HARMONICS[kind] for line in lines]
            model = fit_drift_model(pixel, intensity, nothing, sample_rate / block, block, kind, lines=of_drift)
            if model is not None and model.drifts:
                model = refit_drift_model(pixel, intensity, nothing, model)
        if model is None:
            return None
        if not model.drifts:
            return IntensityDrift(kind, block, np.zeros(-(-size // block)), 0.0)
        drift = solve_window(pixel, intensity, scene, model)
        corrected = model.remove(intensity, drift)
        if not parts:
            sd, noise_factor = simulate_errors(pixel, corrected, nothing, model)
        scene = scene.add(pixel, corrected, np.repeat(gain_weight(pixel, corrected, scene, drift, model), block))
        parts.append(drift)
    if model is None:
        return None
    values = _relative_values(np.concatenate(parts), model)
    return IntensityDrift(kind, block, values, sd, noise_factor)


def fit_drift_model(
    pixel: NDArray[np.int32],
    intensity: Array,
    nothing: SceneSums,
    rate: float,
    block: int,
    kind: DriftKind,
    removed: Array | None = None,
    lines: Sequence[float] = (),
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
        lines: frequencies of the model's lines, which are no part of its spectrum [Hz].
    """
    scene = nothing.add(pixel, intensity)
    samples = scene.number[:-1].sum()
    free = 1.0 - np.count_nonzero(scene.number[:-1]) / max(samples, 1.0)
    level = 1.0 if kind == "offset" else float(np.sqrt(scene.number[:-1] @ scene.mean[:-1] ** 2 / max(samples, 1.0)))
    if not free > 0.0 or not level > 0.0 or pixel.size < MIN_BLOCKS * block:
        return None
    model = DriftModel(kind, block, rate, free, level, lines=tuple(lines))
    sensitivity = model.sensitivity(scene)
    frequency = rfftfreq(pixel.size // block, 1.0 / rate)[1:]
    between = ~near_lines(frequency, lines, 0.5 * LINE_BINS * frequency[0])
    frequency = frequency[between]
    octave = np.unique(np.floor(np.log2(frequency / frequency[0])), return_inverse=True)[1]
    number = np.bincount(octave)

    def residual_power(values: Array, added: Array | float = 0.0) -> Array:
        """Power of the residual of samples at each frequency above 0, relative to that of white noise of variance 1."""
        residual = score(pixel, values, nothing.add(pixel, values), sensitivity, block) + added
        return np.abs(rfft(residual)[1:][between]) ** 2 / (block * samples)

    random = np.random.default_rng(0)
    white_noise = (residual_power(random.standard_normal(pixel.size)) for _ in range(TRANSMISSION_DRAWS))
    transmission = np.mean([np.bincount(octave, power) / number for power in white_noise], axis=0)
    information = free * float(np.mean(sum_blocks(sensitivity**2, pixel, block)))
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
    drift = solve_window(pixel, intensity, nothing, model)
    corrected, relative = model.remove(intensity, drift), drift / model.level
    return (
        fit_drift_model(pixel, corrected, nothing, model.rate, model.block, model.kind, relative, model.lines) or model
    )


def simulate_errors(
    pixel: NDArray[np.int32], corrected: Array, nothing: SceneSums, model: DriftModel
) -> tuple[float, float]:
    """Standard deviation of the drift of a block, and the factor of the noise of :class:`IntensityDrift`.

    A drift and noise of the fitted spectrum are drawn and solved on the same path, so that both contain what the
    crossings of this scan determine. White noise has at least the scatter of the samples without the drift: a spectrum
    that is none of the model's can leave nothing for it. The error is larger by the factor by which the residuals of
    the recorded samples show more drift than those of the simulated ones: by the detail of the scene within pixels.

    Args:
        pixel: as in :func:`fit_drift_model`.
        corrected: samples without the drift, shape (n,).
        nothing: sums without samples.
        model: with its spectrum.
    """
    inside = np.where(pixel < nothing.number.size - 1, pixel, np.int32(-1))
    measured = measure_sample_noise(inside, corrected)
    sums = nothing.add(pixel, corrected)
    scatter = float(np.mean(measured.variance(sums.mean[pixel[inside >= 0]]))) if measured is not None else 0.0
    noise = np.sqrt(max(model.white * model.rate * model.block, scatter))
    random, blocks = np.random.default_rng(0), pixel.size // model.block
    frequency = rfftfreq(2 * blocks, 1.0 / model.rate)  # the second half separates end and beginning
    precision = model.precision(frequency)
    power = np.divide(1.0, precision, out=np.zeros(frequency.size), where=precision > 0.0)
    drift = irfft(rfft(random.standard_normal(2 * blocks)) * np.sqrt(power), 2 * blocks)[:blocks]
    sensitivity = model.sensitivity(sums)
    effect = sensitivity[pixel]
    drawn = effect * np.repeat(drift, model.block) + noise * random.standard_normal(pixel.size)
    found = solve_linear(pixel, drawn, np.ones(blocks), nothing, sensitivity, model)
    sd = float(np.std(found - drift)) / model.level
    without = drawn - effect * np.repeat(found - np.mean(found - drift), model.block)
    scattered, means = measure_sample_noise(inside, without), nothing.add(pixel, without)
    expected = _drift_by_residuals(pixel, without, nothing, sensitivity, model)
    observed = _drift_by_residuals(pixel, corrected, nothing, sensitivity, model)
    excess = max(observed / expected, 1.0) if expected > 0.0 else 1.0
    if scattered is None:
        return excess * sd, 1.0
    number, error = means.number[:-1], means.mean[:-1]
    visited = number > 0.0
    expected = float(np.sum(scattered.variance(error[visited]) / number[visited]))
    factor = max(float(np.sum(error**2)) / expected, 1.0) if expected > 0.0 else 1.0
    return excess * sd, 1.0 + (factor - 1.0) * excess**2


def _drift_by_residuals(
    pixel: NDArray[np.int32], values: Array, nothing: SceneSums, sensitivity: Array, model: DriftModel
) -> float:
    """Standard deviation of the drift that samples show if the residuals of each pixel have a random sign.

    Noise and the detail of the scene within pixels are as large with either sign; a drift, which pixels share, cancels.

    Args:
        pixel, nothing, model: as in :func:`simulate_errors`.
        values: samples, shape (n,).
        sensitivity: of each pixel to the drift, shape (pixels,).
    """
    random, weight = np.random.default_rng(0), np.ones(pixel.size // model.block)
    residual = values - nothing.add(pixel, values).mean[pixel]
    signs = (random.choice([-1.0, 1.0], sensitivity.size)[pixel] for _ in range(SIGN_DRAWS))
    found = [solve_linear(pixel, sign * residual, weight, nothing, sensitivity, model) for sign in signs]
    return float(np.std(found))


def _relative_values(drift: Array, model: DriftModel) -> Array:
    """Drift of each block as :class:`IntensityDrift` states it, of shape (blocks,)."""
    gain = model.gain(drift)
    return drift - drift.mean() if model.kind == "offset" else gain / gain.mean() - 1.0


def _fill_blocks(
    pixel: NDArray[np.int32], intensity: Array, pixels: int, block: int
) -> tuple[NDArray[np.int32], Array]:
    """Samples of whole blocks; those without a pixel or a value, and those added, get one pixel more, the last."""
    used, missing = (pixel >= 0) & np.isfinite(intensity), -pixel.size % block
    pixel = np.pad(np.where(used, pixel, np.int32(pixels)), (0, missing), constant_values=pixels)
    return pixel, np.pad(np.where(used, intensity, 0.0), (0, missing))
