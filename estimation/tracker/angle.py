"""The angle at any sample from slow phase, amplitude and harmonics, without a sine for each sample.

Time is cut into segments of SEGMENT samples. At a segment's ends phase, amplitude and harmonics are interpolated from
the blocks; inside, the phase runs straight, so that a segment's phasors follow from its first by turning.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimation.reference import Reference
from scanner.motion import AngleTrack

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Lines = NDArray[np.complexfloating[Any, Any]]

SEGMENT = 256  # samples over which the phase runs straight
FINE = 64  # phasors turned together, a power of two that divides SEGMENT
RAMP = np.arange(FINE, dtype=np.float64)
PIECE = 1 << 20  # samples made at a time


@dataclass(frozen=True)
class SlowMotion:
    """Motion of one axis on the blocks' clock: theta(t) = Re(sum of line[n] exp(i n u)), u = psi(t) + phi(t).

    Attributes:
        reference: gives psi.
        time: not decreasing, shape (knots,) [s]; twice the same where the motion bends or its reference jumps.
        phase, phase_rate: phi and its slope [rad, rad/s]. log, log_rate: of the amplitude [1, 1/s].
        lines: harmonics over the amplitude, shape (blocks, lines); the first harmonic is -i.
    """

    reference: Reference
    time: Array
    phase: Array
    phase_rate: Array
    log: Array
    log_rate: Array
    lines: Lines

    def at(self, time: Array) -> tuple[Array, Complex]:
        """Phase u [rad] and lines [rad] at ``time``, shapes (n,) and (n, lines)."""
        own, lines = _between(time, self.time, self.phase, self.phase_rate, self.log, self.log_rate, self.lines)
        return own + self.reference.phase(time), lines


@njit(cache=True, error_model="numpy")
def _between(time, knots, phase, phase_rate, log, log_rate, lines):  # type: ignore[no-untyped-def]
    """Phase by cubics, amplitude by the exponential of cubics, harmonics over the amplitude by straight lines."""
    out, out_lines = np.empty(time.size), np.empty((time.size, lines.shape[1]), np.complex128)
    k = 0
    for i in range(time.size):
        if time[i] < knots[k] or time[i] >= knots[min(k + 2, knots.size - 1)]:
            k = min(max(np.searchsorted(knots, time[i], side="right") - 1, 0), knots.size - 2)
        elif k < knots.size - 2 and time[i] >= knots[k + 1]:
            k += 1
        step = knots[k + 1] - knots[k]
        at = k + (time[i] - knots[k]) / step
        out[i] = _hermite(phase, phase_rate, k, at - k, step)
        amplitude = math.exp(_hermite(log, log_rate, k, at - k, step))
        share = min(max(at - k, 0.0), 1.0)
        for n in range(lines.shape[1]):
            out_lines[i, n] = (lines[k, n] * (1.0 - share) + lines[k + 1, n] * share) * amplitude
    return out, out_lines


@njit(cache=True)
def _hermite(values, slopes, k, s, step):  # type: ignore[no-untyped-def]
    """Cubic through values and slopes, at fraction ``s`` behind knot ``k``; straight on beyond the ends."""
    inside = min(max(s, 0.0), 1.0)
    rest = 1.0 - inside
    a, b = values[k], values[k + 1]
    da, db = slopes[k] * step, slopes[k + 1] * step
    curve = rest**2 * ((1.0 + 2.0 * inside) * a + inside * da) + inside**2 * ((1.0 + 2.0 * rest) * b - rest * db)
    return curve + (s - inside) * (da if s < 0.0 else db)


@dataclass(frozen=True)
class Segments:
    """Phasors of a run of samples, segment by segment: what the compiled kernels take.

    Attributes:
        first: exp(i u) at each segment's first sample. turn: exp(i du) from one sample to the next. shape (segments,).
        lines, line_steps: lines at the first sample and their change a sample, shape (segments, lines) [rad].
    """

    first: Complex
    turn: Complex
    lines: Complex
    line_steps: Complex


def segments(motion: SlowMotion, rate: float, start: float, count: int) -> Segments:
    """Segments that cover ``count`` samples from ``start`` [s] at ``rate`` [Hz]."""
    edges: Array = start + np.arange(-(-count // SEGMENT) + 1, dtype=np.float64) * (SEGMENT / rate)
    return Segments(*_cut(*motion.at(edges)))


@njit(cache=True, error_model="numpy")
def _cut(phase, lines):  # type: ignore[no-untyped-def]
    """What ``Segments`` holds, from phase and lines at the segments' edges."""
    size = phase.size - 1
    first, turn = np.empty(size, np.complex128), np.empty(size, np.complex128)
    for s in range(size):
        step = (phase[s + 1] - phase[s]) / SEGMENT
        first[s] = complex(math.cos(phase[s]), math.sin(phase[s]))
        turn[s] = complex(math.cos(step), math.sin(step))
    return first, turn, lines[:-1], (lines[1:] - lines[:-1]) / SEGMENT


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def doubled(turn, re, im):  # type: ignore[no-untyped-def]
    """Powers of ``turn`` from the 0th on into ``re`` and ``im``, as many as a power of two; returns the next one."""
    re[0], im[0] = 1.0, 0.0
    done, far = 1, turn
    while done < re.size:  # each step turns all phasors there are at once, and so doubles them
        a, b = far.real, far.imag
        next_re, next_im = re[done : 2 * done], im[done : 2 * done]
        for i in range(done):
            x, y = re[i], im[i]
            next_re[i], next_im[i] = x * a - y * b, x * b + y * a
        far *= far
        done *= 2
    return far


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def segment_angles(first, turn, lines, line_steps, re, im, out):  # type: ignore[no-untyped-def]
    """Angles of one segment into ``out`` (SEGMENT,) [rad]; ``re``, ``im`` (FINE,) are room for phasors.

    ``lines`` are harmonics 0, 1, 2, ...; three are 1, 3, 5. The amplitude runs straight over the segment, the small
    harmonics keep the value of its middle. A sample's phasor is one of FINE that start at 1, turned by the one of its
    stretch of FINE samples.
    """
    far = doubled(turn, re, im)
    a, b = first.real, first.imag
    for at in range(0, SEGMENT, FINE):
        part = out[at : at + FINE]
        if lines.size == 3:
            _odd_angles(a, b, lines, line_steps, at, re, im, part)
        else:
            _all_angles(a, b, lines, line_steps, at, re, im, part)
        a, b = a * far.real - b * far.imag, a * far.imag + b * far.real


