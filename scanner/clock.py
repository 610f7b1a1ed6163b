"""A uniform clock, and channels of different rate and start on a common one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import ceil, floor

import numpy as np

from scanner.arrays import Array
from scanner.channel import Channel
from scanner.errors import BadInput
from scanner.recording import Recording

SAME_TIME_SAMPLES = 1e-6
"""Two times closer than this fraction of a sample are the same: the rounding of times after 1e9 samples, well below any
delay between channels."""


@dataclass(frozen=True)
class Clock:
    """A uniform clock of ``size`` samples: sample ``i`` is at ``start + i / rate`` [s]."""

    start: float
    rate: float
    size: int

    @property
    def time(self) -> Array:
        """Times of all samples, shape (size,) [s]."""
        return self.start + np.arange(self.size) / self.rate


def on_clock(recording: Recording, names: Iterable[str], rate: float | None = None) -> tuple[Clock, dict[str, Array]]:
    """Return the named channels on one clock over the time that all of them cover.

    A channel whose samples fall on the clock is cut and otherwise unchanged. Any other channel is interpolated
    linearly, without a low-pass where its rate is reduced.

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
        first = ceil((first_time - fastest.start) * rate - SAME_TIME_SAMPLES)
        first_time = fastest.start + first / rate
    n = floor((last_time - first_time) * rate + SAME_TIME_SAMPLES) + 1
    if n < 1:
        spans = ", ".join(f"{c.name} {c.start:.9g} to {c.end:.9g} s" for c in channels)
        what = f"the channels have no time in common: {spans}"
        raise BadInput(what, file=recording.path, hint="check their start times and rates")
    clock = Clock(first_time, rate, n)
    return clock, {channel.name: _read_on_clock(clock, channel) for channel in channels}


def _read_on_clock(clock: Clock, channel: Channel) -> Array:
    lag = (clock.start - channel.start) * channel.sample_rate
    step = channel.sample_rate / clock.rate
    last_lag = lag + (clock.size - 1) * step
    first = round(lag)
    if max(abs(lag - first), abs(last_lag - (first + clock.size - 1))) < SAME_TIME_SAMPLES:
        return channel.read(first, first + clock.size)
    first = max(floor(lag), 0)
    values = channel.read(first, ceil(last_lag) + 1)
    position, samples = lag - first + step * np.arange(clock.size), np.arange(len(values))
    if values.ndim == 1:
        return np.interp(position, samples, values)
    return np.stack([np.interp(position, samples, column) for column in values.T], axis=1)
