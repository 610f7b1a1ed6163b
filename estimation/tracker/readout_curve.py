"""A characteristic of the readout that the device file does not state, measured from two axes on one electrode.

A curved characteristic, or an amplifier that saturates, mixes the signals of both axes. It adds to the harmonics of
each axis, where it acts as another amplitude, and it adds lines at sums and differences of their frequencies, where the
motion has none. The curve is estimated from the latter: the samples are compared with the signal of the present track,
and everything that the harmonics of an axis explain is projected out of both the difference and the curve. So its
estimate hardly depends on the track's amplitude. The channel is then straightened, and the track computed again.

The curve is a linear spline of the signal whose slope is zero in the middle: a gain cannot be distinguished from that
of the readout. It is used if curves from one half of the blocks explain the other half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estimation.tracker.demodulation import harmonic_basis, sample_offsets, sum_lines
from estimation.tracker.linearisation import expected_projections
from estimation.tracker.observations import BlockLayout, BlockObservations
from estimation.tracker.state_space import RATE_TERMS
from scanner.arrays import Array, Index
from scanner.channel import Channel, LazySamples

CURVE_BLOCKS = 16
"""Blocks that the curve is estimated from, evenly spaced over a section. They determine it to a fiftieth of the noise
of a sample; the curve does not change with time."""
MIN_CURVE_BLOCKS = 4
"""Fewest blocks: two in each half, whose scatter shows whether an improvement is significant."""
TAIL_FRACTIONS = 0.4 * 0.5 ** np.arange(7)
"""Fractions of the samples beyond the knots of the spline, on each side: from the middle to rails that cut 1 %."""
MIN_GAIN_SDS = 3.0
"""Improvement of the left-out blocks, in its standard errors, from which a curve is used: 0.1 % of channels without a
curve exceed it."""
RAIL_SLOPE = 0.5
"""Slope of the characteristic below which the signal counts as clipped, half-way between a straight one and a rail."""


class ReadoutCurve(NamedTuple):
    """Characteristic of a readout relative to the one that the device states.

    Attributes:
        measured: values of the channel at the knots, increasing, shape (knots,) [V].
        straight: values that the stated readout would have given, shape (knots,) [V].
        rails: values of ``straight`` beyond which the signal is clipped, infinite for none, shape (2,) [V].
    """

    measured: Array
    straight: Array
    rails: Array

    def straighten(self, values: Array) -> Array:
        """Samples as the stated readout would have given them, clipped at the rails, of the same shape [V]."""
        shift = np.interp(values, self.measured, self.straight - self.measured)
        return np.clip(values + shift, *self.rails)


class _BlockEquations(NamedTuple):
    """Least-squares equations of the spline's coefficients, what harmonics explain projected out.

    Attributes:
        normal, right: shapes (blocks, k, k) and (blocks, k).
    """

    normal: Array
    right: Array


def fit_readout_curve(layout: BlockLayout, observations: BlockObservations, states: Array) -> ReadoutCurve | None:
    """The characteristic of the readout that the samples show against a track; None if they show none.

    Args:
        layout: of the channel. observations: of its blocks from the first one on.
        states: of the track, shape (blocks, states).
    """
    blocks = _chosen_blocks(observations)
    if len(observations.parameters) < 2 or blocks.size < MIN_CURVE_BLOCKS:
        return None
    samples = [_block_samples(layout, observations, states, k) for k in blocks]
    signal = np.concatenate([h for _, h, _ in samples])
    if signal.size == 0:  # a track that diverged, or blocks without a sample between the rails
        return None
    low, high = np.quantile(signal, TAIL_FRACTIONS), np.quantile(signal, 1.0 - TAIL_FRACTIONS)
    equations = _BlockEquations(
        *(np.stack(part) for part in zip(*(_project(*each, low, high) for each in samples), strict=True))
    )
    if not _explains_left_out_blocks(equations):
        return None
    down, up = np.split(_solve(equations), 2)  # slopes that each knot adds, outwards
    return _curve(low, high, down, up, float(signal.min()), float(signal.max()))


def straightened_channel(channel: Channel, curve: ReadoutCurve) -> Channel:
    """The channel as the stated readout would have given it. Samples are converted as they are read."""

    def fetch(first: int, stop: int) -> Array:
        return curve.straighten(channel.read(first, stop))

    raw = LazySamples((channel.size,), np.dtype(np.float64), fetch)
    return replace(channel, raw=raw, first=0, stop=channel.size, gain=1.0, offset=0.0)


def describe_curves(curves: Sequence[ReadoutCurve], channel: Channel) -> list[str]:
    """A line for the reader on the curves that were removed from a channel one after the other; none without curves."""
    if not curves:
        return []
    values = straight = curves[0].measured
    for curve in curves:
        straight = curve.straighten(straight)
    rails = np.array([curve.rails for curve in curves])
    limits = [("below", rails[:, 0].max()), ("above", rails[:, 1].min())]
    clipped = " and ".join(f"{word} {rail:.4g} {channel.unit}" for word, rail in limits if np.isfinite(rail))
    share = np.max(np.abs(values - straight)) / np.ptp(values)
    return [
        f"{channel.name} has a characteristic that the device file does not state, as lines at sums and differences of "
        f"the axes' frequencies show: curved by up to {100.0 * share:.2g} % of its range"
        f"{', and clipped ' + clipped if clipped else ''}. It was removed"
    ]


def _chosen_blocks(observations: BlockObservations) -> Index:
    """Up to ``CURVE_BLOCKS`` blocks with one drive throughout, evenly spaced."""
    steady = np.flatnonzero((observations.signal.drive_share == 0.5).all(axis=1))
    return steady[np.unique(np.linspace(0, steady.size - 1, min(CURVE_BLOCKS, steady.size)).round().astype(int))]


def _block_samples(
    layout: BlockLayout, observations: BlockObservations, states: Array, k: int
) -> tuple[Array, Array, Array]:
    """Differences [V], expected signal [V] and harmonics, shape (2 m, n), of the samples of a block that are used."""
    signal, channel, length = observations.signal, layout.sense.channel, layout.length
    first = round((observations.time[k] - channel.start) * channel.sample_rate - 0.5 * (length - 1))
    values = channel.read(first, first + length)
    offset = sample_offsets(length, channel.sample_rate)
    table = harmonic_basis(length, channel.sample_rate, signal.lines, signal.table_w[k])
    rates = np.empty((len(observations.parameters), RATE_TERMS), np.complex128)
    expected, _ = expected_projections(observations.parameter_rows, signal, k, states[k], rates)
    h = sum_lines(expected, table, offset)
    clipped = np.flatnonzero(observations.clipped.block == k)
    low, high = observations.clipped.rails[clipped[0]] if clipped.size else (-np.inf, np.inf)
    used = np.isfinite(values) & (h > low) & (h < high)  # by the expected signal: a choice by their noise is biased
    harmonics = np.concatenate([table, table * (offset / offset[-1])])
    return (values - h)[used], h[used], harmonics[:, used]


def _project(difference: Array, h: Array, harmonics: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Equations of one block, see ``_BlockEquations``; low, high: knots, outwards [V]."""
    basis = np.concatenate([np.maximum(low[:, None] - h, 0.0), np.maximum(h - high[:, None], 0.0)])
    targets = np.concatenate([basis, difference[None]])
    across = targets @ harmonics.T
    inverse = np.linalg.pinv(harmonics @ harmonics.T, hermitian=True)
    products = targets @ targets.T - across @ inverse @ across.T
    return products[:-1, :-1], products[:-1, -1]


