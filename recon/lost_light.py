"""Samples lost from the intensity alone: from some time on it comes too early, and no phase shows it.

Forward and backward sweeps then disagree from there on, by a delay that is common to both axes and a whole number of
samples. How many they are tells the picture of what came before: along the beam's path it predicts the intensity, at
one delay and no other. Samples of one place at two times are compared, and no sharpness of a picture is looked at.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.mapping import Grid, map_samples, pixel_index
from recon.registration import PhaseError, registered, slow_period
from scanner.channel import Channel, Lazy
from scanner.motion import Motion
from scanner.recording import Recording

Array = NDArray[np.float64]

AXES = ("x", "y")
TOGETHER = 0.5  # samples: a delay below it is none
PERIODS = 4.0  # of the slower axis: delays looked for, either way
PIXEL = 2  # of the picture's, to one that predicts
COMPARED = 6000  # samples, at each delay
ALIKE = 0.5  # correlation of prediction and intensity at the delay
ALONE = 0.1  # by which it is above the correlation at any other
APART = 8  # samples to another delay
SURE = 12.0  # noise variances, by which the place of the loss is worse elsewhere


class Loss(NamedTuple):
    """``missing`` samples were lost somewhere from sample ``first`` up to ``stop``; below 0, as many are too many."""

    first: int
    stop: int
    missing: int


def delays(seen: Sequence[PhaseError], motion: Motion) -> Array:
    """By how many samples the intensity comes too early in each slice, shape (slices,); NaN where none can be told."""
    rate = motion.axes["x"].angle.sample_rate
    told = np.array([[getattr(each, axis) for axis in AXES] for each in seen])  # (slices, axes, value and sd)
    turn = 2 * np.pi * np.array([np.median(motion.axes[axis].frequency) for axis in AXES]) / rate
    weight = (turn / np.maximum(told[..., 1], 1e-9)) ** 2  # a picture without noise may leave nothing in doubt
    value = np.where(weight > 0, told[..., 0], 0.0) / turn
    total = weight.sum(1)
    return np.divide((weight * value).sum(1), total, out=np.full(len(seen), np.nan), where=total > 0)


def on_time(seen: Sequence[PhaseError], motion: Motion) -> NDArray[np.bool_]:
    """Which slices agree with their motion, shape (slices,)."""
    return np.abs(delays(seen, motion)) < TOGETHER


def apart(motion: Motion, intensity: Channel, grid: Grid, slices: int) -> list[PhaseError]:
    """Each of equal slices registered by itself: in a picture that they share, one that is late disturbs the others."""
    edges = _edges(intensity, slices)
    return [error for part in pairwise(edges) for error in registered(motion, intensity, grid, [part])]


def torn(seen: Sequence[PhaseError], motion: Motion) -> int | None:
    """The first slice from which on none agrees with its motion, while all before do; None where it is not so."""
    early = ~on_time(seen, motion)
    first = int(np.argmax(early))
    return first if 0 < first < len(seen) - 1 and early[first:].all() else None


def lost_light(beam: Motion, intensity: Channel, grid: Grid, slices: int, first: int) -> Loss | None:
    """What was lost before slice ``first`` + 1 of equal ``slices`` and behind slice ``first`` - 1.

    Args:
        beam: its places on the intensity's clock.
        first: as :func:`torn` gives it.

    Returns:
        None where the picture before predicts the intensity behind at no delay, or at several.
    """
    edges = _edges(intensity, slices)
    coarse = Grid(max(1, grid.width // PIXEL), max(1, grid.height // PIXEL), grid.half_angle_x, grid.half_angle_y)
    begin, end = edges[first + 1], (edges[first + 1] + edges[first + 2]) // 2  # half a slice: room for delays behind
    light = intensity.read(0, end)
    light = light if light.ndim == 1 else light.mean(axis=1)
    light[~np.isfinite(light)] = np.nan
    reach = math.ceil(PERIODS * slow_period(beam) * intensity.sample_rate)
    x, y = (beam.axes[axis].angle.read(0, end + reach) for axis in AXES)
    sure = slice(0, edges[first])
    picture = map_samples(x[sure], y[sure], light[sure], coarse).image.astype(float)
    column, row = pixel_index(x, grid.half_angle_x, coarse.width), pixel_index(y, grid.half_angle_y, coarse.height)
    predicted = np.where((column >= 0) & (row >= 0), picture[row, column], np.nan)
    count = _delay(predicted, light, begin, reach)
    return None if count is None else _place(predicted, light, edges[first - 1], begin, count)


def _edges(intensity: Channel, slices: int) -> list[int]:
    return [intensity.size * k // slices for k in range(slices + 1)]


def _delay(predicted: Array, light: Array, begin: int, reach: int) -> int | None:
    """Samples by which the light from ``begin`` on is early; None where that is none, or cannot be told."""
    at = np.arange(begin, light.size, max(1, (light.size - begin) // COMPARED))
    lags = np.arange(-min(reach, begin), min(reach, predicted.size - light.size) + 1)
    alike = np.array([_correlation(predicted[at + lag], light[at]) for lag in lags.tolist()])
    best = int(np.argmax(alike))
    others = alike[np.abs(lags - lags[best]) >= APART]
    told = alike[best] > ALIKE and alike[best] > others.max(initial=0.0) + ALONE
    return int(lags[best]) or None if told else None


def _correlation(one: Array, other: Array) -> float:
    both = np.isfinite(one) & np.isfinite(other)
    if np.count_nonzero(both) < 100:
        return 0.0
    one, other = one[both] - one[both].mean(), other[both] - other[both].mean()
    return float(one @ other / max(math.sqrt(float(one @ one) * float(other @ other)), 1e-300))


def _place(predicted: Array, light: Array, first: int, stop: int, count: int) -> Loss:
    """Where from ``first`` to ``stop`` the loss lies: before it the light is on time, behind it ``count`` early."""
    at = np.arange(max(first, -count), stop)
    before, behind = (np.square(predicted[at + lag] - light[at]) for lag in (0, count))
    both = np.isfinite(before) & np.isfinite(behind)
    cost = np.concatenate([[0.0], np.cumsum(np.where(both, before - behind, 0.0))])
    noise = float(np.median(np.minimum(before, behind)[both])) / 0.45 if both.any() else 0.0
    near = np.flatnonzero(cost <= cost.min() + SURE * noise)
    return Loss(int(at[0] + near[0]), int(at[0] + near[-1]) + 1, count)


def put_back(recording: Recording, loss: Loss) -> Recording:
    """The recording with an intensity that is on time again; where it is not known on which side, it has a gap."""
    channel = recording["intensity"]
    end, begin = min(loss.first, loss.stop + loss.missing), loss.stop + loss.missing  # of what stays; of what moves

    def whole(first: int, stop: int) -> Array:
        out = np.full((stop - first, *channel.shape[1:]), np.nan)
        if first < end:
            out[: end - first] = channel.read(first, min(stop, end))
        if stop > begin:
            moved = max(first, begin)
            out[moved - first :] = channel.read(moved - loss.missing, stop - loss.missing)
        return out

    shape = channel.size + loss.missing, *channel.shape[1:]
    raw = Lazy(shape, np.dtype(np.float64), whole)
    late = replace(channel, raw=raw, first=0, stop=shape[0], gain=1.0, offset=0.0)
    return replace(recording, channels=MappingProxyType({**recording.channels, "intensity": late}))
