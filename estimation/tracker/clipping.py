"""Clipped samples: all that is known of them is on which side of a rail they are (censored data).

Without them the track is biased, because the remaining samples are selected by their own noise. Their log-likelihood is
expanded to second order about the signal that the present track predicts. In this expansion a clipped sample has a
value and a weight like any other (iteratively reweighted least squares). With these it enters its block's projection;
the track is computed again, and so on until it converges. The filter needs no change. The times at which a signal
crosses its rails are contained in this: the output of a comparator is a signal that is always beyond one of two rails.

Source: Tobin, Econometrica 26, 24 (1958).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estimation.tracker.demodulation import harmonic_basis, sample_offsets, sum_lines, whiten_projections
from estimation.tracker.kalman_filter import JUMP_NIS
from estimation.tracker.line_noise import DISTURBED_VARIANCE_RATIO
from estimation.tracker.linearisation import expected_projections
from estimation.tracker.observations import BlockObservations
from estimation.tracker.state_space import RATE_TERMS
from scanner.arrays import Array

MIN_WEIGHT = 1e-9
"""Weight of a sample at or below which it is left out: its position beyond the rail is certain and informs nothing."""


class SampleExpansion(NamedTuple):
    """Log-likelihood of samples to second order about a signal h, for noise of standard deviation s.

    Attributes:
        gradient: derivative by h, times s^2; y - h where y was measured, shape (samples,) [V].
        weight: minus the second derivative by h, times s^2; 1 where y was measured, shape (samples,).
    """

    gradient: Array
    weight: Array


def expand_samples(values: Array, rails: Array, h: Array, sd: float) -> SampleExpansion:
    """Expand the log-likelihood of samples about the signal ``h``; beyond the rails only the side is known.

    With z = (rail - h) / s and Q the upper tail of the normal distribution, ln Q(z) has the derivative -m by z, where
    m = density / Q is the inverse Mills ratio, and the second derivative -m (m - z), between 0 and -1.

    Args:
        values, h: shape (samples,) [V]. rails: shape (2,) [V]. sd: s [V].
    """
    from scipy.special import erfcx

    above, below = values > rails[1], values < rails[0]
    side = np.where(below, -1.0, 1.0)
    z = side * (np.select([above, below], [rails[1], rails[0]], h) - h) / sd
    m = np.sqrt(2.0 / np.pi) / erfcx(z / np.sqrt(2.0))
    inside = ~(above | below)
    gradient, weight = side * sd * m, np.clip(m * (m - z), 0.0, 1.0)
    return SampleExpansion(np.where(inside, values - h, gradient), np.where(inside, 1.0, weight))


class ProjectedExpansion(NamedTuple):
    """Projection of one block's samples, expanded about a track.

    Attributes:
        sums, moments: as ``sums`` and ``grams`` in ``Projections``, shapes (m,) and (3, m, m).
        gradient: of the log-likelihood by the lines, times s^2, shape (m,).
        variance: of the noise about the best fitting lines [V^2].
    """

    sums: Array
    moments: Array
    gradient: Array
    variance: float


def project_expansion(
    values: Array, rails: Array, table: Array, offset: Array, expected: Array, sd: float
) -> ProjectedExpansion:
    """Expand a block's samples about the expected lines and project them.

    The noise variance is the one for which the sum of squared gradients equals the sum of weights (their expectations
    are equal, by the information identity).

    Args:
        values: samples, shape (n,) [V]. rails: shape (2,) [V]. table: B' at them, shape (m, n).
        offset: times from the block's middle, shape (n,) [s].
        expected: lines and their derivatives, see ``expected_projections``, shape (3, m). sd: of the noise [V].
    """
    h = sum_lines(expected, table, offset)
    gradient, weight = expand_samples(values, rails, h, sd)
    used = weight > MIN_WEIGHT
    table, offset, h, gradient, weight = table[:, used], offset[used], h[used], gradient[used], weight[used]
    weighted = table * weight
    moments = (np.concatenate([weighted, weighted * offset, weighted * offset * offset]) @ table.T).reshape(
        3, len(table), -1
    )
    line_gradient = table @ gradient
    rest = gradient - (np.linalg.pinv(moments[0], hermitian=True) @ line_gradient) @ weighted
    variance = float(rest @ rest) / max(float(weight.sum()) - len(table), 1.0)
    return ProjectedExpansion(table @ (weight * h) + line_gradient, moments, line_gradient, variance)


def linearise_clipped_blocks(observations: BlockObservations, states: Array) -> BlockObservations:
    """The observations with all clipped blocks projected again, expanded about a track.

    The noise variance of a block that misfits the track is increased in proportion, so that the next track approaches
    the block gradually instead of admitting a jump.

    Args:
        states: of the track, shape (blocks, states).
    """
    signal, channel, clipped = observations.signal, observations.sense.channel, observations.clipped
    length, parameter_rows = round(signal.step * channel.sample_rate), observations.parameter_rows
    offset, sd = sample_offsets(length, channel.sample_rate), float(np.sqrt(observations.noise_var))
    rates = np.empty((len(parameter_rows), RATE_TERMS), np.complex128)
    expansions, table_w, table = [], np.full(signal.table_w.shape[1], np.nan), np.empty(0)
    for k, start, piece, rails in zip(*clipped, strict=True):
        values = channel.read(start, start + length)
        used = np.isfinite(values)
        used[: piece[0]] = used[piece[1] :] = False
        if (signal.table_w[k] != table_w).any():
            table_w = signal.table_w[k]
            table = harmonic_basis(length, channel.sample_rate, signal.lines, table_w)
        expected, _ = expected_projections(parameter_rows, signal, k, states[k], rates)
        expansions.append(project_expansion(values[used], rails, table[:, used], offset[used], expected, sd))
    sums, moments, gradients, variance = (np.array(field) for field in zip(*expansions, strict=True))
    variance[clipped.rails[:, 0] == clipped.rails[:, 1]] = observations.noise_var  # a comparator has no residuals
    white, roots, whiteners, solvers = whiten_projections(sums, moments, np.arange(len(sums)), signal.spectrum)
    misfit = np.mean(np.einsum("kij,kj->ki", whiteners, gradients) ** 2, axis=1) / observations.noise_var
    noise = signal.noise_var.copy()
    noise[clipped.block] = variance
    typical = float(np.median(noise))
    noise[clipped.block] = np.maximum(
        np.where(variance > DISTURBED_VARIANCE_RATIO * typical, variance, typical),
        np.where(misfit > JUMP_NIS, misfit * typical, 0.0),
    )
    signal = signal.with_blocks(clipped.block, white, roots, solvers)
    return replace(observations, signal=signal._replace(noise_var=noise), noise_var=typical)
