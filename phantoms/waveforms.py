"""Drive voltages as exact functions of time, which an integrator can evaluate between two samples.

A waveform is called with times [s] of any shape and returns volts of that shape. It is defined for all times:
before t = 0 and after its duration it continues as at its start or end. A periodic waveform has an ``angle(t)``
[rad], the phase of the drive, which is the reference of the motion's phase.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence as Ordered
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from scanner.arrays import Array
from scanner.device_toml import FINITE, check_values
from scanner.errors import BadInput

CYCLE_RAD = 2 * np.pi
"""Phase of a cycle [rad]."""


class Waveform(ABC):
    """Voltage over time."""

    @abstractmethod
    def __call__(self, t: ArrayLike) -> Array:
        """Voltage at times ``t`` [s]: [V], of t's shape."""

    def switching_times(self, t0: float, t1: float) -> Array:
        """Times in the open interval (t0, t1) at which the voltage or its slope may jump, increasing [s]."""
        return np.empty(0)


@dataclass(frozen=True)
class Constant(Waveform):
    """A DC bias of ``level`` [V]; zero switches the drive off."""

    level: float = 0.0

    def __call__(self, t: ArrayLike) -> Array:
        return np.full(np.shape(t), self.level)


@dataclass(frozen=True)
class Sine(Waveform):
    """``offset + amplitude sin(2 pi frequency t + phase)`` [V, Hz, rad].

    An electrostatic drive needs the offset: without it V^2 has no component at ``frequency``, and no parametric motion
    starts. Equation 16 of chen2020 omits the offset; its table I states 0 to 60 V.
    """

    frequency: float = field(metadata=FINITE)
    amplitude: float = field(metadata=FINITE)
    offset: float = field(default=0.0, metadata=FINITE)
    phase: float = field(default=0.0, metadata=FINITE)

    def __post_init__(self) -> None:
        check_values(self)

    def angle(self, t: ArrayLike) -> Array:
        """Phase at times ``t`` [s]: [rad], of t's shape."""
        return CYCLE_RAD * self.frequency * np.asarray(t, np.float64) + self.phase

    def __call__(self, t: ArrayLike) -> Array:
        return self.offset + self.amplitude * np.sin(self.angle(t))


@dataclass(frozen=True)
class Sweep(Waveform):
    """A sine whose frequency runs linearly from ``f0`` to ``f1`` [Hz] in ``duration`` [s], then is constant at ``f1``.

    Its phase is the integral of its frequency. A phase jump at either end could move a resonator to another branch of
    its response.
    """

    f0: float
    f1: float
    duration: float
    amplitude: float
    offset: float = 0.0
    phase: float = 0.0

    def __post_init__(self) -> None:
        _require(self.duration > 0, f"a sweep lasts {self.duration} s", "give a duration above zero")

    def angle(self, t: ArrayLike) -> Array:
        """Phase at times ``t`` [s]: [rad], of t's shape."""
        t = np.asarray(t, np.float64)
        swept = np.clip(t, 0.0, self.duration) ** 2 / (2 * self.duration) + np.maximum(t - self.duration, 0.0)
        return CYCLE_RAD * (self.f0 * t + (self.f1 - self.f0) * swept) + self.phase

    def __call__(self, t: ArrayLike) -> Array:
        return self.offset + self.amplitude * np.sin(self.angle(t))


@dataclass(frozen=True)
class Square(Waveform):
    """``high`` [V] for the first ``duty`` of every period, ``low`` for the rest, from ``phase`` [rad] at t = 0 on.

    At an edge the voltage is, up to rounding, the level that follows. An integration step across an edge blurs it; the
    relative error of 5e-4 has the same effect as friction. Steps should therefore end at ``switching_times``.
    """

    frequency: float
    high: float
    low: float = 0.0
    duty: float = 0.5
    phase: float = 0.0

    def __post_init__(self) -> None:
        _require(self.frequency > 0, f"a square wave has a frequency of {self.frequency} Hz", "give one above zero")
        _require(0 < self.duty < 1, f"a square wave has a duty of {self.duty}", "give one between 0 and 1")

    def angle(self, t: ArrayLike) -> Array:
        """Phase at times ``t`` [s]: [rad], of t's shape."""
        return CYCLE_RAD * self.frequency * np.asarray(t, np.float64) + self.phase

    def __call__(self, t: ArrayLike) -> Array:
        return np.where(np.mod(self.angle(t) / CYCLE_RAD, 1.0) < self.duty, self.high, self.low)

    def switching_times(self, t0: float, t1: float) -> Array:
        first, last = (int(np.floor(self.angle(t) / CYCLE_RAD)) for t in (t0, t1))
        cycles = np.arange(first, last + 1)[:, None] + np.array([0.0, self.duty])
        times = (cycles.ravel() - self.phase / CYCLE_RAD) / self.frequency
        return times[(times > t0) & (times < t1)]


