"""Single samples of a position signal far from their neighbours: a bit that flipped, or a spark in a cable."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimation.signals import robust_sd
from scanner.arrays import Array, Index
from scanner.channel import READ_CHUNK_SAMPLES, Channel

MIN_SPIKE_SDS = 8.0
"""Distance of a spike from the cubic through its neighbours, in robust standard deviations of that distance: noise
exceeds it once in 1e15 samples, and a sine, whose largest distance is 1.4 times the median one, never."""

MAX_NOISE_SAMPLES = 1 << 20
"""Samples, evenly spaced, from which the noise is measured: they determine it to 0.1 %, with little memory."""

NEAR_WEIGHT, FAR_WEIGHT = 4.0 / 6.0, -1.0 / 6.0
"""Weights of the two next samples, and of those after them, in the cubic through the four around a sample."""

NEIGHBOURS = {-2: FAR_WEIGHT, -1: NEAR_WEIGHT, 1: NEAR_WEIGHT, 2: FAR_WEIGHT}
"""The same by distance."""

REACH = 2


class Spikes(NamedTuple):
    """Isolated spikes of a signal.

    Attributes:
        at: numbers of the samples, increasing, shape (m,).
        values: of the cubics through the neighbours there, shape (m,).
    """

    at: Index
    values: Array


def find_spikes(channel: Channel) -> Spikes:
    """Samples that are isolated spikes.

    Without a spike the neighbours on one side at least fit those around them. Those of a step or of the flyback of a
    raster do not. Spikes that are one or two samples apart are not found. A corner of a clipped signal is no spike.

    Args:
        channel: of shape (n,).
    """
    spikes = _find_far(channel, ())
    rails = _rails(channel, spikes.at) if spikes.at.size else []
    return _find_far(channel, rails) if rails else spikes  # clipped samples have no noise


def _pieces(channel: Channel) -> Iterator[tuple[int, Array]]:
    """Successive parts of a channel: number of the first sample, and the samples with 2 REACH more on either side."""
    last = channel.size - 2 * REACH
    for first in range(2 * REACH, last, READ_CHUNK_SAMPLES):
        yield first, channel.read(first - 2 * REACH, min(first + READ_CHUNK_SAMPLES, last) + 2 * REACH)


def _find_far(channel: Channel, rails: Sequence[float]) -> Spikes:
    """Samples far from the cubic whose neighbours fit, in the noise of all samples; none near one of the ``rails``."""
    inner, step = slice(2 * REACH, -2 * REACH), max(1, channel.size // MAX_NOISE_SAMPLES)
    typical = [np.zeros(0)]
    for first, values in _pieces(channel):
        distance = np.where(_near(values, rails), np.nan, _distance(values))[inner][-first % step :: step]
        typical.append(distance[np.isfinite(distance)])
    noise = np.concatenate(typical)
    limit = MIN_SPIKE_SDS * robust_sd(noise) if noise.size else 0.0
    index, repaired = [np.zeros(0, np.int64)], [np.zeros(0)]
    for first, values in _pieces(channel) if limit > 0.0 else ():
        distance = _distance(values)
        far = 2 * REACH + np.flatnonzero((distance[inner] > limit) | (distance[inner] < -limit))
        fits = {
            each: np.abs(distance[far + each] + weight * distance[far]) <= limit for each, weight in NEIGHBOURS.items()
        }
        far = far[((fits[-2] & fits[-1]) | (fits[1] & fits[2])) & ~_near(values, rails)[far]]
        index.append(first - 2 * REACH + far)
        repaired.append(values[far] - distance[far])
    return Spikes(np.concatenate(index), np.concatenate(repaired))


def _rails(channel: Channel, spikes: Index) -> list[float]:
    """The largest and the smallest value of all samples that are no spike, if successive ones stand at it."""
    pieces = [(np.nanmin(others), np.nanmax(others)) for others in _others(channel, spikes)]
    extremes = [float(min(low for low, _ in pieces)), float(max(high for _, high in pieces))]
    return [
        extreme
        for extreme in extremes
        if any(np.any((values[:-1] == extreme) & (values[1:] == extreme)) for _, values in _pieces(channel))
    ]


def _others(channel: Channel, spikes: Index) -> Iterator[Array]:
    """Successive parts of a channel without its spikes."""
    for first, values in _pieces(channel):
        begin = first - 2 * REACH
        low, high = np.searchsorted(spikes, [begin, begin + values.size])
        yield np.delete(values, spikes[low:high] - begin)


def _near(values: Array, rails: Sequence[float]) -> NDArray[np.bool_]:
    """Samples within reach of one at a rail, shape (n,): the cubic through it leaves the range of the converter."""
    near = np.zeros(values.size, np.bool_)
    for rail in rails:
        near |= np.convolve(values == rail, np.ones(2 * REACH + 1), "same") > 0.5
    return near


@njit(cache=True)
def _distance(values: Array) -> Array:
    """Each sample less the cubic through the two samples on either side, shape (n,); NaN at the ends."""
    out = np.full(values.size, np.nan)
    for i in range(REACH, values.size - REACH):
        near, far = values[i - 1] + values[i + 1], values[i - 2] + values[i + 2]
        out[i] = values[i] - NEAR_WEIGHT * near - FAR_WEIGHT * far
    return out
