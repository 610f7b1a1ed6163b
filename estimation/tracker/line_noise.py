"""Noise of a sense channel: of its samples, its spectrum near each harmonic, and the walk of the readout's offset.

The residuals of the blocks give the variance of the noise averaged over all frequencies. 1/f noise, hum, a resonance or
a pole of the amplifier make the noise at one harmonic larger than at another. With one variance for all of them the
tracker would attribute the excess to the motion or to the gain, and weight the harmonics wrongly.
"""

from __future__ import annotations

import numpy as np

from estimation.tracker.block_signal import MIN_OFFSET_DENSITY_V2_PER_S
from estimation.tracker.change_points import project_block
from estimation.tracker.demodulation import (
    NoiseSpectrum,
    Projections,
    harmonic_basis,
    residual_variance,
    sample_offsets,
)
from scanner.arrays import Array, Index
from scanner.channel import Channel

MAX_SPECTRUM_BLOCKS = 12
"""Blocks from which the noise near the lines is estimated, spread over the section: with some four independent values
each they determine a variance to 21 %. More would slow the tracker down."""

MODEL_ERROR_RATIO = 3e-3
"""Standard deviation of the model error within a block, over the signal's rms: bounds the assumed noise from below."""

DISTURBED_VARIANCE_RATIO = 1.5
"""Residual variance of a block, over the median one, above which the block counts as disturbed."""

MIN_DISTANCE_BINS, MAX_DISTANCE_BINS = 2.0, 5.0
"""Distances from a line at which the noise is measured, in units of the inverse length of a block: beyond what the fit
of line and slip removes, and near the line."""

HANN_BANDWIDTH_BINS = 1.5
"""Noise bandwidth of a Hann window in units of the inverse length: values this far apart count as independent."""

LOG_MEDIAN_SD = 1.44
"""Standard deviation of the logarithm of the median of n exponential variables, times the root of n: 1 / ln 2."""

MEDIAN_CHI_SQUARE = 0.455
"""Median of chi-square with one degree of freedom: of the square of a normal variable over its variance."""

CHI_SQUARE_MEDIAN_SD = 1.06
"""Standard deviation of the median of n such variables, times the root of n."""

MIN_INCREMENT_SDS = 2.0
"""Standard deviations by which the increments of the blocks' means exceed their noise where the tuning starts from an
offset that walks. 2 % of readouts at rest do; theirs takes a few more rounds."""

WHITE_PROBABILITY = 0.5
"""Prior probability that the noise near all lines has the variance of the samples: no preference either way."""

LOG_VARIANCE_SDS = np.array([0.1, 0.3, 1.0, 3.0])
"""Standard deviations of the log variances that coloured noise may have, equally probable: half decades from 10 %,
which changes no interval, to a factor of 20 in the variance."""


def model_error_variance(projections: Projections) -> float:
    """Return the variance of the model error within a block [V^2]."""
    samples = np.maximum(projections.counts, 1)
    signal_var = np.median(projections.squares / samples - (projections.sums[:, 0] / samples) ** 2)
    return MODEL_ERROR_RATIO**2 * float(signal_var)


def sample_noise_variance(
    projections: Projections,
    channel: Channel,
    starts: Index,
    pieces: Index,
    lines: Index,
    w: Array,
    noise_sd: float,
    model_error: float,
) -> tuple[Array, float]:
    """Return the variance of each block's samples, shape (blocks,), and the typical one [V^2].

    A block has the typical variance unless it is disturbed. Lines whose phase slips or whose amplitude decays within a
    block leave residuals about a stationary fit. Blocks that seem disturbed are therefore fitted again with two more
    lines beside each line, which follow such changes. In a gap no block has more samples than its lines have
    coefficients; the variances are 1 and NaN there.
    """
    variance = residual_variance(projections)
    variance[projections.rails[:, 0] == projections.rails[:, 1]] = noise_sd**2  # a comparator has no residuals
    if np.isnan(variance).all():
        return np.ones(starts.size), np.nan
    typical = max(float(np.nanmedian(variance)), model_error)
    length = int(pieces[:, 1].max())
    sideband = channel.sample_rate / length  # [rad/s]: a slip of 1 rad over the block
    axes = w.shape[1]
    extended = np.concatenate([*(lines + np.array([i * axes, 0]) for i in range(3)), [[3 * axes, 1]]])
    for k in np.flatnonzero(variance > DISTURBED_VARIANCE_RATIO * typical):
        omega = np.concatenate([w[k], w[k] - sideband, w[k] + sideband, [np.pi * sideband]])
        block = project_block(channel, int(starts[k]), pieces[k], length, extended, omega)
        variance[k] = residual_variance(block)[0]
    return np.where(variance > DISTURBED_VARIANCE_RATIO * typical, variance, typical), typical


