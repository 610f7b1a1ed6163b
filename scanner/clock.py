"""Channels of different rate and start on one clock, by their time stamps."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import ceil, floor

import numpy as np

from scanner.channel import Array, Channel
from scanner.errors import BadInput
from scanner.recording import Recording

SAME_SAMPLE = 1e-6
"""Two times are the same sample when they are closer than this fraction of a sample: rounding, not a delay."""


@dataclass(frozen=True)
class Clock:
    """Sample ``i`` of ``n`` is at ``start + i / rate`` [s]."""

    start: float
    rate: float
    n: int

    @property
    def time(self) -> Array:
        """Times of all samples, shape (n,) [s]."""
        return self.start + np.arange(self.n) / self.rate


def on_clock(recording: Recording, names: Iterable[str], rate: float | None = None) -> tuple[Clock, dict[str, Array]]:
    """The named channels on one clock over the time that all of them cover.

    A channel that already has the clock's rate and whose samples fall on it is cut, not touched; any other is
    interpolated linearly. Nothing is low-passed before its rate is reduced.

    Args:
        recording: holds the channels.
        names: of the channels.
        rate: of the clock [Hz]; by default the highest rate among the channels, on that channel's own samples.

    Returns:
        The clock, and each channel's values on it, shape (n,) or (n, detectors).

    Raises:
        ChannelMissing: a channel is not in the recording.
        BadInput: the channels have no time in common.
    """
    channels = [recording[name] for name in names]
    fastest = max(channels, key=lambda channel: channel.sample_rate)
    first_time = max(channel.start for channel in channels)
    last_time = min(channel.end - 1 / channel.sample_rate for channel in channels)
    if rate is None or rate == fastest.sample_rate:
        rate = fastest.sample_rate
        first = ceil((first_time - fastest.start) * rate - SAME_SAMPLE)
        first_time = fastest.start + first / rate
    n = floor((last_time - first_time) * rate + SAME_SAMPLE) + 1
    if n < 1:
        spans = ", ".join(f"{c.name} {c.start:.9g} to {c.end:.9g} s" for c in channels)
        what = f"the channels have no time in common: {spans}"
        raise BadInput(what, file=recording.path, hint="check their start times and rates")
    clock = Clock(first_time, rate, n)
    return clock, {channel.name: _on(clock, channel) for channel in channels}


def _on(clock: Clock, channel: Channel) -> Array:
    lag = (clock.start - channel.start) * channel.sample_rate
    step = channel.sample_rate / clock.rate
    last_lag = lag + (clock.n - 1) * step
    first = round(lag)
    if max(abs(lag - first), abs(last_lag - (first + clock.n - 1))) < SAME_SAMPLE:
        return channel.read(first, first + clock.n)
    first = max(floor(lag), 0)
    values = channel.read(first, ceil(last_lag) + 1)
    at, samples = lag - first + step * np.arange(clock.n), np.arange(len(values))
    if values.ndim == 1:
        return np.interp(at, samples, values)
    return np.stack([np.interp(at, samples, column) for column in values.T], axis=1)
