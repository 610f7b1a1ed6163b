"""Samples beyond a rail: what is known of them is that they lie there (Tobin, Econometrica 26, 24, 1958).

Left out altogether they bias the track, because the samples left are a choice by their own noise. Their log-likelihood
is expanded to second order about the signal that the track so far tells, in which a sample beyond a rail has a value
and a weight like any other (iteratively reweighted least squares). With these it enters its block's projection, the
track is made anew, and so on until it stays; the smoother need not know. The times at which a signal meets its rails
are in this: a comparator's output is a signal that is always beyond one of two.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimation.tracker.blocks import basis, offsets
from estimation.tracker.linear import expected
from estimation.tracker.signal import DISTURBED, Prepared, whitened
from estimation.tracker.smoother import MISFIT
from estimation.tracker.step import RATES

Array = NDArray[np.float64]

UNHEARD = 1e-9  # weight of a sample that is so surely beyond its rail that it tells nothing


class Expanded(NamedTuple):
    """Samples' log-likelihood to second order about a signal h, with noise of standard deviation s.

    Attributes:
        pull: slope by h, times s^2: y - h where y was measured, shape (samples,) [V].
        weight: minus the curvature by h, times s^2: 1 where y was measured, shape (samples,).
    """

    pull: Array
    weight: Array


def expanded(values: Array, rails: Array, h: Array, sd: float) -> Expanded:
    """Expansion about ``h`` for samples of which nothing but the side is known beyond ``rails`` (2,), all in [V].

    With z the distance from h to the rail over s and Q the normal distribution's upper tail, ln Q(z) has the slope -m,
    m = density / Q the inverse of Mills' ratio, and the curvature -m (m - z), between 0 (surely beyond) and -1.
    """
    from scipy.special import erfcx

    above, below = values > rails[1], values < rails[0]
    side = np.where(below, -1.0, 1.0)
    z = side * (np.select([above, below], [rails[1], rails[0]], h) - h) / sd
    m = np.sqrt(2.0 / np.pi) / erfcx(z / np.sqrt(2.0))
    inside = ~(above | below)
    pull, weight = side * sd * m, np.clip(m * (m - z), 0.0, 1.0)
    return Expanded(np.where(inside, values - h, pull), np.where(inside, 1.0, weight))


class Weighted(NamedTuple):
    """One block's samples as what they are worth about a track.

    Attributes:
        sums, moments: as in ``blocks.Projections``, shapes (m,) and (3, m, m).
        slope: of the log-likelihood by the lines, times s^2, shape (m,).
        variance: of the noise about the lines that fit best [V^2].
    """

    sums: Array
    moments: Array
    slope: Array
    variance: float


def weighted(values: Array, rails: Array, table: Array, offset: Array, told: Array, sd: float) -> Weighted:
    """Samples expanded about what a track tells, projected.

    The noise is found by what makes the curvatures the slopes' squares, as likelihood has it.

    Args:
        values: samples, shape (n,) [V]. table: B' at them, shape (m, n). offset: times from the block's middle [s].
        told: lines and their derivatives, see ``linear.expected``, shape (3, m). sd: of the noise [V].
    """
    lines = told @ table
    h = lines[0] + offset * (lines[1] + offset * lines[2])
    pull, weight = expanded(values, rails, h, sd)
    heard = weight > UNHEARD
    table, offset, h, pull, weight = table[:, heard], offset[heard], h[heard], pull[heard], weight[heard]
    own = table * weight
    moments = (np.concatenate([own, own * offset, own * offset * offset]) @ table.T).reshape(3, len(table), -1)
    slope = table @ pull
    rest = pull - (np.linalg.pinv(moments[0], hermitian=True) @ slope) @ own
    variance = float(rest @ rest) / max(float(weight.sum()) - len(table), 1.0)
    return Weighted(table @ (weight * h) + slope, moments, slope, variance)


def expanded_about(prepared: Prepared, states: Array) -> Prepared:
    """The blocks with samples beyond a rail projected anew, these expanded about a track; shape (blocks, states).

    A block that misfits the track counts for so much less, so that the next one comes nearer instead of jumping.
    """
    signal, channel, clipped = prepared.signal, prepared.sense.channel, prepared.clipped
    length = round(signal.step * channel.sample_rate)
    offset, sd = offsets(length, channel.sample_rate), float(np.sqrt(prepared.noise_var))
    rates = np.empty((len(prepared.rows), RATES), np.complex128)
    found, tuned, table = [], np.full(signal.tuned.shape[1], np.nan), np.empty(0)
    for k, start, piece, rails in zip(*clipped, strict=True):
        values = channel.read(start, start + length)
        used = np.isfinite(values)
        used[: piece[0]] = used[piece[1] :] = False
        if (signal.tuned[k] != tuned).any():
            tuned = signal.tuned[k]
            table = basis(length, channel.sample_rate, signal.lines, tuned)
        told, _ = expected(prepared.rows, signal, k, states[k], rates)
        found.append(weighted(values[used], rails, table[:, used], offset[used], told, sd))
    sums, moments, slopes, own = (np.array(each) for each in zip(*found, strict=True))
    own[clipped.rails[:, 0] == clipped.rails[:, 1]] = prepared.noise_var  # a comparator tells no volts
    white, roots, unroots = whitened(sums, moments, np.arange(len(sums)))
    misfit = np.mean(np.einsum("kij,ki->kj", unroots, slopes) ** 2, axis=1) / prepared.noise_var
    noise = signal.noise_var.copy()
    noise[clipped.block] = own
    usual = float(np.median(noise))
    noise[clipped.block] = np.maximum(
        np.where(own > DISTURBED * usual, own, usual), np.where(misfit > MISFIT, misfit * usual, 0.0)
    )
    signal = signal.with_blocks(clipped.block, white, roots, unroots)
    return replace(prepared, signal=signal._replace(noise_var=noise), noise_var=usual)
