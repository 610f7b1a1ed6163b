"""Angles of an axis at the samples of the intensity, stored or computed when they are read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from scanner.arrays import Array, Complex
from scanner.channel import Channel
from scanner.interpolation import interpolate_cubic

SAMPLES_AT_ONCE = 1 << 18
"""Samples of an angle that are interpolated together, so that intermediate results need little memory."""

CUBIC_SAMPLES = 4
"""Samples that the cubic through a position needs: one before the last one at or before it, that one, two after it."""


class AngleTrack(Protocol):
    """Mechanical angle of one axis on a uniform clock.

    Every angle in a :class:`Motion` has these attributes and methods. Implementations: :class:`SampledAngle` (an
    array), :class:`ChannelAngle` (samples of a position signal) and :class:`AdvancedAngle` (another track,
    interpolated), ``estimation.tracker.angle_synthesis.PhasorAngle`` (synthesised from slow phase and amplitude) and
    ``estimation.optics.correction.BeamAngle`` (a track after the device's optics terms).
    """

    @property
    def sample_rate(self) -> float:
        """Sample rate [Hz]."""

    @property
    def start(self) -> float:
        """Time of the first sample on the recording's clock [s]."""

    @property
    def size(self) -> int:
        """Number of samples."""

    def read(self, first: int = 0, stop: int | None = None) -> Array:
        """Return the angles of samples ``first`` up to ``stop`` (as in a Python slice), shape (n,) [rad]."""

    def negated(self) -> AngleTrack:
        """Return the same motion with the opposite sign."""

    def advanced(self, time: Array, phase: Array, frequency: Array) -> AngleTrack:
        """Return the motion whose phase is ahead of this one.

        Args:
            time: increasing, shape (n,) [s].
            phase: lead at these times, interpolated between them, shape (n,) [rad].
            frequency: of the motion, shape (n,) [Hz].
        """

    def phasors(self) -> PhasorTrack | None:
        """Return the phasors that the angles are synthesised from; None for a track that is not made from any."""


class PhasorTrack(Protocol):
    """Phasors from which angles are synthesised. Kernels that take them need no sine for each sample."""

    @property
    def size(self) -> int:
        """Number of samples."""

    def cut_segments(self, first: int, stop: int) -> PhasorSegments:
        """Return segments that begin with sample ``first`` and cover the samples up to ``stop``."""

    def is_in_segments(self, first: int, stop: int) -> bool:
        """Return whether segments describe the samples ``first`` up to ``stop``: phase and amplitude do not bend."""

    def phase(self, time: Array) -> Array:
        """Return the phase u of the motion at ``time`` (n,) [s], also outside the track, shape (n,) [rad]."""

    def delayed(self, delay: float) -> AngleTrack:
        """Return the track that starts ``delay`` [s] earlier: its sample i is the angle ``delay`` before this one's."""


@dataclass(frozen=True)
class PhasorSegments:
    """Phasors of a run of samples, segment by segment: the input of the compiled kernels.

    Attributes:
        first_phasor: exp(i u) at each segment's first sample, shape (segments,).
        step_phasor: exp(i du) from one sample to the next, shape (segments,).
        harmonics, harmonic_steps: c_n at the first sample and its change a sample, shape (segments, harmonics) [rad].
    """

    first_phasor: Complex
    step_phasor: Complex
    harmonics: Complex
    harmonic_steps: Complex


@dataclass(frozen=True)
class SampledAngle:
    """An angle track that is stored sample by sample.

    Attributes:
        values: angle, shape (n,) [rad]; single precision is 1e-5 pixels and halves the memory.
        sample_rate: [Hz].
        start: time of the first sample on the recording's clock [s].
    """

    values: NDArray[np.floating]
    sample_rate: float
    start: float = 0.0

    @property
    def size(self) -> int:
        """Number of samples."""
        return self.values.size

    def read(self, first: int = 0, stop: int | None = None) -> Array:
        """Return the angles of samples ``first`` up to ``stop`` (as in a Python slice), shape (n,) [rad]."""
        return np.asarray(self.values[first:stop], np.float64)

    def negated(self) -> SampledAngle:
        """Return the same motion with the opposite sign."""
        return replace(self, values=-self.values)

    def advanced(self, time: Array, phase: Array, frequency: Array) -> AdvancedAngle:
        """Return the motion whose phase is ahead by ``phase`` at ``time`` (see ``AngleTrack``)."""
        return AdvancedAngle(self, time, phase / (2.0 * np.pi * frequency))

    def phasors(self) -> None:
        """Return None: samples are not synthesised from phasors."""


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
        """Return the motion whose phase is ahead by ``phase`` at ``time`` (see ``AngleTrack``)."""
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
        """Return the motion whose phase is ahead by ``phase`` at ``time`` (see ``AngleTrack``)."""
        knots = np.union1d(self.time, time)
        lead = np.interp(knots, time, phase / (2.0 * np.pi * frequency))
        return replace(self, time=knots, lead=lead + np.interp(knots + lead, self.time, self.lead))
