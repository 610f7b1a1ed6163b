"""Samples of a position signal far from those around: a bit that flipped, a spark in a cable, or a loose contact.

Single ones are spikes, which :func:`find_spikes` replaces. Up to ``MAX_RUN_SAMPLES`` in a row are drop-outs, which
:func:`find_dropouts` marks as missing.
"""

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

MAX_RUN_SAMPLES = 16
"""Samples of the longest drop-out. A coarse converter at whose steps a signal stands still for as many changes in more
than a tenth of the samples, so that ``SCALE_QUANTILE`` contains its steps."""

SCALE_QUANTILE = 0.9
"""Quantile of the second differences that scales the limit of a drop-out. It contains steps that come every 20 samples
or more often, and no drop-outs, of four differences each, of up to 1 in 40 samples."""

NORMAL_QUANTILE = 1.6449
"""``SCALE_QUANTILE`` of the absolute values of a normal distribution, in standard deviations."""

MIN_RELATIVE_STEP = 2.0**-22
"""Smallest change between samples that counts as a step, in units of the largest sample: numbers of 32 bits are rounded
to a quarter of it, and no converter resolves it."""

ROUNDING_DISTANCE_STEPS = 4.0 / 3.0
"""Largest distance from the cubic that rounding to steps causes: half a step times the sum of the absolute weights."""

ROUNDING_BEND_STEPS = 2.0
"""The same of the second difference."""

MAX_VALUE = 1e100
"""Largest sample that is compared with others: no sensor gives larger ones, and their differences remain finite."""


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


def find_dropouts(channel: Channel) -> list[tuple[int, int]]:
    """Runs of 2 to ``MAX_RUN_SAMPLES`` samples, (first, stop), between which and both neighbours a signal jumps.

    The straight lines through the two samples before and the two after a run meet in its middle to better than the
    mean of both jumps: those of a step or of the flyback of a raster do not. A jump is larger than ``MIN_SPIKE_SDS``
    standard deviations of the second difference, so that noise, a sine and coarse samples have none.

    Args:
        channel: of shape (n,).
    """
    step = max(1, channel.size // MAX_NOISE_SAMPLES)
    typical = (np.abs(_second_differences(values))[::step] for _, values in _overlapping(channel))
    known = np.concatenate([np.zeros(0), *(each[np.isfinite(each)] for each in typical)])
    limit = MIN_SPIKE_SDS / NORMAL_QUANTILE * float(np.quantile(known, SCALE_QUANTILE)) if known.size else 0.0
    limit = max(limit, ROUNDING_BEND_STEPS * _step(channel)) if limit > 0.0 else 0.0
    runs = list[tuple[int, int]]()
    for begin, values in _overlapping(channel) if limit > 0.0 else ():
        _add_dropouts(runs, begin, values, limit)
    return [(first, stop) for first, stop in runs if stop - first > 1]


def _overlapping(channel: Channel) -> Iterator[tuple[int, Array]]:
    """Successive parts of a channel, NaN beyond ``MAX_VALUE``: number of the first sample, and the samples.

    A part has ``REACH`` samples more than ``READ_CHUNK_SAMPLES`` before it, and ``MAX_RUN_SAMPLES`` + ``REACH`` after.
    """
    for first in range(0, channel.size, READ_CHUNK_SAMPLES):
        begin = max(first - REACH, 0)
        values = channel.read(begin, first + READ_CHUNK_SAMPLES + MAX_RUN_SAMPLES + REACH)
        yield begin, np.where(np.abs(values) < MAX_VALUE, values, np.nan)


def _second_differences(values: Array) -> Array:
    """Of each sample and the two after it, shape (n - 2,)."""
    return np.asarray(values[:-2] - 2.0 * values[1:-1] + values[2:])


def _step(channel: Channel) -> float:
    """Smallest change from one sample to the next that is none of rounding, in the channel's unit.

    It bounds the step of a converter or of a text from above. A ramp without noise repeats its rounding, or has none
    except at its corners, so that its distances from the cubic state no scale.
    """
    largest = max(float(np.abs(values[np.isfinite(values)]).max(initial=0.0)) for _, values in _overlapping(channel))
    finest = MIN_RELATIVE_STEP * largest
    changes = (np.abs(np.diff(values)) for _, values in _overlapping(channel))
    step = min(float(each[each > finest].min(initial=np.inf)) for each in changes)
    return step if np.isfinite(step) else finest


def _add_dropouts(runs: list[tuple[int, int]], begin: int, values: Array, limit: float) -> None:
    """Add the drop-outs that begin in a part of a signal to those before, with single samples that are like these.

    Args:
        runs: ranges (first, stop), increasing.
        begin: number of the first sample of the part.
        values: of the part, shape (n,).
        limit: second difference that is a jump.
    """
    bends = _second_differences(values)  # of each sample and the two after it
    large = np.abs(bends) > limit
    into, out_of = np.flatnonzero(large) + REACH, np.flatnonzero(large)
    for first in into[into < READ_CHUNK_SAMPLES + REACH]:
        if runs and begin + first - REACH < runs[-1][1]:  # it would be what lies between two runs
            continue
        low, high = np.searchsorted(out_of, [first, first + MAX_RUN_SAMPLES])
        lasts = out_of[low:high]
        reach = 0.5 * (lasts - first) + 1.0  # from the next samples on either side to the middle of the run
        before = values[first - 1] + reach * (values[first - 1] - values[first - 2])
        after = values[lasts + 1] + reach * (values[lasts + 1] - values[lasts + 2])
        excess = np.abs(after - before) - 0.5 * (abs(bends[first - 2]) + np.abs(bends[lasts]))
        if (excess < 0.0).any():  # the shortest, as a longer one holds good samples between two runs
            runs.append((int(begin + first), int(begin + lasts[np.argmax(excess < 0.0)]) + 1))


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
    least = max(limit, ROUNDING_DISTANCE_STEPS * _step(channel)) if limit > 0.0 else 0.0
    index, repaired = [np.zeros(0, np.int64)], [np.zeros(0)]
    for first, values in _pieces(channel) if limit > 0.0 else ():
        distance = _distance(values)
        far = 2 * REACH + np.flatnonzero(np.abs(distance[inner]) > least)
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
