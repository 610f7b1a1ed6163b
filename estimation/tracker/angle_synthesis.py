"""Angle at every sample from slow phase, amplitude and harmonics, without one sine a sample.

The sample axis is cut into segments of ``SEGMENT_SAMPLES``. At a segment's ends phase, amplitude and harmonics are
interpolated from the blocks. Within a segment the phase is linear in time, so that the phasors exp(i u) of its samples
follow from the first one by complex multiplication. Segments in which phase or amplitude bend, as those of a coarsely
sampled decay, which are several periods long, are computed sample by sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimation.reference import PhaseReference
from scanner.angle_tracks import PhasorSegments
from scanner.arrays import Array, Complex, Mask

Harmonics = NDArray[np.complexfloating[Any, Any]]

SEGMENT_SAMPLES = 256
"""Samples over which the phase is linear in time. At 5 MS/s, 51 us: a drift of 10 Hz/ms bends the phase by 2e-5 rad."""

MAX_SEGMENT_BEND = 1e-4
"""Largest distance of the phase [rad] or of ln A from a line over a segment: a fiftieth of a pixel of 400 across the
motion."""

PHASOR_BATCH = 64
"""Phasors that are multiplied together. A power of two that divides SEGMENT_SAMPLES; they fit the first-level cache."""

BATCH_RAMP = np.arange(PHASOR_BATCH, dtype=np.float64)

SEGMENT_RAMP = np.arange(SEGMENT_SAMPLES)

BENT_SEGMENTS = 64
"""Segments that are computed sample by sample at a time: their harmonics take 2 MB."""

READ_SAMPLES = 1 << 20
"""Samples that ``PhasorAngle.read`` synthesises at a time: bounds the memory of the segments' tables."""


@dataclass(frozen=True)
class PhasorMotion:
    """Motion of one axis on the blocks' clock: theta(t) = Re(sum of c_n(t) exp(i n u)), u(t) = psi(t) + phi(t).

    Attributes:
        reference: gives the reference phase psi.
        time: of the knots, not decreasing, shape (knots,) [s]. Two knots at one time mark a discontinuity.
        phase, phase_rate: phi and its derivative, shape (knots,) [rad, rad/s].
        log_amplitude, log_amplitude_rate: ln A and its derivative, shape (knots,) [1, 1/s].
        harmonics: c_n / A, shape (knots, harmonics). The first harmonic is -i. Three columns are n = 1, 3, 5; otherwise
            the columns are n = 0, 1, 2, ...
    """

    reference: PhaseReference
    time: Array
    phase: Array
    phase_rate: Array
    log_amplitude: Array
    log_amplitude_rate: Array
    harmonics: Harmonics

    def at(self, time: Array) -> tuple[Array, Complex]:
        """Phase u [rad], shape (n,), and harmonics c_n [rad], shape (n, harmonics), at ``time`` [s], shape (n,)."""
        phase, harmonics = _interpolate_knots(
            time,
            self.time,
            self.phase,
            self.phase_rate,
            self.log_amplitude,
            self.log_amplitude_rate,
            self.harmonics,
        )
        return phase + self.reference.phase(time), harmonics

    def angle(self, time: Array) -> Array:
        """Angle at ``time`` [s], with one sine for each, shape (n,) [rad]."""
        phase, harmonics = self.at(time)
        odd = harmonics.shape[1] == 3
        first, step = np.exp(1j * phase) if odd else np.ones(time.size), np.exp((2j if odd else 1j) * phase)
        return np.asarray(first * _polynomial(harmonics, step)).real

    def bends(self, duration: float) -> Array:
        """Largest distance of phase [rad] or ln A from a line over ``duration`` [s], after each knot: (knots - 1,)."""
        step = np.diff(self.time)
        apart = step > 0.0
        h = np.where(apart, step, 1.0)
        middle = 0.5 * (self.time[:-1] + self.time[1:])
        reference = self.reference.phase(self.time)
        own = 4.0 * (reference[:-1] - 2.0 * self.reference.phase(middle) + reference[1:]) / h**2
        phase = _largest_curvature(self.phase, self.phase_rate, h) + np.abs(own)
        log = _largest_curvature(self.log_amplitude, self.log_amplitude_rate, h) + _larger(self.log_amplitude_rate) ** 2
        jumps = [
            np.abs(np.diff(values)) + 0.25 * duration * np.abs(np.diff(rates))
            for values, rates in ((self.phase, self.phase_rate), (self.log_amplitude, self.log_amplitude_rate))
        ]
        return np.where(apart, np.maximum(phase, log) * duration**2 / 8.0, np.maximum(*jumps))


