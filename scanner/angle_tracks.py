"""Angles that are computed when they are read, so that a long recording needs little memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np

from scanner.arrays import Array
from scanner.channel import Channel
from scanner.interpolation import interpolate_cubic

if TYPE_CHECKING:
    from scanner.motion import AngleTrack

SAMPLES_AT_ONCE = 1 << 18
"""Samples of an angle that are interpolated together, so that intermediate results need little memory."""

CUBIC_SAMPLES = 4
"""Samples that the cubic through a position needs: one before the last one at or before it, that one, two after it."""


@dataclass(frozen=True)
class ChannelAngle:
    """An angle track that consists of the samples of a channel.

    Attributes:
        channel: whose samples are the angle [rad].
        unknown: ranges of samples (first, stop) at which no angle is known; they are read as NaN.
    """

    channel: Channel
    unknown: Sequence[tuple[int, int]] = ()

    @property
    def sample_rate(self) -> float:
        """Sample rate [Hz]."""
        return self.channel.sample_rate

    @property
    def start(self) -> float:
        """Time of the first sample on the recording's clock [s]."""
        return self.channel.start

    @property
    def size(self) -> int:
        """Number of samples."""
        return self.channel.size

    def read(self, first: int = 0, stop: int | None = None) -> Array:
        """Return the angles of samples ``first`` up to ``stop`` (as in a Python slice), shape (n,) [rad]."""
        values = self.channel.read(first, stop)
        begin = slice(first, stop).indices(self.size)[0]
        for low, high in self.unknown:
            values[max(low - begin, 0) : max(high - begin, 0)] = np.nan
        return values

    def negated(self) -> ChannelAngle:
        """Return the same motion with the opposite sign."""
        return replace(self, channel=replace(self.channel, gain=-self.channel.gain, offset=-self.channel.offset))

    def advanced(self, time: Array, phase: Array, frequency: Array) -> AdvancedAngle:
        """Return the motion whose phase is ahead by ``phase`` at ``time`` (see ``scanner.motion.AngleTrack``)."""
        return AdvancedAngle(self, time, phase / (2.0 * np.pi * frequency))

    def phasors(self) -> None:
        """Return None: samples are not synthesised from phasors."""


@dataclass(frozen=True)
class DerivedAngle:
    """Base of the angle tracks that are computed from another one when they are read.

    Attributes:
        track: the other one.
    """

    track: AngleTrack

    @property
    def sample_rate(self) -> float:
        """Sample rate [Hz]."""
        return self.track.sample_rate

    @property
    def start(self) -> float:
        """Time of the first sample on the recording's clock [s]."""
        return self.track.start

    @property
    def size(self) -> int:
        """Number of samples."""
        return self.track.size

    def negated(self) -> Self:
        """Return the same motion with the opposite sign."""
        return replace(self, track=self.track.negated())

    def phasors(self) -> None:
        """Return None: the samples are changed one by one."""


@dataclass(frozen=True)
class AdvancedAngle(DerivedAngle):
    """The angle of another track a little later or earlier, by the cubic through its samples.

    Attributes:
        time: increasing, shape (n,) [s].
        lead: time by which this track is ahead, linear between ``time``, shape (n,) [s].
    """

    time: Array
    lead: Array

    def read(self, first: int = 0, stop: int | None = None) -> Array:
        """Return the angles of samples ``first`` up to ``stop`` (as in a Python slice), shape (n,) [rad]."""
        begin, end, _ = slice(first, stop).indices(self.size)
        values = np.empty(max(end - begin, 0))
        for low in range(begin, end, SAMPLES_AT_ONCE):
            high = min(low + SAMPLES_AT_ONCE, end)
            values[low - begin : high - begin] = self._interpolated(np.arange(low, high, dtype=float))
        return values

    def _interpolated(self, index: Array) -> Array:
        """The angles of samples, shape (n,)."""
        position = index + np.interp(self.start + index / self.sample_rate, self.time, self.lead) * self.sample_rate
        known = np.floor(position[np.isfinite(position)])  # at a frequency of 0 it may be not
        if not known.size:
            return np.full(index.size, np.nan)
        low = max(min(int(known.min()) - 1, self.size - CUBIC_SAMPLES), 0)
        high = min(max(int(known.max()) + 3, low + CUBIC_SAMPLES), self.size)
        return interpolate_cubic(self.track.read(low, high), position - low)

    def advanced(self, time: Array, phase: Array, frequency: Array) -> AdvancedAngle:
        """Return the motion whose phase is ahead by ``phase`` at ``time`` (see ``scanner.motion.AngleTrack``)."""
        knots = np.union1d(self.time, time)
        lead = np.interp(knots, time, phase / (2.0 * np.pi * frequency))
        return replace(self, time=knots, lead=lead + np.interp(knots + lead, self.time, self.lead))
