"""Noise of the projections: its spectrum near each harmonic of the motion, and the walk of the readout's offset.

The residuals of the blocks give the variance of the noise averaged over all frequencies. 1/f noise, hum, a resonance or
a pole of the amplifier make the noise at one harmonic larger than at another. With one variance for all of them the
tracker would attribute the excess to the motion or to the gain, and weight the harmonics wrongly.
"""

from __future__ import annotations

import numpy as np

from estimation.tracker.block_signal import MIN_OFFSET_DENSITY_V2_PER_S
from estimation.tracker.demodulation import (
    NoiseSpectrum,
    Projections,
    harmonic_basis,
    least_squares_coefficients,
    sample_offsets,
)
from scanner.arrays import Array, Index
from scanner.channel import Channel

MAX_SPECTRUM_BLOCKS = 24
"""Blocks from which the noise near the lines is estimated, spread over the section: with some four independent values
each they determine a variance to 15 %. More would slow the tracker down."""

MIN_DISTANCE_BINS, MAX_DISTANCE_BINS = 2.0, 5.0
"""Distances from a line at which the noise is measured, in units of the inverse length of a block: beyond what the fit
of line and slip removes, and near the line."""

HANN_BANDWIDTH_BINS = 1.5
"""Noise bandwidth of a Hann window in units of the inverse length: values this far apart count as independent."""

LOG_MEDIAN_SD = 1.44
"""Standard deviation of the logarithm of the median of n exponential variables, times the root of n: 1 / ln 2."""

MEDIAN_CHI_SQUARE = 0.455
"""Median of chi-square with one degree of freedom: of the square of a normal variable over its variance."""


def line_noise_variance(projections: Projections, channel: Channel, starts: Index, length: int, lines: Index) -> Array:
    """Variance of white noise that is as dense as the noise near the constant and near each line.

    It is read from the periodograms of the blocks' residuals about a fit of the lines and their slips. The median over
    blocks and bins is used, because disturbed blocks and harmonics of the motion that no line models are not noise. The
    logarithms are shrunk towards their mean by empirical Bayes (Efron and Morris 1973), so that white noise counts as
    white.

    Args:
        projections: of the blocks that begin at the samples ``starts``, shape (blocks,).
        length: of a block [samples].
        lines: (reference, order) of each line, shape (lines, 2).

    Returns:
        Shape (1 + lines,) [V^2]; NaN without an undisturbed block.
    """
    regular = np.flatnonzero((projections.counts == length) & (projections.clipped_counts == 0))
    if not regular.size:
        return np.full(1 + len(lines), np.nan)
    chosen = regular[np.linspace(0, regular.size - 1, min(regular.size, MAX_SPECTRUM_BLOCKS)).astype(int)]
    rate, offset, padded = channel.sample_rate, sample_offsets(length, channel.sample_rate), 1 << length.bit_length()
    window = np.cos(np.pi * offset * rate / length) ** 2
    powers: list[list[Array]] = [[] for _ in range(1 + len(lines))]
    table_w, fitted, white, near = np.full(projections.table_w.shape[1], np.nan), np.empty(0), np.empty(0), []
    for k in chosen:
        if (projections.table_w[k] != table_w).any():
            table_w = projections.table_w[k]
            table = harmonic_basis(length, rate, lines, table_w)
            fitted = np.linalg.qr(np.concatenate([table, table * offset]).T)[0]
            removed = sum(np.abs(np.fft.rfft(window * column, padded)) ** 2 for column in fitted.T)
            white = np.sum(window**2) - removed
            line_bins = np.append(0.0, table_w[lines[:, 0]] * lines[:, 1]) / (2.0 * np.pi) * length / rate
            distance = np.abs(np.arange(white.size) * length / padded - line_bins[:, None])
            near = [np.flatnonzero((d >= MIN_DISTANCE_BINS) & (d <= MAX_DISTANCE_BINS)) for d in distance]
        samples = channel.read(int(starts[k]), int(starts[k]) + length)
        residual = samples - fitted @ (fitted.T @ samples)
        power = np.abs(np.fft.rfft(window * residual, padded)) ** 2 / white
        for values, bins in zip(powers, near, strict=True):
            values.append(power[bins])
    counts = np.array([sum(map(np.size, values)) for values in powers])
    medians = np.array([np.median(np.concatenate(values)) for values in powers])
    log = np.log(np.maximum(medians / np.log(2.0), np.finfo(float).tiny))
    error = LOG_MEDIAN_SD**2 * HANN_BANDWIDTH_BINS * padded / length / counts
    differing = max(float(np.var(log, ddof=1) - error.mean()), 0.0)
    return np.asarray(np.exp(log.mean() + differing / (differing + error) * (log - log.mean())))


def noise_spectrum(line_noise: Array, noise_var: float, length: int) -> NoiseSpectrum:
    """Spectrum of the noise from the variances of ``line_noise_variance``; white where they are not known.

    Args:
        line_noise: shape (1 + lines,) [V^2].
        noise_var: of a sample [V^2].
        length: of a block [samples].
    """
    if not np.isfinite(line_noise).all():
        return NoiseSpectrum(1.0, np.zeros(2 * line_noise.size - 1))
    white = float(line_noise.min())
    excess = np.repeat(line_noise - white, 2)[1:] * 2.0 / length  # a cosine has the square sum length / 2
    excess[0] /= 2.0
    return NoiseSpectrum(white / noise_var, excess / noise_var)


def initial_offset_density(projections: Projections, noise_var: float, step: float) -> float:
    """Density of a random walk of the offset whose increments are as large as those of the blocks' means [V^2/s].

    The tuning starts from it. From a small density it would first attribute hum to the motion, and end there.

    Args:
        projections: of consecutive blocks.
        noise_var: variance of white noise as dense as the noise near the constant [V^2].
        step: from block to block [s].
    """
    used = projections.counts > projections.sums.shape[1]
    mean, counts = least_squares_coefficients(projections)[used, 0], projections.counts[used]
    if mean.size < 2:
        return MIN_OFFSET_DENSITY_V2_PER_S
    increments = float(np.median(np.diff(mean) ** 2)) / MEDIAN_CHI_SQUARE - 2.0 * noise_var / float(np.median(counts))
    return max(increments / step, MIN_OFFSET_DENSITY_V2_PER_S)