def _polynomial(coefficients: Complex, x: Complex) -> Complex:
    """Sum of coefficients[:, n] x^n, shape (n,)."""
    total = coefficients[:, -1]
    for column in coefficients.T[-2::-1]:
        total = total * x + column
    return total


def _larger(values: Array) -> Array:
    """The larger absolute value at the ends of each interval, shape (knots - 1,)."""
    return np.asarray(np.maximum(np.abs(values[:-1]), np.abs(values[1:])))


def _largest_curvature(values: Array, slopes: Array, step: Array) -> Array:
    """Largest second derivative of the cubic Hermite polynomial of each interval, shape (knots - 1,)."""
    mean = np.diff(values) / step
    first = 6.0 * mean - 4.0 * slopes[:-1] - 2.0 * slopes[1:]
    last = -6.0 * mean + 2.0 * slopes[:-1] + 4.0 * slopes[1:]
    return np.asarray(np.maximum(np.abs(first), np.abs(last)) / step)


@njit(cache=True, error_model="numpy")
def _interpolate_knots(time, knots, phase, phase_rate, log, log_rate, harmonics):  # type: ignore[no-untyped-def]
    """Cubic Hermite interpolation of phase and ln A, linear interpolation of c_n / A; returns phi and c_n."""
    out, out_harmonics = np.empty(time.size), np.empty((time.size, harmonics.shape[1]), np.complex128)
    k = 0
    for i in range(time.size):
        if time[i] < knots[k] or time[i] >= knots[min(k + 2, knots.size - 1)]:
            k = min(max(np.searchsorted(knots, time[i], side="right") - 1, 0), knots.size - 2)
        elif k < knots.size - 2 and time[i] >= knots[k + 1]:
            k += 1
        step = knots[k + 1] - knots[k]
        at = k + (time[i] - knots[k]) / step
        out[i] = _interpolate_cubic(phase, phase_rate, k, at - k, step)
        amplitude = math.exp(_interpolate_cubic(log, log_rate, k, at - k, step))
        weight = min(max(at - k, 0.0), 1.0)
        for n in range(harmonics.shape[1]):
            out_harmonics[i, n] = (harmonics[k, n] * (1.0 - weight) + harmonics[k + 1, n] * weight) * amplitude
    return out, out_harmonics


@njit(cache=True)
def _interpolate_cubic(values, slopes, k, s, step):  # type: ignore[no-untyped-def]
    """Cubic Hermite polynomial at fraction ``s`` of the interval after knot ``k``; linear beyond the ends."""
    inside = min(max(s, 0.0), 1.0)
    rest = 1.0 - inside
    a, b = values[k], values[k + 1]
    da, db = slopes[k] * step, slopes[k + 1] * step
    curve = rest**2 * ((1.0 + 2.0 * inside) * a + inside * da) + inside**2 * ((1.0 + 2.0 * rest) * b - rest * db)
    return curve + (s - inside) * (da if s < 0.0 else db)