def _solve(equations: _BlockEquations, used: Array | slice = slice(None)) -> Array:
    """Coefficients of the spline from some blocks, shape (k,)."""
    solution: Array = np.linalg.pinv(equations.normal[used].sum(axis=0), rcond=1e-9, hermitian=True)
    return solution @ equations.right[used].sum(axis=0)


def _explains_left_out_blocks(equations: _BlockEquations) -> bool:
    """Whether curves from one half of the blocks reduce the squared differences of the other half significantly."""
    gains = np.empty(len(equations.right))
    for half in (0, 1):
        curve, left_out = _solve(equations, slice(half, None, 2)), slice(1 - half, None, 2)
        quadratic = np.einsum("kij,i,j->k", equations.normal[left_out], curve, curve)
        gains[left_out] = 2.0 * equations.right[left_out] @ curve - quadratic
    return bool(gains.mean() > MIN_GAIN_SDS * gains.std(ddof=1) / np.sqrt(gains.size))


def _curve(low: Array, high: Array, down: Array, up: Array, lowest: float, highest: float) -> ReadoutCurve:
    """The characteristic from the slopes that each knot adds.

    A rail is set one knot inwards of the first one with less than ``RAIL_SLOPE``, so that noise does not carry samples
    beyond it to the inside.
    """
    straight = np.concatenate([[lowest], low[::-1], high, [highest]])
    deviation = np.maximum(low - straight[:, None], 0.0) @ down + np.maximum(straight[:, None] - high, 0.0) @ up
    rails = np.array([-np.inf, np.inf])
    for side, knots, slopes in ((0, low, 1.0 - np.cumsum(down)), (1, high, 1.0 + np.cumsum(up))):
        flat = np.flatnonzero(slopes < RAIL_SLOPE)
        if flat.size:
            rails[side] = knots[max(flat[0] - 1, 0)]
    used = (straight >= rails[0]) & (straight <= rails[1])
    return ReadoutCurve((straight + deviation)[used], straight[used], rails)