def line_noise_variance(
    projections: Projections, channel: Channel, starts: Index, length: int, lines: Index, noise_var: float
) -> Array:
    """Variance of white noise that is as dense as the noise near the constant and near each line.

    It is read from the periodograms of the blocks' residuals about a fit of the lines and their slips. The median over
    blocks and bins is used, because disturbed blocks and harmonics of the motion that no line models are not noise.
    ``shrink_to_white`` then weighs it against the variance of the samples.

    Args:
        projections: of the blocks that begin at the samples ``starts``, shape (blocks,).
        length: of a block [samples].
        lines: (reference, order) of each line, shape (lines, 2).
        noise_var: of a sample [V^2].

    Returns:
        Shape (1 + lines,) [V^2]; ``noise_var`` without an undisturbed block.
    """
    regular = np.flatnonzero((projections.counts == length) & (projections.clipped_counts == 0))
    if not regular.size or not noise_var > 0.0:
        return np.full(1 + len(lines), noise_var)
    chosen = regular[np.linspace(0, regular.size - 1, min(regular.size, MAX_SPECTRUM_BLOCKS)).astype(int)]
    geometry = projections.geometry[chosen]
    values: list[list[Array]] = [[] for _ in range(1 + len(lines))]
    weights: list[list[Array]] = [[] for _ in range(1 + len(lines))]
    for g in np.unique(geometry):
        mine = chosen[geometry == g]
        samples = np.stack([channel.read(int(starts[k]), int(starts[k]) + length) for k in mine])
        table_w, moments = projections.table_w[mine[0]], projections.grams[g]
        for j, (power, share) in enumerate(_periodograms(samples, channel.sample_rate, lines, table_w, moments)):
            values[j].append(power.ravel())
            weights[j].append(np.broadcast_to(share, power.shape).ravel())
    medians, sums = np.array(
        [_weighted_median(np.concatenate(v), np.concatenate(w)) for v, w in zip(values, weights, strict=True)]
    ).T
    known = sums > 0.0
    log_ratio = np.zeros(sums.size)
    log_ratio[known] = np.log(np.maximum(medians[known] / (np.log(2.0) * noise_var), np.finfo(float).tiny))
    counts = sums * length / (HANN_BANDWIDTH_BINS * _padded_length(length))
    variance = LOG_MEDIAN_SD**2 / np.maximum(counts, np.finfo(float).eps)
    return noise_var * np.exp(shrink_to_white(log_ratio, variance))


def _weighted_median(values: Array, weights: Array) -> tuple[float, float]:
    """Value below which half of the weight lies, and the sum of the weights."""
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(below, 0.5 * below[-1])]]), float(below[-1])