def cut_segments(motion: PhasorMotion, rate: float, start: float, count: int) -> PhasorSegments:
    """Segments that cover ``count`` samples from ``start`` [s] at ``rate`` [Hz]."""
    edges: Array = start + np.arange(-(-count // SEGMENT_SAMPLES) + 1, dtype=np.float64) * (SEGMENT_SAMPLES / rate)
    return PhasorSegments(*_segment_phasors(*motion.at(edges)))


@njit(cache=True, error_model="numpy")
def _segment_phasors(phase, harmonics):  # type: ignore[no-untyped-def]
    """Fields of ``PhasorSegments`` from phase and harmonics at the segments' edges."""
    size = phase.size - 1
    first, turn = np.empty(size, np.complex128), np.empty(size, np.complex128)
    for s in range(size):
        step = (phase[s + 1] - phase[s]) / SEGMENT_SAMPLES
        first[s] = complex(math.cos(phase[s]), math.sin(phase[s]))
        turn[s] = complex(math.cos(step), math.sin(step))
    return first, turn, harmonics[:-1], (harmonics[1:] - harmonics[:-1]) / SEGMENT_SAMPLES


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def fill_phasor_powers(step, re, im):  # type: ignore[no-untyped-def]
    """Powers 0, 1, 2, ... of the phasor ``step`` into ``re`` and ``im``.

    Args:
        step: complex number of modulus 1. re, im: shape (n,), n a power of two; filled.

    Returns:
        The n-th power.
    """
    re[0], im[0] = 1.0, 0.0
    done, power = 1, step
    while done < re.size:  # multiplying all present powers by the next one doubles their number
        a, b = power.real, power.imag
        next_re, next_im = re[done : 2 * done], im[done : 2 * done]
        for i in range(done):
            x, y = re[i], im[i]
            next_re[i], next_im[i] = x * a - y * b, x * b + y * a
        power *= power
        done *= 2
    return power


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def synthesise_segment(first, step, harmonics, harmonic_steps, re, im, out):  # type: ignore[no-untyped-def]
    """Angles of one segment into ``out``, shape (SEGMENT_SAMPLES,) [rad].

    The amplitude is linear over the segment; the higher harmonics keep their value at its middle. A sample's phasor is
    the product of the batch's first phasor and one of PHASOR_BATCH powers of ``step``.

    Args:
        first, step, harmonics, harmonic_steps: a segment's values, see ``PhasorSegments``.
        re, im: buffers, shape (PHASOR_BATCH,).
    """
    batch_step = fill_phasor_powers(step, re, im)
    a, b = first.real, first.imag
    for at in range(0, SEGMENT_SAMPLES, PHASOR_BATCH):
        part = out[at : at + PHASOR_BATCH]
        if harmonics.size == 3:
            _synthesise_odd(a, b, harmonics, harmonic_steps, at, re, im, part)
        else:
            _synthesise_all(a, b, harmonics, harmonic_steps, at, re, im, part)
        a, b = a * batch_step.real - b * batch_step.imag, a * batch_step.imag + b * batch_step.real


@njit(cache=True, error_model="numpy", fastmath={"contract"}, inline="always")
def _synthesise_odd(a, b, harmonics, harmonic_steps, at, re, im, out):  # type: ignore[no-untyped-def]
    """Harmonics 1, 3, 5 as polynomials in s^2: cos 3u = c (1 - 4 s^2), sin 3u = s (3 - 4 s^2), and so on."""
    third = harmonics[1] + 0.5 * SEGMENT_SAMPLES * harmonic_steps[1]
    fifth = harmonics[2] + 0.5 * SEGMENT_SAMPLES * harmonic_steps[2]
    c0, c1, c2 = third.real + fifth.real, -4.0 * third.real - 12.0 * fifth.real, 16.0 * fifth.real
    step = harmonic_steps[0].imag
    s0 = harmonics[0].imag + at * step + 3.0 * third.imag + 5.0 * fifth.imag
    s1, s2 = -4.0 * third.imag - 20.0 * fifth.imag, 16.0 * fifth.imag
    for i in range(PHASOR_BATCH):
        c, s = re[i] * a - im[i] * b, re[i] * b + im[i] * a
        w = s * s
        out[i] = c * (c0 + w * (c1 + w * c2)) - s * (s0 + BATCH_RAMP[i] * step + w * (s1 + w * s2))


@njit(cache=True, error_model="numpy", fastmath={"contract"}, inline="always")
def _synthesise_all(a, b, harmonics, harmonic_steps, at, re, im, out):  # type: ignore[no-untyped-def]
    """Harmonics 0, 1, 2, ..., each by repeated multiplication of the first phasor."""
    for i in range(PHASOR_BATCH):
        s = re[i] * b + im[i] * a
        out[i] = harmonics[0].real - (harmonics[1].imag + (at + BATCH_RAMP[i]) * harmonic_steps[1].imag) * s
    for n in range(2, harmonics.size):
        harmonic = harmonics[n] + 0.5 * SEGMENT_SAMPLES * harmonic_steps[n]
        for i in range(PHASOR_BATCH):
            c, s = re[i] * a - im[i] * b, re[i] * b + im[i] * a
            px, py = c, s
            for _ in range(n - 1):
                px, py = px * c - py * s, px * s + py * c
            out[i] += harmonic.real * px - harmonic.imag * py


@njit(cache=True, error_model="numpy")
def _synthesise(first, step, harmonics, harmonic_steps, out):  # type: ignore[no-untyped-def]
    """Angles of all segments into ``out``; the last segment may reach beyond its end."""
    re, im, buffer = np.empty(PHASOR_BATCH), np.empty(PHASOR_BATCH), np.empty(SEGMENT_SAMPLES)
    for s in range(first.size):
        at = s * SEGMENT_SAMPLES
        synthesise_segment(first[s], step[s], harmonics[s], harmonic_steps[s], re, im, buffer)
        for i in range(min(SEGMENT_SAMPLES, out.size - at)):
            out[at + i] = buffer[i]


@dataclass(frozen=True)
class PhasorAngle:
    """Angle at a channel's samples, synthesised when it is read, so that a long recording needs no memory for it.

    Attributes:
        motion: phase, amplitude and harmonics that the angles are made from.
        sample_rate: [Hz].
        start: time of the first sample on the recording's clock [s].
        size: number of samples.
    """

    motion: PhasorMotion
    sample_rate: float
    start: float
    size: int

    def read(self, first: int = 0, stop: int | None = None) -> Array:
        """Return the angles of samples ``first`` up to ``stop`` (as in a Python slice), shape (n,) [rad]."""
        low, high, _ = slice(first, stop).indices(self.size)
        out = np.empty(max(high - low, 0))
        for at in range(0, out.size, READ_SAMPLES):
            part = out[at : at + READ_SAMPLES]
            cut = self.cut_segments(low + at, low + at + part.size)
            _synthesise(cut.first_phasor, cut.step_phasor, cut.harmonics, cut.harmonic_steps, part)
            bent = np.flatnonzero(self._bent_segments(low + at, low + at + part.size))
            for few in range(0, bent.size, BENT_SEGMENTS):
                index = (bent[few : few + BENT_SEGMENTS, None] * SEGMENT_SAMPLES + SEGMENT_RAMP).reshape(-1)
                index = index[index < part.size]
                part[index] = self.motion.angle(self.start + (low + at + index) / self.sample_rate)
        return out

    @cached_property
    def _bends(self) -> Mask:
        """After which knots a segment bends by more than ``MAX_SEGMENT_BEND``, shape (knots - 1,)."""
        return np.asarray(self.motion.bends(SEGMENT_SAMPLES / self.sample_rate) > MAX_SEGMENT_BEND)

    def _bent_segments(self, first: int, stop: int) -> Mask:
        """Which segments from sample ``first`` on are not lines, shape (segments,)."""
        count = -(-(stop - first) // SEGMENT_SAMPLES)
        ramp: Array = first + SEGMENT_SAMPLES * np.arange(count + 1, dtype=np.float64)
        edges = self.start + ramp / self.sample_rate
        sums = np.append(0, np.cumsum(self._bends))
        knot = np.clip(np.searchsorted(self.motion.time, edges, "right") - 1, 0, self._bends.size - 1)
        return np.asarray(sums[knot[1:] + 1] > sums[knot[:-1]])

    def is_in_segments(self, first: int, stop: int) -> bool:
        """Return whether segments describe the samples ``first`` up to ``stop``, to ``MAX_SEGMENT_BEND``."""
        return not self._bent_segments(first, stop).any()

    def negated(self) -> PhasorAngle:
        """Return the same motion with the opposite sign."""
        harmonics = _with_opposite_sign(self.motion.harmonics)
        return replace(self, motion=replace(self.motion, phase=self.motion.phase + np.pi, harmonics=harmonics))

    def advanced(self, time: Array, phase: Array, frequency: Array) -> PhasorAngle:
        """Return the motion whose phase is ahead by ``phase`` at ``time`` (see ``scanner.angle_tracks.AngleTrack``)."""
        knots = self.motion.time
        lead, lead_rate = np.interp(knots, time, phase), np.interp(knots, time, np.gradient(phase, time))
        phase, phase_rate = self.motion.phase + lead, self.motion.phase_rate + lead_rate
        return replace(self, motion=replace(self.motion, phase=phase, phase_rate=phase_rate))

    def phasors(self) -> PhasorAngle:
        """Return the track itself: it is a ``scanner.motion.PhasorTrack``."""
        return self

    def cut_segments(self, first: int, stop: int) -> PhasorSegments:
        """Return segments that begin with sample ``first`` and cover the samples up to ``stop``."""
        return cut_segments(self.motion, self.sample_rate, self.start + first / self.sample_rate, stop - first)

    def phase(self, time: Array) -> Array:
        """Return the phase u of the motion at ``time`` (n,) [s], also outside the track, shape (n,) [rad]."""
        return self.motion.at(time)[0]

    def delayed(self, delay: float) -> PhasorAngle:
        """Return the track that starts ``delay`` [s] earlier: its sample i is the angle ``delay`` before this one's."""
        return replace(self, start=self.start - delay)


def _with_opposite_sign(harmonics: Harmonics) -> Harmonics:
    """Harmonics that make -theta with u + pi: the even ones change sign, the odd ones do not."""
    out = harmonics.copy()
    if harmonics.shape[1] != 3:
        out[:, ::2] *= -1.0
    return out