@njit(cache=True, error_model="numpy", fastmath={"contract"}, inline="always")
def _odd_angles(a, b, lines, line_steps, at, re, im, out):  # type: ignore[no-untyped-def]
    """Harmonics 1, 3, 5 by cos 3u = c (1 - 4 s^2), sin 3u = s (3 - 4 s^2), and so on: polynomials in s^2."""
    third, fifth = lines[1] + 0.5 * SEGMENT * line_steps[1], lines[2] + 0.5 * SEGMENT * line_steps[2]
    c0, c1, c2 = third.real + fifth.real, -4.0 * third.real - 12.0 * fifth.real, 16.0 * fifth.real
    step = line_steps[0].imag
    s0 = lines[0].imag + at * step + 3.0 * third.imag + 5.0 * fifth.imag
    s1, s2 = -4.0 * third.imag - 20.0 * fifth.imag, 16.0 * fifth.imag
    for i in range(FINE):
        c, s = re[i] * a - im[i] * b, re[i] * b + im[i] * a
        w = s * s
        out[i] = c * (c0 + w * (c1 + w * c2)) - s * (s0 + RAMP[i] * step + w * (s1 + w * s2))


@njit(cache=True, error_model="numpy", fastmath={"contract"}, inline="always")
def _all_angles(a, b, lines, line_steps, at, re, im, out):  # type: ignore[no-untyped-def]
    for i in range(FINE):
        s = re[i] * b + im[i] * a
        out[i] = lines[0].real - (lines[1].imag + (at + RAMP[i]) * line_steps[1].imag) * s
    for n in range(2, lines.size):
        line = lines[n] + 0.5 * SEGMENT * line_steps[n]
        for i in range(FINE):
            c, s = re[i] * a - im[i] * b, re[i] * b + im[i] * a
            px, py = c, s
            for _ in range(n - 1):
                px, py = px * c - py * s, px * s + py * c
            out[i] += line.real * px - line.imag * py


@njit(cache=True, error_model="numpy")
def _angles(first, turn, lines, line_steps, out):  # type: ignore[no-untyped-def]
    re, im, buffer = np.empty(FINE), np.empty(FINE), np.empty(SEGMENT)
    for s in range(first.size):
        at = s * SEGMENT
        segment_angles(first[s], turn[s], lines[s], line_steps[s], re, im, buffer)
        for i in range(min(SEGMENT, out.size - at)):
            out[at + i] = buffer[i]


class SlowAngle(AngleTrack):
    """Angle at a channel's samples, made when it is read, so that a long recording costs no memory.

    Attributes:
        motion: slow motion that the angles come from.
    """

    motion: SlowMotion
    _size: int

    def __init__(self, motion: SlowMotion, sample_rate: float, start: float, size: int):
        self.__dict__.update(motion=motion, sample_rate=sample_rate, start=start, _size=size)  # frozen, as its parent

    @property
    def size(self) -> int:
        """Number of samples."""
        return self._size

    @cached_property
    def values(self) -> Array:
        """All angles, shape (size,) [rad]."""
        return self.read(0, self.size)

    def read(self, first: int = 0, stop: int | None = None) -> Array:
        """Angles of samples ``first`` up to ``stop``, shape (n,) [rad]."""
        low, high, _ = slice(first, stop).indices(self.size)
        out = np.empty(max(high - low, 0))
        for at in range(0, out.size, PIECE):
            part = out[at : at + PIECE]
            own = self.segments(low + at, low + at + part.size)
            _angles(own.first, own.turn, own.lines, own.line_steps, part)
        return out

    def segments(self, first: int, stop: int) -> Segments:
        """Segments of samples ``first`` up to ``stop``."""
        return segments(self.motion, self.sample_rate, self.start + first / self.sample_rate, stop - first)

    def turned(self) -> SlowAngle:
        """The same motion with the other sign."""
        motion = replace(self.motion, phase=self.motion.phase + np.pi, lines=_turned(self.motion.lines))
        return SlowAngle(motion, self.sample_rate, self.start, self.size)


def _turned(lines: Lines) -> Lines:
    """Lines that make -theta with u + pi: even harmonics change sign, odd ones do not."""
    out = lines.copy()
    if lines.shape[1] != 3:
        out[:, ::2] *= -1.0
    return out
