"""Channels with other samples: all of them, or some without a copy of the others."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.arrays import Array, Index
from scanner.channel import Channel, SampleSource


@dataclass(frozen=True)
class ReplacedSamples:
    """Storage of the samples of a channel in which some are replaced.

    Attributes:
        channel: the original one, of shape (n,).
        index: of the replaced samples, increasing, shape (m,).
        values: of these samples, in the unit of the channel, shape (m,).
    """

    channel: Channel
    index: Index
    values: Array
    dtype = np.dtype(np.float64)
    ndim = 1

    @property
    def shape(self) -> tuple[int, ...]:
        """``(n,)``."""
        return (self.channel.size,)

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        first, stop, _ = rows.indices(self.channel.size)
        values = self.channel.read(first, stop)
        low, high = np.searchsorted(self.index, [first, stop])
        values[self.index[low:high] - first] = self.values[low:high]
        return values


def with_replaced(channel: Channel, index: Index, values: Array) -> Channel:
    """The channel with other values, shape (m,) in its unit, at the samples ``index``, increasing, shape (m,)."""
    if not index.size:
        return channel
    return with_samples(channel, ReplacedSamples(channel, index, values))


def with_samples(channel: Channel, values: SampleSource) -> Channel:
    """The channel with other samples, shape (n,), in its unit."""
    return replace(channel, raw=values, first=0, stop=values.shape[0], gain=1.0, offset=0.0)