def _padded_length(length: int) -> int:
    """Length of the Fourier transform of a block, which is fast: four to eight times a power of two."""
    step = 1 << max(length.bit_length() - 3, 0)
    return -(-length // step) * step


def _periodograms(
    samples: Array, rate: float, lines: Index, table_w: Array, moments: Array
) -> list[tuple[Array, Array]]:
    """Powers near the constant and each line, of the residuals about the fit of lines and slips [V^2].

    The transform of the residuals is that of the samples minus the fit's coefficients times those of its rows.

    Args:
        samples: of the blocks, shape (blocks, length) [V].
        lines: (reference, order) of each line, shape (lines, 2). table_w: shape (references,) [rad/s].
        moments: of the blocks, see ``Projections.grams``, shape (3, m, m).

    Returns:
        By line: powers, shape (blocks, bins), of which the mean of white noise is its variance, and the part of white
        noise that the fit leaves in each bin, divided among the lines that use the bin, shape (bins,).
    """
    length = samples.shape[1]
    per_second, padded = rate / length, _padded_length(length)
    position = sample_offsets(length, rate) * per_second
    window = np.cos(np.pi * position) ** 2
    table = harmonic_basis(length, rate, lines, table_w)
    rows = table, table * position
    plain, slope, square = moments * per_second ** np.arange(3)[:, None, None]
    inverse_gram = np.linalg.pinv(np.block([[plain, slope], [slope, square]]), hermitian=True)
    line_bins = np.append(0.0, table_w[lines[:, 0]] * lines[:, 1]) / (2.0 * np.pi) * length / rate
    distance = np.abs(np.arange(padded // 2 + 1) * length / padded - line_bins[:, None])
    near = (distance >= MIN_DISTANCE_BINS) & (distance <= MAX_DISTANCE_BINS)
    used = np.flatnonzero(near.any(axis=0))
    *of_rows, of_samples = (np.fft.rfft(window * each, padded)[:, used] for each in (*rows, samples))
    transformed = np.concatenate(of_rows)
    solved = inverse_gram @ transformed
    residual = of_samples - np.concatenate([samples @ each.T for each in rows], axis=1) @ solved
    fitted = np.sum(transformed.conj() * solved, axis=0).real / np.sum(window**2)
    left = np.maximum(1.0 - fitted, np.finfo(float).eps)
    power = np.abs(residual) ** 2 / (left * np.sum(window**2))
    share = left / near.sum(axis=0)[used]
    return [(power[:, mine], share[mine]) for mine in near[:, used]]


def shrink_to_white(log_ratio: Array, variance: Array) -> Array:
    """Posterior mean of the logarithms of variances, relative to that of the samples.

    White noise has zeros; in coloured noise they are normal about zero with one of ``LOG_VARIANCE_SDS``. A few blocks
    or lines thus do not make white noise coloured (empirical Bayes, Efron and Morris 1973, with a prior of the spread).

    Args:
        log_ratio: measured, shape (lines,). variance: of its errors, shape (lines,).
    """
    spread = np.append(0.0, LOG_VARIANCE_SDS**2)[:, None]
    prior = np.append(
        WHITE_PROBABILITY, np.full(LOG_VARIANCE_SDS.size, (1 - WHITE_PROBABILITY) / LOG_VARIANCE_SDS.size)
    )
    total = spread + variance
    log_weight = np.log(prior) - 0.5 * np.sum(np.log(total) + log_ratio**2 / total, axis=1)
    weight = np.exp(log_weight - log_weight.max())
    return np.asarray(log_ratio * (weight @ (spread / total)) / weight.sum())


def noise_spectrum(line_noise: Array, noise_var: float, length: int) -> NoiseSpectrum:
    """Spectrum of the noise from the variances of ``line_noise_variance``; white where they are not known.

    Args:
        line_noise: shape (1 + lines,) [V^2].
        noise_var: of a sample, NaN in a gap [V^2].
        length: of a block [samples].
    """
    if not ((np.isfinite(line_noise) & (line_noise > 0.0)).all() and noise_var > 0.0):
        return NoiseSpectrum(1.0, np.zeros(2 * line_noise.size - 1))
    white = float(line_noise.min())
    excess = np.repeat(line_noise - white, 2)[1:] * 2.0 / length  # a cosine has the square sum length / 2
    excess[0] /= 2.0
    return NoiseSpectrum(white / noise_var, excess / noise_var)


def initial_offset_density(means: Array, samples: float, noise_var: float, step: float) -> float:
    """Density of a random walk of the offset whose increments are as large as those of the blocks' means [V^2/s].

    The tuning starts from it. From a small density it would first attribute hum to the motion, and end there. The
    median of the increments is removed, because a steady drift of the amplitude changes the mean as well.

    Args:
        means: of consecutive blocks, shape (blocks,) [V]. samples: typical number in a block.
        noise_var: variance of white noise as dense as the noise near the constant [V^2].
        step: from block to block [s].
    """
    if means.size < 2:
        return MIN_OFFSET_DENSITY_V2_PER_S
    increments, noise = np.diff(means), 2.0 * noise_var / samples
    variance = float(np.median((increments - np.median(increments)) ** 2)) / MEDIAN_CHI_SQUARE
    error = noise * CHI_SQUARE_MEDIAN_SD / MEDIAN_CHI_SQUARE / np.sqrt(increments.size)
    if variance - noise < MIN_INCREMENT_SDS * error:
        return MIN_OFFSET_DENSITY_V2_PER_S
    return max((variance - noise) / step, MIN_OFFSET_DENSITY_V2_PER_S)
