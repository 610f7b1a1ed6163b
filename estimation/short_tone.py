"""Frequency of a tone of which a recording holds only a few periods.

A spectrum separates a line from the signal's mean from two periods on, and its peak is then off by some per cent. A
least-squares fit of an offset and a sine has neither limit.
"""

from __future__ import annotations

import numpy as np

from scanner.arrays import Array
from scanner.channel import Channel

MIN_PERIODS = 1.5
"""Least number of periods of the tone: of fewer, an offset takes up a part."""

GRID_STEP_CYCLES = 0.1
"""Spacing of the frequencies that are tried, in cycles over the signal: a tenth of the width of a line."""

MAX_SAMPLES = 4096
"""Number of means of adjacent samples to which a longer signal is reduced: hundreds a period of the highest frequency
that is tried."""

CHUNK_SAMPLES = 1 << 19
"""Samples read at a time, which bounds the memory."""

NEWTON_STEPS = 6
"""Gauss-Newton steps from the grid's best frequency; each reduces the error tenfold or more."""

MIN_SHARE = 0.5
"""Share of a signal's variance from which a sine is its main oscillation: a square wave's fundamental has 0.81, the
best sine of a step 0.3, of a ramp 0.16."""


def fit_short_tone(channel: Channel, low: float, max_periods: float) -> float | None:
    """Frequency of the sine that, with an offset, fits a short signal best [Hz].

    Args:
        channel: the signal; missing samples are NaN.
        low: lowest frequency [Hz].
        max_periods: largest number of periods in the signal.

    Returns:
        None if no sine of ``MIN_PERIODS`` to ``max_periods`` has ``MIN_SHARE`` of the variance.
    """
    length = max(1, -(-channel.size // MAX_SAMPLES))
    means = _means(channel, length)
    duration = means.size * length / channel.sample_rate
    known = np.isfinite(means)
    time, y = np.flatnonzero(known) / means.size, means[known]  # in units of the duration
    lowest = max(MIN_PERIODS, low * duration)
    periods = np.arange(lowest, max_periods + GRID_STEP_CYCLES, GRID_STEP_CYCLES)
    if y.size < 2 * max_periods or periods.size == 0 or not np.var(y) > 0.0:
        return None
    best = float(periods[int(np.argmin([_residual(y, time, each)[0] for each in periods]))])
    for _ in range(NEWTON_STEPS):
        _, (_, cosine, sine) = _residual(y, time, best)
        turn = 2 * np.pi * best * time
        slope = 2 * np.pi * time * (sine * np.cos(turn) - cosine * np.sin(turn))
        columns = np.stack([np.ones_like(time), np.cos(turn), np.sin(turn), slope], axis=1)
        best += float(np.clip(np.linalg.lstsq(columns, y)[0][3], -GRID_STEP_CYCLES, GRID_STEP_CYCLES))
    found = lowest - GRID_STEP_CYCLES < best < max_periods + GRID_STEP_CYCLES
    return best / duration if found and _residual(y, time, best)[0] < 1.0 - MIN_SHARE else None


def _means(channel: Channel, length: int) -> Array:
    """Means of ``length`` adjacent samples each; NaN where one is missing."""
    chunk = length * max(1, CHUNK_SAMPLES // length)
    last = channel.size // length * length
    parts = [channel.read(first, min(first + chunk, last)) for first in range(0, last, chunk)]
    return np.concatenate([part.reshape(-1, length).mean(axis=1) for part in parts])


def _residual(y: Array, time: Array, periods: float) -> tuple[float, Array]:
    """Share of the variance that an offset and a sine leave, and their coefficients, shape (3,)."""
    turn = 2 * np.pi * periods * time
    columns = np.stack([np.ones_like(time), np.cos(turn), np.sin(turn)], axis=1)
    fitted = np.linalg.lstsq(columns, y)[0]
    return float(np.mean((y - columns @ fitted) ** 2) / np.var(y)), fitted