@dataclass(frozen=True)
class Multisine(Waveform):
    """``offset`` plus the sum of ``amplitudes[i] sin(2 pi frequencies[i] t + phases[i])`` [Hz, V, rad]."""

    frequencies: tuple[float, ...]
    amplitudes: tuple[float, ...]
    phases: tuple[float, ...]
    offset: float = 0.0

    def __post_init__(self) -> None:
        lengths = [len(v) for v in (self.frequencies, self.amplitudes, self.phases)]
        _require(len(set(lengths)) == 1, f"a multisine has {lengths} frequencies, amplitudes, phases", "give as many")

    def __call__(self, t: ArrayLike) -> Array:
        t = np.asarray(t, np.float64)
        voltage = np.full(t.shape, self.offset)
        for frequency, amplitude, phase in zip(self.frequencies, self.amplitudes, self.phases, strict=True):
            voltage += amplitude * np.sin(CYCLE_RAD * frequency * t + phase)
        return voltage


@dataclass(frozen=True)
class Sequence(Waveform):
    """Waveforms one after another: ``Sequence([(Sine(...), 0.02), (Constant(10.0), 0.08)])`` drives, then rings down.

    The time of each part counts from its start. Neighbouring periodic parts join without a phase jump, like a generator
    that is stepped in frequency: the ``phase`` of a part adds to the phase at which the previous part ended.

    Args:
        parts: pairs of waveform and duration [s]. Before t = 0 the first part continues, after the end the last one.
    """

    parts: Ordered[tuple[Waveform, float]]
    starts: Array = field(init=False, repr=False, compare=False)
    joined: tuple[Waveform, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        durations = [duration for _, duration in self.parts]
        _require(bool(durations), "a sequence has no parts", "give at least one")
        _require(min(durations) > 0, f"a part of a sequence lasts {min(durations)} s", "give durations above zero")
        joined, phase = [], 0.0
        for waveform, duration in self.parts:
            if isinstance(waveform, Sine | Sweep | Square):
                waveform = replace(waveform, phase=waveform.phase + phase)
                phase = float(waveform.angle(duration))
            else:
                phase = 0.0
            joined.append(waveform)
        object.__setattr__(self, "starts", np.cumsum([0.0, *durations[:-1]]))
        object.__setattr__(self, "joined", tuple(joined))

    def __call__(self, t: ArrayLike) -> Array:
        t = np.asarray(t, np.float64)
        part = np.searchsorted(self.starts[1:], t, side="right")
        voltage = np.empty(t.shape)
        for i, (start, waveform) in enumerate(zip(self.starts, self.joined, strict=True)):
            voltage[part == i] = waveform(t[part == i] - start)
        return voltage

    def switching_times(self, t0: float, t1: float) -> Array:
        joints = self.starts[1:]
        times = [joints[(joints > t0) & (joints < t1)]]
        part_starts, part_ends = [-np.inf, *joints], [*joints, np.inf]
        for begin, end, start, waveform in zip(part_starts, part_ends, self.starts, self.joined, strict=True):
            if max(begin, t0) < min(end, t1):
                times.append(start + waveform.switching_times(max(begin, t0) - start, min(end, t1) - start))
        return np.sort(np.concatenate(times))


def _require(satisfied: bool, what: str, hint: str) -> None:
    """Raise BadInput unless the condition is satisfied."""
    if not satisfied:
        raise BadInput(what, hint=hint)
