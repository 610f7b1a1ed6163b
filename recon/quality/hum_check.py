"""Whether a position sensor shows only hum of the mains: what is left beside it is searched for lines."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.quality.line_search import PIECE_SAMPLES, search_lines
from scanner.arrays import Array
from scanner.channel import Channel, LazySamples

MAINS_HZ = (50.0, 60.0)
"""Nominal frequencies of the mains."""

HUM_HARMONICS = 7
"""Harmonics of the mains that count as hum: those of a rectifier fall with the frequency, the even ones fastest."""

MAINS_TOLERANCE = 0.01
"""Largest deviation of the mains from its nominal frequency, relative: grids stay within 0.4 %, generators in 1 %."""

BLOCK_S = 0.5
"""Time over which frequency, amplitudes and phases of hum are taken to be constant [s]."""

MIN_CYCLES = 2.0
"""Cycles of the mains from which its harmonics are distinguished from a slow motion: two frequency bins apart."""

SAMPLES_PER_CYCLE = 8
"""Samples per cycle of the highest harmonic from which hum is fitted; further ones are averaged."""

FREQUENCY_STEPS = 3
"""Gauss-Newton steps of the mains frequency: a deviation of 0.2 Hz turns a block by 0.3 rad; three steps follow it."""


def describe_hum(channel: Channel, strongest: float) -> str | None:
    """Return what a channel that shows only hum shows, in words; None if it also shows something else.

    Args:
        channel: with a line.
        strongest: frequency of its strongest line [Hz].
    """
    resolution = channel.sample_rate / min(channel.size, PIECE_SAMPLES)
    for mains in MAINS_HZ:
        order = round(strongest / mains)
        near = abs(strongest - order * mains) <= MAINS_TOLERANCE * strongest + resolution
        enough = channel.size * mains >= MIN_CYCLES * channel.sample_rate
        if not (1 <= order <= HUM_HARMONICS and near and enough):
            continue
        beside = search_lines(_without_hum(channel, mains), ())
        if beside is not None and not beside.found:
            return f"shows nothing but the frequency of the mains, {mains:g} Hz, and its harmonics"
    return None


def _without_hum(channel: Channel, mains: float) -> Channel:
    """The channel less hum of ``mains`` [Hz], which is fitted in blocks of ``BLOCK_S``."""
    count = max(1, round(channel.size / (BLOCK_S * channel.sample_rate)))
    edges = np.linspace(0, channel.size, count + 1).astype(np.intp)

    def fetch(first: int, stop: int) -> Array:
        begin = int(np.searchsorted(edges, first, side="right")) - 1
        end = max(int(np.searchsorted(edges, stop)), begin + 1)
        blocks = [
            _residual(channel.read(int(edges[k]), int(edges[k + 1])), mains / channel.sample_rate)
            for k in range(begin, end)
        ]
        return np.concatenate(blocks)[first - edges[begin] : stop - edges[begin]]

    rest = LazySamples((channel.size,), np.dtype(np.float64), fetch)
    return replace(channel, raw=rest, gain=1.0, offset=0.0, first=0, stop=channel.size)


def _residual(values: Array, frequency: float) -> Array:
    """Samples less their mean and the harmonics of ``frequency`` [1/sample], which is fitted too; gaps become 0.

    The fit uses means of samples, with which it needs a fraction of the memory.
    """
    length = max(1, int(1.0 / (SAMPLES_PER_CYCLE * HUM_HARMONICS * frequency)))
    means = values[: values.size // length * length].reshape(-1, length).mean(axis=1)
    known = np.isfinite(means)
    if known.sum() <= 2 * HUM_HARMONICS + 2:
        return np.zeros(values.size)
    order = np.arange(1, HUM_HARMONICS + 1)
    phase = 2 * np.pi * np.outer(length * np.arange(means.size) + 0.5 * (length - 1), order)[known]
    for step in range(FREQUENCY_STEPS + 1):
        columns = np.exp(1j * frequency * phase) * _attenuation(frequency * order, length)
        linear = np.column_stack([np.ones(len(phase)), columns.real, -columns.imag])
        found = np.linalg.lstsq(linear, means[known], rcond=None)[0]
        harmonics = found[1 : 1 + HUM_HARMONICS] + 1j * found[1 + HUM_HARMONICS :]
        if step == FREQUENCY_STEPS:
            break
        slope = np.sum((1j * phase * columns * harmonics).real, axis=1)
        # The step is that of a fit of all parameters: the slope without the part that the columns explain.
        slope -= linear @ np.linalg.lstsq(linear, slope, rcond=None)[0]
        power = float(slope @ slope)
        frequency += float(slope @ (means[known] - linear @ found)) / power if power > 0.0 else 0.0
    turn = np.exp(2j * np.pi * frequency * np.arange(values.size))
    hum = np.polynomial.polynomial.polyval(turn, np.append(found[0], harmonics)).real
    return np.where(np.isfinite(values), values - hum, 0.0)


def _attenuation(frequency: NDArray[Any], length: int) -> NDArray[Any]:
    """Amplitude that the mean of ``length`` samples leaves of a sinusoid of ``frequency`` [1/sample]."""
    return np.sin(np.pi * frequency * length) / (length * np.sin(np.pi * frequency))
